"""Kernels: moves that leave a target invariant, and their combinations."""

from bcppl.inference.kernels.combinators import cycle, mixture, repeat, sequence
from bcppl.inference.kernels.halving import halved, halves
from bcppl.inference.kernels.hamiltonian import hmc
from bcppl.inference.kernels.hastings import metropolis_hastings
from bcppl.inference.kernels.involutions import involutive
from bcppl.inference.kernels.kernel import Kernel, Move, fitted, refuse_other, scattered, takes
from bcppl.inference.kernels.rejuvenation import Moved, Until, displacement, distinct, moved_by, until
from bcppl.inference.kernels.staged import Screened, Staged, Surrogate, delayed_acceptance, student_t

__all__ = [
    "Kernel",
    "Move",
    "Moved",
    "Screened",
    "Staged",
    "Surrogate",
    "Until",
    "cycle",
    "delayed_acceptance",
    "displacement",
    "distinct",
    "fitted",
    "halved",
    "halves",
    "hmc",
    "involutive",
    "metropolis_hastings",
    "mixture",
    "moved_by",
    "refuse_other",
    "repeat",
    "scattered",
    "sequence",
    "student_t",
    "takes",
    "until",
]

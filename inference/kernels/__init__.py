"""Kernels: moves that leave a target invariant, and how they are put together."""

from bcppl.inference.kernels.combinators import cycle, repeat
from bcppl.inference.kernels.hastings import metropolis_hastings
from bcppl.inference.kernels.kernel import Kernel, Move, put, replaced
from bcppl.inference.kernels.rejuvenation import Moved, rejuvenate

__all__ = [
    "Kernel",
    "Move",
    "Moved",
    "cycle",
    "metropolis_hastings",
    "put",
    "rejuvenate",
    "repeat",
    "replaced",
]

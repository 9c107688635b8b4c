"""Kernels: moves that leave a target invariant, and their combinations.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling, rejuvenate, resample
    from bcppl.inference.kernels import cycle, hmc, metropolis_hastings
    from bcppl.inference.proposals import drift

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    population = importance_sampling(weighed, (), {"reading": torch.tensor(2.4).double()}, 1000)
    kernel = cycle([metropolis_hastings(drift("mass")), hmc("mass", steps=5)])
    population = rejuvenate(resample(population), kernel, sweeps=2)

A kernel is fitted to a population; its moves then leave any target invariant. Kernels are composed by
`sequence`, `cycle`, `mixture` and `repeat`.
"""

from bcppl.inference.kernels.combinators import cycle, mixture, repeat, sequence
from bcppl.inference.kernels.halving import halved, halves
from bcppl.inference.kernels.hamiltonian import hmc
from bcppl.inference.kernels.hastings import metropolis_hastings
from bcppl.inference.kernels.involutions import involutive
from bcppl.inference.kernels.kernel import Kernel, Move, composed, fitted, scattered
from bcppl.inference.kernels.rejuvenation import Until, displacement, moved_by, until
from bcppl.inference.kernels.staged import (
    Surrogate,
    delayed_acceptance,
    student_t,
    surrogate_transition,
)

__all__ = [
    "Kernel",
    "Move",
    "Surrogate",
    "Until",
    "composed",
    "cycle",
    "delayed_acceptance",
    "displacement",
    "fitted",
    "halved",
    "halves",
    "hmc",
    "involutive",
    "metropolis_hastings",
    "mixture",
    "moved_by",
    "repeat",
    "scattered",
    "sequence",
    "student_t",
    "surrogate_transition",
    "until",
]

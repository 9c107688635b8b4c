"""The kernels that are measured, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import pyro
import pyro.distributions as dist
import torch
from evidence import Method
from torch import Tensor

from bcppl.inference.kernels import (
    Kernel,
    cycle,
    hmc,
    involutive,
    metropolis_hastings,
    mixture,
    repeat,
    sequence,
)
from bcppl.inference.proposals import (
    Fittable,
    differential_evolution,
    drift,
    independent,
    prior,
    spread_of,
)
from bcppl.traces import Trace

Values = Mapping[str, Tensor]


def walk(address: str) -> Kernel:
    """The default program's random walk, some of its steps long ones."""
    return metropolis_hastings(drift(address, (0.2, 2.0)))


def even(address: str) -> Kernel:
    """A random walk whose steps are between half of the best length for a normal posterior and all of it."""
    return metropolis_hastings(drift(address, (0.5, 1.0)))


def near(address: str, components: int) -> Kernel:
    """A mixture fitted to the particles, not much wider than they lie: most of its draws are to be taken."""
    return metropolis_hastings(independent(address, components, inflation=1.05, wide=(0.05, 2.0)))


def reflected(address: str) -> Kernel:
    """A random walk written as an involution: go a step, and turn it round."""

    def step(trace: Trace, spread: Tensor) -> None:
        at = torch.zeros(trace.particles, len(spread), dtype=spread.dtype)
        pyro.sample("step", dist.MultivariateNormal(at, spread * 2.38**2 / len(spread), validate_args=False))

    def turn(values: Values, choices: Values) -> tuple[Values, Values]:
        return {address: values[address] + choices["step"]}, {"step": -choices["step"]}

    learn = spread_of(address)
    program = Fittable(lambda population: partial(step, spread=learn(population)))
    return involutive(program, turn)


# By name, what makes a kernel that moves the value at an address, and how many sweeps it is given; those
# of BOTH move vectors and poses alike, the others vectors only.
BOTH: dict[str, tuple[Callable[[str], Kernel], int]] = {
    "drift": (even, 3),
    "drift, many scales": (walk, 3),
    "independent, as shipped": (lambda address: metropolis_hastings(independent(address)), 3),
    "independent, 1 normal, near": (lambda address: near(address, 1), 3),
    "independent, 4 normals, near": (lambda address: near(address, 4), 3),
    "differential evolution": (lambda address: metropolis_hastings(differential_evolution(address)), 3),
    "prior": (lambda address: metropolis_hastings(prior(address)), 3),
    "repeat drift": (lambda address: repeat(even(address), 3), 1),
    "sequence drift, independent": (lambda address: sequence(even(address), near(address, 1)), 2),
    "cycle drift, independent": (lambda address: cycle(even(address), near(address, 1)), 2),
    "mixture drift, independent": (lambda address: mixture([even(address), near(address, 1)]), 3),
}
VECTORS = {**BOTH, "involutive": (reflected, 3), "hmc": (lambda address: hmc(address), 1)}
POSES = BOTH

# What is compared with other packages, on both problems: their own kind of kernel, and the best here.
LIKE_THEIRS = Method(repeat(even("x"), 3), sweeps=1, share=0.8)
COMPARED = Method(near("x", 1), sweeps=1, share=0.6)

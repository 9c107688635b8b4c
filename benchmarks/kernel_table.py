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
    delayed_acceptance,
    hmc,
    involutive,
    metropolis_hastings,
    mixture,
    repeat,
    sequence,
)
from bcppl.inference.proposals import Fitted, drift, spread_of
from bcppl.traces import Trace

Values = Mapping[str, Tensor]


def walk(address: str) -> Kernel:
    """The default program's random walk, some of its steps long ones."""
    return metropolis_hastings(drift(address, (0.2, 2.0)))


def even(address: str) -> Kernel:
    """A random walk whose steps are between half of the best length for a normal posterior and all of it."""
    return metropolis_hastings(drift(address, (0.5, 1.0)))


def reflected(address: str) -> Kernel:
    """A random walk written as an involution: go a step, and turn it round."""

    def step(trace: Trace, spread: Tensor) -> None:
        at = torch.zeros(trace.particles, len(spread), dtype=spread.dtype)
        pyro.sample("step", dist.MultivariateNormal(at, spread * 2.38**2 / len(spread), validate_args=False))

    def turn(values: Values, choices: Values) -> tuple[Values, Values]:
        return {address: values[address] + choices["step"]}, {"step": -choices["step"]}

    learn = spread_of(address)
    program = Fitted(lambda population: partial(step, spread=learn(population)))
    return involutive(program, turn)


# By name, what makes a kernel that moves the value at an address, and how many sweeps it is given; those
# of WALKS move vectors and poses alike, the others vectors only.
WALKS: dict[str, tuple[Callable[[str], Kernel], int]] = {
    "drift": (even, 3),
    "drift, many scales": (walk, 3),
    "drift, sequence of three": (lambda address: sequence(*[even(address)] * 3), 1),
    "drift, repeated 3 times": (lambda address: repeat(even(address), 3), 1),
    "mixture of both drifts": (lambda address: mixture([even(address), walk(address)]), 3),
    "cycle of both drifts": (lambda address: cycle(even(address), walk(address)), 2),
}
VECTORS = {**WALKS, "involutive": (reflected, 3), "hmc": (lambda address: hmc(address), 1)}
POSES = WALKS
# What is compared with other packages: fixed before the comparison, and the same for both problems.
COMPARED = Method(repeat(even("x"), 3), sweeps=1, share=0.8)

# On the simulated probe: without and with delayed acceptance.
PROBES: dict[str, tuple[Callable[[str], Kernel], int]] = {
    "drift, 3 sweeps": (walk, 3),
    "drift, 6 sweeps": (walk, 6),
    "delayed acceptance, 6 sweeps": (lambda a: delayed_acceptance(walk(a), first="depth_*"), 6),
    "delayed acceptance, 12 sweeps": (lambda a: delayed_acceptance(walk(a), first="depth_*"), 12),
    "by windows, 12 sweeps": (lambda a: delayed_acceptance(walk(a), first="depth_*", stages=4), 12),
}

"""Kernels: Metropolis-Hastings moves with proposal programs, and how they are put together.

A kernel is fitted to a weighted population, `kernel(population) -> move`, and a move is
`(trace, target) -> (trace, accepted (N,))` that leaves the target invariant. What a move learns from the
population is fixed before it runs. No kernel contains a hand-derived acceptance ratio: the proposal program
is run forward by `propose` and back by `assess`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl.errors import InferenceError
from bcppl.inference.population import Population
from bcppl.inference.targets import Target, above
from bcppl.traces import Trace, assess, propose, update

Move = Callable[[Trace, Target], tuple[Trace, Tensor]]
Kernel = Callable[[Population], Move]
Proposal = Callable[[Trace], Any]
Fit = Callable[[Population], Proposal]


class Moved(NamedTuple):
    """A rejuvenated population, and the share of proposals that were accepted."""

    population: Population
    acceptance: float


def metropolis_hastings(fit: Fit) -> Kernel:
    """Metropolis-Hastings with a proposal program.

    Args:
        fit: makes the proposal program `program(trace)` from a population. The program's choices at latent
            addresses of the trace are new values; its other choices are auxiliary and keep their values on
            the way back (so their distribution must not depend on what is moved in a way that forbids that).

    The acceptance ratio is that of Hastings, Biometrika 57, 1970, on the pair (trace, auxiliary choices).
    """

    def kernel(population: Population) -> Move:
        program = fit(population)

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            forward = propose(program, (trace,), trace.particles)
            new = {a: v for a, v in forward.choices.items() if a in trace.choices}
            if not new:
                raise InferenceError(
                    f"a proposal has no choice at a latent address: it chooses {', '.join(forward.choices)}, "
                    f"latent are {', '.join(trace.choices)}."
                )
            updated = update(trace, new)
            back = {**forward.choices, **updated.discarded}
            backward = assess(program, (updated.trace,), back, trace.particles)
            # With the chance drawn first, it is known what a proposal must reach to be accepted.
            chance = torch.log(torch.rand(trace.particles, dtype=torch.float64))
            needed = chance + target(trace) - backward + forward.log_prob
            passed, survivors = above(target, updated.trace, needed)
            accepted = torch.zeros(trace.particles, dtype=torch.bool)
            accepted[passed] = True
            return put(trace, passed, survivors), accepted

        return move

    return kernel


def cycle(*kernels: Kernel) -> Kernel:
    """One kernel after another; the acceptance is their mean."""

    def together(population: Population) -> Move:
        moves = [kernel(population) for kernel in kernels]

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            total = torch.zeros(trace.particles, dtype=torch.float64)
            for each in moves:
                trace, accepted = each(trace, target)
                total = total + accepted
            return trace, total / len(moves)

        return move

    return together


def repeat(kernel: Kernel, times: int) -> Kernel:
    """The same fitted move several times."""

    def together(population: Population) -> Move:
        fitted = kernel(population)
        return cycle(*[lambda _: fitted] * times)(population)

    return together


def rejuvenate(population: Population, kernel: Kernel, target: Target, sweeps: int = 1) -> Moved:
    """Move every particle, `sweeps` times.

    Each half of the population learns from the other, so no particle shapes its own proposal. The particles
    are split at random: copies of one ancestor lie side by side after resampling.
    """
    accepted = []
    for _ in range(sweeps):
        order = torch.randperm(len(population))
        halves = [order[: len(order) // 2], order[len(order) // 2 :]]
        for mine, others in (halves, halves[::-1]):
            if len(mine) == 0:
                continue
            move = kernel(population[others] if len(others) else population)
            moved, share = move(population.trace[mine], target)
            accepted.append(share.to(torch.float64))
            population = replaced(population, mine, moved)
    return Moved(population, float(torch.cat(accepted).mean()))


def replaced(population: Population, index: Tensor, moved: Trace) -> Population:
    """The population with the particles at `index` (K,) replaced by those of a trace of K particles."""
    trace = put(population.trace, index, moved)
    return Population(trace, population.log_weights, population.log_evidence)


def put(trace: Trace, index: Tensor, other: Trace) -> Trace:
    """A trace with the particles at `index` (K,) replaced by those of a trace of K particles."""
    if len(index) == 0:
        return trace
    source = torch.zeros(len(trace), dtype=torch.int64)
    source[index] = torch.arange(len(index))
    mask = torch.zeros(len(trace), dtype=torch.bool)
    mask[index] = True
    return other[source].where(mask, trace)

"""Combinations of kernels: each leaves invariant the target that its parts leave invariant.

Tierney, Markov chains for exploring posterior distributions, Annals of Statistics 22, 1994, section 2.4. The
choice of the next kernel does not depend on where the particles are. The acceptance is the mean over the
proposals. All raise InputError where no kernel is given, or something else, such as a proposal.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.kernels.kernel import (
    Kernel,
    Move,
    fitted,
    in_sequence,
    is_reversible,
    learns,
    marked,
    parts_of,
    refuse_no_kernel,
    scattered,
)
from bcppl.inference.population import Population
from bcppl.inference.targets import Target
from bcppl.traces import Trace


def _one_after_another(kernels: Sequence[Kernel]) -> Kernel:
    """The moves of several kernels, one after another; one that comes again is fitted once."""

    def together(population: Population) -> Move:
        each_once = {id(kernel): kernel for kernel in kernels}
        made = {key: fitted(kernel, population) for key, kernel in each_once.items()}
        moves = [made[id(kernel)] for kernel in kernels]

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            total = torch.zeros(trace.particles, dtype=torch.float64)
            for each in moves:
                trace, accepted = each(trace, target)
                total = total + accepted
            return trace, total / len(moves)

        return move

    reversible = kernels == kernels[::-1] and all(map(is_reversible, kernels))
    return marked(together, reversible=reversible, learns=any(map(learns, kernels)))


def _listed(name: str, kernels: Sequence[Kernel | Sequence[Kernel]]) -> list[Kernel]:
    """Kernels that were given one by one, or as one list."""
    one = kernels[0] if len(kernels) == 1 else None
    listed: list[Any] = list(one) if isinstance(one, Sequence) and not isinstance(one, str) else list(kernels)
    if not listed:
        raise InputError(f"{name} is given no kernel; give one or more.")
    for each in listed:
        refuse_no_kernel(name, each)
    return listed


def sequence(*kernels: Kernel | Sequence[Kernel]) -> Kernel:
    """One kernel after another, in the order given, one by one or as a list."""
    listed = _listed("sequence", kernels)
    return in_sequence(_one_after_another(listed), listed)


def in_parts(kernel: Kernel, population: Population) -> list[tuple[Kernel, int]]:
    """Kernels whose moves follow one another, for a population: learners apart from others.

    Each comes with how many moves it is made of.
    """
    groups = [list(group) for _, group in groupby(parts_of(kernel, population), key=learns)]
    return [(each[0] if len(each) == 1 else _one_after_another(each), len(each)) for each in groups]


def cycle(*kernels: Kernel | Sequence[Kernel]) -> Kernel:
    """Each kernel once, in an order that is drawn for each particle: Tierney's random permutation scan.

    A fixed order of reversible kernels is not reversible; a random one is, and one that all particles shared
    would leave them dependent.
    """
    listed = _listed("cycle", kernels)

    def together(population: Population) -> Move:
        moves = [fitted(kernel, population) for kernel in listed]

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            order = torch.rand(trace.particles, len(moves)).argsort(dim=1)
            total = torch.zeros(trace.particles, dtype=torch.float64)
            for drawn in order.unbind(dim=1):
                trace, accepted = _each_by_its_own(moves, drawn, trace, target)
                total = total + accepted
            return trace, total / len(moves)

        return move

    return _of_all(together, listed)


def _of_all(kernel: Kernel, listed: Sequence[Kernel]) -> Kernel:
    return marked(kernel, reversible=all(map(is_reversible, listed)), learns=any(map(learns, listed)))


def mixture(*kernels: Kernel | Sequence[Kernel], weights: Sequence[float] | None = None) -> Kernel:
    """One of several kernels, drawn for each particle and each move.

    Particles stay independent of one another, and a small population sees every kernel; each kernel moves
    only the particles that drew it.

    Args:
        kernels: one by one or as a list.
        weights: their probabilities, up to a factor; equal by default.

    Raises:
        InputError: the weights are not one for each, finite, and not negative.
    """
    listed = _listed("mixture", kernels)
    chances = torch.as_tensor([1.0] * len(listed) if weights is None else weights, dtype=torch.float64)
    sound = chances.shape == (len(listed),) and bool((torch.isfinite(chances) & (chances >= 0.0)).all())
    if not sound or not bool(chances.sum() > 0.0):
        raise InputError(
            f"mixture is given weights {chances.tolist()} for {len(listed)} kernels; "
            "give one for each, 0 or more, not all of them 0."
        )

    def together(population: Population) -> Move:
        moves = [fitted(kernel, population) for kernel in listed]

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            return _each_by_its_own(
                moves, torch.multinomial(chances, trace.particles, replacement=True), trace, target
            )

        return move

    return _of_all(together, listed)


def _each_by_its_own(
    moves: Sequence[Move], drawn: Tensor, trace: Trace, target: Target
) -> tuple[Trace, Tensor]:
    """Particles moved each by the move (N,) that was drawn for it."""
    accepted = torch.zeros(trace.particles, dtype=torch.float64)
    for k, move in enumerate(moves):
        index = (drawn == k).nonzero().flatten()
        if len(index) == 0:
            continue
        moved, share = move(trace[index], target)
        trace = scattered(trace, index, moved)
        accepted[index] = share.to(torch.float64)
    return trace, accepted


def repeat(kernel: Kernel, times: int) -> Kernel:
    """The same fitted move several times.

    A number that depends on how far the particles came is a matter of the sweeps of a whole population:
    `bcppl.inference.kernels.until`.

    Raises:
        InputError: the times are no whole number, 1 or more.
    """
    refuse_no_kernel("repeat", kernel)
    times = whole_number("a kernel is to be repeated {} times", times)
    return _one_after_another([kernel] * times)

"""Kernels put together: each of these leaves invariant what its parts leave invariant.

Tierney, Markov chains for exploring posterior distributions, Annals of Statistics 22, 1994, section 2.4. No
choice of what comes next hangs on where the particles are. The acceptance is the mean over what was tried.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.kernels.kernel import Kernel, Move, put
from bcppl.inference.population import Population
from bcppl.inference.targets import Target
from bcppl.traces import Trace


def _one_after_another(moves: Sequence[Move], trace: Trace, target: Target) -> tuple[Trace, Tensor]:
    total = torch.zeros(trace.particles, dtype=torch.float64)
    for each in moves:
        trace, accepted = each(trace, target)
        total = total + accepted
    return trace, total / len(moves)


def _refuse_none(name: str, kernels: Sequence[Kernel]) -> None:
    if not kernels:
        raise InputError(f"{name} is given no kernel; give one or more.")


def sequence(*kernels: Kernel) -> Kernel:
    """One kernel after another, in the order given.

    Raises:
        InputError: no kernel is given.
    """
    _refuse_none("sequence", kernels)

    def together(population: Population) -> Move:
        moves = [kernel(population) for kernel in kernels]
        return lambda trace, target: _one_after_another(moves, trace, target)

    return together


def cycle(*kernels: Kernel) -> Kernel:
    """Each kernel once, in an order that is drawn anew for each move: Tierney's random permutation scan.

    Of reversible kernels a fixed order is not reversible; a random one is.

    Raises:
        InputError: no kernel is given.
    """
    _refuse_none("cycle", kernels)

    def together(population: Population) -> Move:
        moves = [kernel(population) for kernel in kernels]

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            order = torch.randperm(len(moves)).tolist()
            return _one_after_another([moves[k] for k in order], trace, target)

        return move

    return together


def mixture(kernels: Sequence[Kernel], weights: Sequence[float] | None = None) -> Kernel:
    """One of several kernels, drawn anew for each particle and each move.

    Drawn for each particle, so that particles stay independent of one another and a small population sees
    every kernel; each kernel then moves only the particles that drew it.

    Args:
        kernels: what is drawn from.
        weights: their chances, not negative, up to a factor; equal by default.

    Raises:
        InputError: no kernel is given, or the weights are not one for each, finite, and not negative.
    """
    _refuse_none("mixture", kernels)
    chances = torch.as_tensor([1.0] * len(kernels) if weights is None else weights, dtype=torch.float64)
    sound = chances.shape == (len(kernels),) and bool((torch.isfinite(chances) & (chances >= 0.0)).all())
    if not sound or not bool(chances.sum() > 0.0):
        raise InputError(
            f"mixture is given weights {chances.tolist()} for {len(kernels)} kernels; "
            "give one for each, 0 or more, not all of them 0."
        )

    def together(population: Population) -> Move:
        moves = [kernel(population) for kernel in kernels]

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            drawn = torch.multinomial(chances, trace.particles, replacement=True)
            accepted = torch.zeros(trace.particles, dtype=torch.float64)
            for k, each in enumerate(moves):
                index = (drawn == k).nonzero().flatten()
                if len(index) == 0:
                    continue
                moved, share = each(trace[index], target)
                trace = put(trace, index, moved)
                accepted[index] = share.to(torch.float64)
            return trace, accepted

        return move

    return together


def repeat(kernel: Kernel, times: int) -> Kernel:
    """The same fitted move several times.

    A number that hangs on how far the particles came is not for a kernel to decide, but for the sweeps of a
    whole population: `bcppl.inference.kernels.until`.

    Raises:
        InputError: fewer than one time.
    """
    if times < 1:
        raise InputError(f"a kernel is to be repeated {times} times; give 1 or more.")

    def together(population: Population) -> Move:
        moves = [kernel(population)] * times
        return lambda trace, target: _one_after_another(moves, trace, target)

    return together

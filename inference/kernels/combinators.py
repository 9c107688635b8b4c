"""Kernels put together: each of these leaves invariant what its parts leave invariant."""

from __future__ import annotations

import torch
from torch import Tensor

from bcppl.inference.kernels.kernel import Kernel, Move
from bcppl.inference.population import Population
from bcppl.inference.targets import Target
from bcppl.traces import Trace


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

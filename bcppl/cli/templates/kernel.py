"""NAME: an inference program with a kernel of your own. Edit it, then run it.

    bcppl run point_probe_10_pushes --inference NAME.py

A kernel is fitted to a weighted population; the move that it gives leaves the target invariant:
(trace, target) -> (trace, accepted). `bcppl.inference.check_kernel` shows whether it does.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from bcppl import Model, Population, Trace
from bcppl.inference import Step, smc, tempered
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.kernels.kernel import Kernel, Move
from bcppl.inference.proposals import drift
from bcppl.inference.targets import Target


def kernel(address: str, tries: int = 3) -> Kernel:
    """Random walks in a row, of steps that the population's spread decides."""

    def fitted(population: Population) -> Move:
        walk = metropolis_hastings(drift(address))(population)  # what it learns is fixed before it moves

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            taken = torch.zeros(trace.particles, dtype=torch.float64)
            for _ in range(tries):
                trace, accepted = walk(trace, target)
                taken += accepted / tries
            return trace, taken  # the share of proposals (N,) that each particle took

        return move

    return fitted


def infer(model: Model, recording: Any, *, sweeps: int = 4, **settings: Any) -> Iterator[Step]:
    """Beliefs over a recording; `settings` are particles, seed, scene and start, as of `bcppl run`."""
    return smc(model, recording, step=tempered(kernel(model.pose), sweeps=sweeps), **settings)

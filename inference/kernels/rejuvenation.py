"""Rejuvenation: every particle of a population moved, each half learning from the other."""

from __future__ import annotations

from typing import NamedTuple

import torch

from bcppl.inference.kernels.kernel import Kernel, replaced
from bcppl.inference.population import Population
from bcppl.inference.targets import Target


class Moved(NamedTuple):
    """A rejuvenated population, and the share of proposals that were accepted."""

    population: Population
    acceptance: float


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

"""The two halves of a population, split by ancestry: proposals that move one half are fitted to the other.

A particle shapes its own proposal if its copies are among those that the proposal is fitted to, and then the
moves do not leave the target invariant. So copies are of one half, and so are their descendants: a particle
stays in its ancestor's half through moves and resampling. Where resampling has left less than a quarter of
the particles in one half, the population is split again, by the ancestry since the last split.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bcppl.inference.population import Population

LEAST = 0.25  # of the particles in either half


def halved(population: Population) -> Population:
    """The population with `sides` and `families`, about as many particles on one side as on the other.

    Particles that all descend from one, or are all equal, cannot be split: they are of one half.
    """
    if len(population.sides):
        if _smaller(population.sides) >= LEAST * len(population):
            return population
        sides = _split(population.families)
        if _smaller(sides) >= LEAST * len(population):
            return replace(population, sides=sides)
        families = _copies(population, torch.arange(len(population)))
    else:
        families = _copies(population, population.founders)
    return replace(population, families=families, sides=_split(families))


def halves(population: Population) -> list[Tensor]:
    """The indices (K,) of the particles in each half of a population that was split; one if all are in it."""
    parts = [population.sides.nonzero().flatten(), (~population.sides).nonzero().flatten()]
    return [part for part in parts if len(part)]


def _smaller(sides: Tensor) -> int:
    count = int(sides.sum())
    return min(count, len(sides) - count)


def _copies(population: Population, otherwise: Tensor) -> Tensor:
    """The number (N,) of each particle's group of copies: those with equal continuous values.

    Discrete values are equal by chance too. A side that depended on them would let a particle shape its own
    proposal, so without a continuous value the groups are `otherwise`.
    """
    values = [v for v in population.trace.choices.values() if v.is_floating_point()]
    if not values:
        return otherwise
    rows = torch.cat([v.reshape(len(population), -1).double() for v in values], dim=1)
    return torch.unique(rows, dim=0, return_inverse=True)[1]


def _split(families: Tensor) -> Tensor:
    """Sides (N,) of families (N,) in random order, the first of them, up to half of the particles, on one."""
    _, family, sizes = torch.unique(families, return_inverse=True, return_counts=True)
    order = torch.randperm(len(sizes))
    middle = sizes[order].cumsum(0) - 0.5 * sizes[order]
    first = torch.empty(len(sizes), dtype=torch.bool)
    first[order] = middle <= 0.5 * len(families)
    return first[family]

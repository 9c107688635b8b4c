"""The two halves of a population, split by ancestry: proposals that move one half are fitted to the other.

A particle shapes its own proposal if its copies are among those that the proposal is fitted to, and then the
moves do not leave the target invariant. So copies are of one half, and so are their descendants: a particle
stays in its ancestor's half through moves and resampling. Where a resampling leaves too few particles or
families in one half, it splits the population again (`bcppl.inference.ancestry`).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bcppl.inference.ancestry import split
from bcppl.inference.population import Population
from bcppl.inference.proposals.spread import program_draws


def halved(population: Population) -> Population:
    """The population with `sides` and `families`, about as many particles on one side as on the other.

    Particles that all descend from one, or are all equal, cannot be split: they are of one half.
    """
    sides = population.sides
    if len(sides) and not bool((sides == sides[0]).all()):
        return population
    families = _copies(population)
    return replace(population, families=families[:, None], sides=split(families))


def halves(population: Population) -> list[Tensor]:
    """The indices (K,) of the particles in each half of a population that was split; one if all are in it."""
    parts = [population.sides.nonzero().flatten(), (~population.sides).nonzero().flatten()]
    return [part for part in parts if len(part)]


def apart_from(population: Population, moved: Tensor) -> Population:
    """The particles that those at `moved` (K,), of one half, may learn from: the other half.

    Where nobody is in it, a move that is fitted to those that it moves would not leave the target invariant:
    it learns from draws of the program, as many as there are particles.
    """
    others = population.sides != population.sides[moved[0]]
    if bool(others.any()):
        return population[others]
    return Population(program_draws(population.trace), approximation=population.approximation)


def moved_together(population: Population, *, learning: bool) -> tuple[Population, list[Tensor]]:
    """A population, and the indices (K,) of the particles that are moved together.

    They are its halves where moves learn from particles, for which it is split, and else all.
    """
    if not learning:
        return population, [torch.arange(len(population))]
    population = halved(population)
    return population, halves(population)


def _copies(population: Population) -> Tensor:
    """The number (N,) of each particle's group of copies: those with equal continuous values.

    Discrete values are equal by chance too. A side that depended on them would let a particle shape its own
    proposal, so without a continuous value the groups are those of the particles' founders.
    """
    values = [v for v in population.trace.choices.values() if v.is_floating_point()]
    if not values:
        return population.founders
    rows = torch.cat([v.reshape(len(population), -1).double() for v in values], dim=1)
    return torch.unique(rows, dim=0, return_inverse=True)[1]

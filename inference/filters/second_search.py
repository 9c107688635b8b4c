"""A second population where the first misses a mode: drawn from the approximation, and chosen by evidence.

Particles that explain the measurements far worse than a pose which the approximation has reached miss the
posterior's mass: a contact is an outlier to all of them alike, and their weights do not show it. Others are
then drawn by importance sampling from the approximation, given all measurements. Both populations estimate
the evidence, and one of them is chosen with probability proportional to its estimate, as islands are (Verge,
Dubarry, Del Moral and Moulines, On parallel implementation of sequential Monte Carlo methods: the island
particle model, Statistics and Computing 25, 2015). The evidence is the mean of the two estimates; since the
second is made only where it is needed, it is consistent rather than unbiased.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import torch

from bcppl.errors import NoWeightError
from bcppl.inference.importance import importance_sampling
from bcppl.inference.population import Population
from bcppl.inference.sizing import resize

MISSED = 10.0  # nats by which a mode is better than every particle: of 75 in six dimensions the best lacks 1
COPIES = 20  # draws for each particle: the approximation leaves some per cent of them effective


class Comparable(Protocol):
    """An approximation that particles are compared with."""

    def shortfall(self, trace: Any) -> float:
        """By how many nats the best mode explains all measurements better than the best particle does."""


def searched(population: Population, proposal: Callable[[Any], Callable[..., Any]]) -> Population:
    """The population, or one drawn from its approximation where that explains the measurements far better.

    It costs nothing where no particle is far from the best mode, and `COPIES` evaluations of all measurements
    for each particle elsewhere.

    Args:
        population: weighted for all measurements of its trace.
        proposal: of all latent values, given the approximation.
    """
    approximation, trace, count = population.approximation, population.trace, len(population)
    if approximation.shortfall(trace) < MISSED:
        return population
    try:
        drawn = importance_sampling(
            trace.program, trace.args, trace.observations, COPIES * count, proposal(approximation)
        )
        other = resize(drawn, count)
    except NoWeightError:
        return population
    both = float(torch.tensor([drawn.log_evidence, population.log_evidence]).logsumexp(dim=0)) - math.log(2.0)
    chance = 1.0 / (1.0 + math.exp(min(700.0, population.log_evidence - drawn.log_evidence)))
    if float(torch.rand((), dtype=torch.float64)) < chance:
        population = other.with_approximation(approximation)
    # Pairs of particles do not give the variance of an estimate that two populations share.
    return replace(population, log_evidence=both, log_pairs=math.inf)

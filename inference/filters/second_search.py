"""A second population where the first misses a mode: drawn from the approximation, and joined by evidence.

Where half of the particles explain the measurements far worse than a pose which the approximation has
reached, they miss the posterior's mass: a contact is an outlier to all of them alike, and their weights do
not show it. Others are then drawn by importance sampling from the approximation, given all measurements, and
pooled with them (`bcppl.inference.filters.searching.pooled_by_evidence`). Since the second population is
drawn only where it is needed, the evidence is consistent rather than unbiased.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import Tensor

from bcppl.errors import NoWeightError
from bcppl.inference.filters.screening import screened_draws
from bcppl.inference.filters.searching import pooled_by_evidence
from bcppl.inference.importance import importance_sampling
from bcppl.inference.population import Population
from bcppl.inference.targets import runs_physics

MISSED = 10.0  # nats by which a mode is better than half of the particles: in six dimensions 3 is usual
COPIES = 20  # draws for each particle: the approximation leaves some per cent of them effective


class Searched(NamedTuple):
    """The population after a search, and which of the pooled particles (N,) it has; None for those before."""

    population: Population
    chosen: Tensor | None = None


def searched(population: Population, proposal: Callable[[Any], Callable[..., Any]]) -> Searched:
    """The population, or one joined with draws of its approximation where that explains all far better.

    So it is where no particle is near a mode that is about as probable: particles that all went to another
    one, which seemed better when less was measured, do not come back by themselves. Where a particle explains
    all far better than the modes of the approximation do, these are searched for again first, from particles
    and from many places: the next measurement would move all to where it is known to be worse. It costs
    nothing where particles are near all modes, and `COPIES` evaluations of all measurements for each particle
    elsewhere.

    Args:
        population: weighted for all measurements of its trace. Its approximation has methods `shortfall` and
            `misses_a_mode`.
        proposal: of all latent values, given the approximation.
    """
    population = _followed(population)
    approximation, trace = population.approximation, population.trace
    if approximation.shortfall(trace) < MISSED and not approximation.misses_a_mode(trace):
        return Searched(population)
    other, chosen = pooled_with_draws(population, approximation, proposal)
    return Searched(_followed(other), chosen)


def _followed(population: Population) -> Population:
    """The population whose approximation is, where some particle is far better, searched for again."""
    approximation, trace = population.approximation, population.trace
    if not approximation.is_exceeded(trace):
        return population
    return population.with_approximation(approximation.following(trace))


def pooled_with_draws(
    population: Population, approximation: Any, proposal: Callable[[Any], Callable[..., Any]]
) -> Searched:
    """The population, joined with one drawn from an approximation by their evidence.

    Args:
        population: weighted for all measurements of its trace.
        approximation: given them.
        proposal: of all latent values, given the approximation.
    """
    trace, count = population.trace, COPIES * len(population)
    try:
        if runs_physics(trace):
            drawn = screened_draws(trace, approximation, proposal(approximation))
        else:
            drawn = importance_sampling(
                trace.program, trace.args, trace.observations, count, proposal(approximation)
            )
        both, chosen = pooled_by_evidence(population, drawn)
    except NoWeightError:
        return Searched(population)
    if bool((chosen >= len(population)).any()):
        both = both.with_approximation(approximation)
    return Searched(both, chosen)

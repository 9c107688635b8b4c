"""Verbs that change the number of particles of a population; its estimates stay unbiased.

GenParticleFilters.jl (`pf_resize!`, `pf_replicate!`, `pf_coalesce!`) has the same verbs.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from bcppl.arguments import whole_number
from bcppl.beliefs import normalised
from bcppl.errors import InputError
from bcppl.inference.population import Population, refuse_no_population
from bcppl.inference.resampling import Scheme, systematic
from bcppl.traces.carried import Branching
from bcppl.traces.series import SeriesTrace


def resize(population: Population, count: int, scheme: Scheme = systematic) -> Population:
    """A population resampled to `count` particles of equal weight.

    Raises:
        InferenceError: no particle has any weight.
        InputError: `count` is no whole number, 1 or more.
    """
    refuse_no_population("resize", population)
    return population.selected(scheme(population.log_weights, count))


def replicate(population: Population, times: int) -> Population:
    """A population with `times` copies of every particle, side by side, of equal weight; nothing is drawn.

    Raises:
        InputError: `times` is no whole number, 1 or more.
    """
    refuse_no_population("replicate", population)
    times = whole_number("particles are to be replicated {} times", times)
    return population[torch.arange(len(population)).repeat_interleave(times)]


def merge(population: Population) -> Population:
    """A population whose particles with equal latent values are merged, their weights added.

    The first of each keeps its place. After merging copies of different founders the variance of the evidence
    can no longer be estimated (`bcppl.inference.summaries`).

    Raises:
        InferenceError: no particle has any weight.
        InputError: the population is of a series, or its likelihoods are estimated by filters (`marginal`).
    """
    refuse_no_population("merge", population)
    carried = population.trace.carried.values()
    if isinstance(population.trace, SeriesTrace) or any(isinstance(e.state, Branching) for e in carried):
        raise InputError(
            "the particles of a series cannot be merged: those with equal values at the newest step may have "
            "different pasts; resample instead (`resize`)."
        )
    count = len(population)
    weights = normalised(population.log_weights)
    numbers = [v.reshape(count, -1).to(torch.float64) for v in population.trace.choices.values()]
    together = torch.cat([torch.zeros(count, 1, dtype=torch.float64), *numbers], dim=1)
    _, group = torch.unique(together, dim=0, return_inverse=True)
    groups = int(group.max()) + 1
    first = torch.full((groups,), count).scatter_reduce(0, group, torch.arange(count), "amin")
    total = torch.zeros(groups, dtype=torch.float64).index_add_(0, group, weights)
    order = first.argsort()
    kept = first[order]
    # The mean weight is unchanged, so the merged population has the same estimates.
    log_weights = total.log()[order] + population.log_total + math.log(groups / count)
    mixed = bool((population.founders[first][group] != population.founders).any())
    return replace(
        population[kept],
        log_weights=log_weights,
        log_pairs=math.inf if mixed else population.log_pairs,
    )

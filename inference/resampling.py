"""Resampling: which particles go on, and when.

A scheme is `(log_weights (N,)) -> ancestors (N,)`; `adaptive` makes of it what SMC takes, a function of a
population. Douc, Cappe and Moulines, Comparison of resampling schemes for particle filtering, ISPA 2005.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.inference.population import Population

Scheme = Callable[[Tensor], Tensor]
Resample = Callable[[Population], tuple[Population, bool]]


def systematic(log_weights: Tensor) -> Tensor:
    """Ancestors (N,) int64 by one uniform draw and N equal steps: unbiased, of low variance."""
    count = len(log_weights)
    points = (torch.arange(count, dtype=torch.float64) + torch.rand((), dtype=torch.float64)) / count
    weights = normalised(log_weights)
    # Rounding may leave the last sum short of the last point: that falls to the last particle with weight.
    last = int(weights.nonzero()[-1])
    return torch.searchsorted(weights.cumsum(0), points, right=True).clamp_max(last)


def always(scheme: Scheme = systematic) -> Resample:
    """Resample at every opportunity."""
    return lambda population: (population.selected(scheme(population.log_weights)), True)


def never(population: Population) -> tuple[Population, bool]:
    """Leave the weights as they are."""
    return population, False


def adaptive(scheme: Scheme = systematic, threshold: float = 0.5) -> Resample:
    """Resample when the effective sample size falls below a share `threshold` of the particles."""
    resample = always(scheme)

    def when_needed(population: Population) -> tuple[Population, bool]:
        if population.effective_sample_size >= threshold * len(population):
            return population, False
        return resample(population)

    return when_needed

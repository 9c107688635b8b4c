"""Resampling: which particles go on, and when.

A scheme is `(log_weights (N,), count) -> ancestors (count,)`; `always` and `adaptive` make of it what SMC
takes, a function of a population. Douc, Cappe and Moulines, Comparison of resampling schemes for particle
filtering, ISPA 2005.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.inference.population import Population


class Scheme(Protocol):
    """Ancestors (count,) int64 of particles with log weights (N,); as many as there are unless `count`."""

    def __call__(self, log_weights: Tensor, count: int | None = None, /) -> Tensor:
        """Draw them."""
        ...


# The resampled population and its ancestors (N,), or None where all particles stay as they are.
Resample = Callable[[Population], tuple[Population, Tensor | None]]


def systematic(log_weights: Tensor, count: int | None = None) -> Tensor:
    """Ancestors (count,) int64 by one uniform draw and equal steps: unbiased, of low variance."""
    count = len(log_weights) if count is None else count
    points = (torch.arange(count, dtype=torch.float64) + torch.rand((), dtype=torch.float64)) / count
    weights = normalised(log_weights)
    # Rounding may leave the last sum short of the last point: that falls to the last particle with weight.
    last = int(weights.nonzero()[-1])
    return torch.searchsorted(weights.cumsum(0), points, right=True).clamp_max(last)


def always(scheme: Scheme = systematic) -> Resample:
    """Resample at every opportunity."""

    def resample(population: Population) -> tuple[Population, Tensor | None]:
        ancestors = scheme(population.log_weights)
        return population.selected(ancestors), ancestors

    return resample


def never(population: Population) -> tuple[Population, Tensor | None]:
    """Leave the weights as they are."""
    return population, None


def adaptive(scheme: Scheme = systematic, threshold: float = 0.5) -> Resample:
    """Resample when the effective sample size falls below a share `threshold` of the particles."""
    resample = always(scheme)

    def when_needed(population: Population) -> tuple[Population, Tensor | None]:
        if population.effective_sample_size >= threshold * len(population):
            return population, None
        return resample(population)

    return when_needed

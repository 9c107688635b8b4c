"""Resampling: when particles are drawn anew by their weights, as decorators of a scheme.

Which ones go on is for the scheme to say (`bcppl.inference.schemes`).
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from bcppl.inference.population import Population
from bcppl.inference.schemes import Scheme, multinomial, residual, ssp, stratified, systematic

__all__ = [
    "Resample",
    "Scheme",
    "adaptive",
    "always",
    "multinomial",
    "never",
    "residual",
    "ssp",
    "stratified",
    "systematic",
]


# The resampled population and its ancestors (N,), or None where all particles stay as they are.
Resample = Callable[[Population], tuple[Population, Tensor | None]]


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

"""The outer samples of a nested Monte Carlo estimate, and averages over them."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.resampling import systematic


@dataclass(frozen=True, eq=False)
class OuterSamples:
    """Particles that serve as the true value in turn: the outer samples of nested Monte Carlo.

    Attributes:
        particles: (S,) int64; one may occur several times, each time with its own noise.
        weights: (S,) normalised.
    """

    particles: Tensor
    weights: Tensor

    def __len__(self) -> int:
        return len(self.particles)


def draw_outer_samples(population: Population, count: int | None) -> OuterSamples:
    """`count` particles drawn systematically by weight; None: every one with weight once, by its weight."""
    if not math.isfinite(population.log_total):
        raise InputError(
            "the belief has no weight: every particle's is zero, so that no outer sample can be drawn; widen "
            "the prior, use more particles, or check the measurements (`bcppl check`)."
        )
    weights = torch.softmax(population.log_weights, 0)
    if count is None:
        particles = (weights > 0).nonzero().flatten()
        return OuterSamples(particles, weights[particles])
    count = whole_number("{} outer samples were asked for", count, least=2)
    particles = systematic(population.log_weights, count)
    return OuterSamples(particles, torch.full((count,), 1.0 / count, dtype=torch.float64))


def mean_and_error(values: Tensor, weights: Tensor) -> tuple[float, float]:
    """The weighted mean of values (S,) and its standard error, as if outer samples were independent.

    Systematic draws are not independent, so the error is a little too large: by the share of the variance
    that is between particles rather than between draws of the noise. NaN values are left out; if all are
    NaN, the mean is NaN and the error infinite.
    """
    valid = ~torch.isnan(values)
    if not bool(valid.any()):
        return math.nan, math.inf
    values, weights = values[valid], weights[valid] / weights[valid].sum()
    mean = weights @ values
    squares = weights.square()
    remaining = float(1.0 - squares.sum())
    variance = float(squares @ (values - mean).square())
    return float(mean), math.sqrt(variance / remaining) if remaining > 1e-12 else math.inf


def warn_of_failures(number: int, failed: Tensor) -> None:
    """Warn where the information gain of a candidate leaves out some of its outer samples (S,)."""
    if bool(failed.any()):
        warnings.warn(
            f"the expected information gain of candidate {number} leaves out {int(failed.sum())} of "
            f"{len(failed)} outer samples: their simulation failed, or no particle can explain the result.",
            stacklevel=3,
        )

"""Which particles play the truth, and what is said of an average over them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.schemes import systematic


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Particles that play the truth in turn.

    Attributes:
        particles: (H,) int64; one may come several times, with other noise.
        weights: (H,) of each, normalised.
    """

    particles: Tensor
    weights: Tensor

    def __len__(self) -> int:
        return len(self.particles)


def chosen_hypotheses(population: Population, budget: int | None) -> Hypotheses:
    """Every particle with weight once, by its weight; or `budget` of them, drawn systematically by weight.

    Raises:
        InputError: the population has no weight, or the budget is no whole number, 2 or more.
    """
    if not math.isfinite(population.log_total):
        raise InputError(
            "the belief has no weight: every particle's is zero, so that none can play the truth; widen the "
            "prior, use more particles, or check the measurements (`bcppl check`)."
        )
    weights = torch.softmax(population.log_weights, 0)
    if budget is None:
        particles = (weights > 0).nonzero().flatten()
        return Hypotheses(particles, weights[particles])
    budget = whole_number("{} hypotheses were asked for", budget, least=2)
    particles = systematic(population.log_weights, budget)
    return Hypotheses(particles, torch.full((budget,), 1.0 / budget, dtype=torch.float64))


def mean_and_error(values: Tensor, weights: Tensor) -> tuple[float, float]:
    """The weighted mean of values (H,) and its standard error, as if hypotheses were independent.

    They are not: every particle comes once, or as often as its weight asks. So the error is a little too
    large, by the share that differs between particles rather than between draws of the noise. NaN values are
    left out; of nothing the mean is NaN and the error infinite.
    """
    told = ~torch.isnan(values)
    if not bool(told.any()):
        return math.nan, math.inf
    values, weights = values[told], weights[told] / weights[told].sum()
    mean = weights @ values
    squares = weights.square()
    left = float(1.0 - squares.sum())
    error = math.sqrt(float(squares @ (values - mean).square()) / left) if left > 1e-12 else math.inf
    return float(mean), error

"""Tempering: letting a likelihood in by steps that the particles can follow.

The next exponent is the largest whose conditional effective sample size stays above a share of N, found by
bisection: Zhou, Johansen and Aston, Toward automatic model comparison: an adaptive sequential Monte Carlo
approach, JCGS 25, 2016, section 3.3.2 (CESS, eq. 3.16).
"""

from __future__ import annotations

import torch
from torch import Tensor

from bcppl.beliefs import normalised

SMALLEST_STEP = 1e-6


def conditional_effective_sample_size(log_weights: Tensor, log_factor: Tensor) -> float:
    """N (sum W w)^2 / sum W w^2 for weights W and incremental weights w = exp(log_factor), each (N,)."""
    factor = torch.exp(log_factor - log_factor.max())
    weights = normalised(log_weights)
    return float(len(log_weights) * (weights @ factor) ** 2 / (weights @ factor**2))


def next_exponent(log_weights: Tensor, log_likelihood: Tensor, exponent: float, share: float = 0.5) -> float:
    """The next exponent in (exponent, 1] for a likelihood (N,) let in up to `exponent`.

    Particles with a log-likelihood of -inf lose their weight at any exponent; the others are bisected over.
    """
    finite = torch.isfinite(log_likelihood) & (log_weights > -torch.inf)
    if not bool(finite.any()):
        return 1.0
    weights, likelihood = log_weights[finite], log_likelihood[finite]
    target = share * len(weights)

    def enough(step: float) -> bool:
        return conditional_effective_sample_size(weights, step * likelihood) >= target

    low, high = 0.0, 1.0 - exponent
    if enough(high):
        return 1.0
    # Fifty halvings: the sharpest likelihoods need steps of 1e-5 and less.
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return min(1.0, exponent + max(low, SMALLEST_STEP))

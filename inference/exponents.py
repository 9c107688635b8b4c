"""Exponents of tempering: the largest step that keeps a share of the conditional effective sample size.

Zhou, Johansen and Aston, Toward automatic model comparison: an adaptive sequential Monte Carlo approach, JCGS
25, 2016, section 3.3.2 (CESS, eq. 3.16).
"""

from __future__ import annotations

import torch
from torch import Tensor

from bcppl.beliefs import normalised

SMALLEST_STEP = 1e-6


def conditional_effective_sample_size(weights: Tensor, log_factor: Tensor) -> float:
    """N (sum W w)^2 / sum W w^2 for normalised weights W and w = exp(log_factor), each (N,)."""
    factor = torch.exp(log_factor - log_factor.max())
    weighted = weights * factor
    return float(len(weights) * weighted.sum() ** 2 / (weighted @ factor))


def next_exponent(log_weights: Tensor, log_likelihood: Tensor, exponent: float, share: float = 0.5) -> float:
    """The next exponent in (exponent, 1] for a likelihood (N,) tempered by `exponent`.

    Particles with a log-likelihood of -inf lose their weight at any exponent; the others are bisected over.
    """
    finite = torch.isfinite(log_likelihood) & (log_weights > -torch.inf)
    if not bool(finite.any()):
        return 1.0
    weights, likelihood = normalised(log_weights[finite]), log_likelihood[finite]
    target = share * len(weights)
    low, high = 0.0, 1.0 - exponent
    if conditional_effective_sample_size(weights, high * likelihood) >= target:
        return 1.0
    # The sharpest likelihoods need steps of 1e-5 and less; one part in ten thousand of a step is nothing.
    while high - low > 1e-4 * high and high > SMALLEST_STEP:
        middle = 0.5 * (low + high)
        if conditional_effective_sample_size(weights, middle * likelihood) >= target:
            low = middle
        else:
            high = middle
    return min(1.0, exponent + max(low, SMALLEST_STEP))

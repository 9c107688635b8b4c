"""Exponents of tempering: the largest step that keeps a share of the conditional effective sample size.

Zhou, Johansen and Aston, Toward automatic model comparison: an adaptive sequential Monte Carlo approach, JCGS
25, 2016, section 3.3.2 (CESS, eq. 3.16).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.beliefs import normalised
from bcppl.errors import InputError

# A step is at least this share of the exponent that is reached. The first is as small as a likelihood is
# sharp: about 1e-12 for a standard deviation of 1e-6 of the prior's.
LEAST_SHARE, LEAST_STEP = 1e-6, 1e-100


def resampled_below(share: float) -> float:
    """The share of the particles below which to resample where each exponent leaves just `share` of them.

    Rounding would decide at `share` itself. Particles that are not resampled there are not moved either, and
    the variance of the evidence was nine times as large for half the moves.
    """
    return 0.5 if share <= 0.0 else min(1.0, 1.01 * share)


def conditional_effective_sample_size(weights: Tensor, log_factor: Tensor) -> float:
    """N (sum W w)^2 / sum W w^2 for normalised weights W and w = exp(log_factor), each (N,)."""
    factor = torch.exp(log_factor - log_factor.max())
    weighted = weights * factor
    return float(len(weights) * weighted.sum() ** 2 / (weighted @ factor))


def fixed_exponents(exponents: Sequence[float]) -> tuple[float, ...]:
    """Exponents of tempering that are given: above 0, increasing, the last 1.

    Raises:
        InputError: they are others.
    """
    fixed = tuple(number_within("tempering is given the exponent {}", e) for e in exponents)
    if fixed[-1:] != (1.0,) or any(b <= a for a, b in pairwise((0.0, *fixed))):
        raise InputError(
            f"tempering is given the exponents {list(fixed)}; give increasing ones that end with 1."
        )
    return fixed


def next_exponent(log_weights: Tensor, log_likelihood: Tensor, exponent: float, share: float = 0.5) -> float:
    """The next exponent in (exponent, 1] for a likelihood (N,) tempered by `exponent`.

    It keeps a `share` of the conditional effective sample size; with a share of 0 it is 1. Particles with a
    log-likelihood of -inf lose their weight at any exponent; the others are bisected over.
    """
    finite = torch.isfinite(log_likelihood) & (log_weights > -torch.inf)
    if not bool(finite.any()):
        return 1.0
    weights, likelihood = normalised(log_weights[finite]), log_likelihood[finite]
    target = share * len(weights)

    def enough(step: float) -> bool:
        return conditional_effective_sample_size(weights, step * likelihood) >= target

    return exponent_after(exponent, enough)


def exponent_after(exponent: float, enough: Callable[[float], bool]) -> float:
    """The exponent in (exponent, 1] after the largest step that leaves enough, by bisection."""
    low, high = 0.0, 1.0 - exponent
    if enough(high):
        return 1.0
    least = max(LEAST_STEP, LEAST_SHARE * exponent)
    while high - low > 1e-4 * high and high > least:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return min(1.0, exponent + max(low, least))

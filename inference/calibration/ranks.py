"""Ranks of the truth among posterior draws, and whether they are uniform.

Saeilynoja, Buerkner and Vehtari, Graphical test for discrete uniformity and its applications in
goodness-of-fit evaluation and multiple sample comparison, Statistics and Computing 32, 2022.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from scipy.stats import binom
from torch import Tensor

from bcppl.arrays import Array, Indices

SIMULATIONS = 50_000  # of the statistic under uniform ranks: no p-value is below one in this many


def ranks(truth: Tensor, draws: Tensor) -> Tensor:
    """How many of L draws (L, Q) lie below the truth (Q,), int64 (Q,) from 0 to L; ties broken at random."""
    below, equal = (draws < truth).sum(dim=0), (draws == truth).sum(dim=0)
    return below + (torch.rand(len(truth), dtype=torch.float64) * (equal + 1)).floor().long()


def p_value(ranked: Indices, draws: int) -> float:
    """Of the hypothesis that ranks (K,) are uniform on 0 to L: by the simultaneous band of their ECDF.

    The smallest pointwise tail of the empirical distribution function (eq. 13), compared with that of
    uniform ranks.
    """
    gamma = _gamma(np.bincount(ranked, minlength=draws + 1))
    null = _uniform(len(ranked), draws)
    # Equal values of a discrete statistic differ by rounding.
    return float((1 + np.searchsorted(null, gamma * (1 + 1e-9), side="right")) / (1 + SIMULATIONS))


def band(count: int, draws: int, level: float = 0.95) -> tuple[Array, Array]:
    """Where the ECDF of `count` uniform ranks on 0 to L lies altogether with a probability of `level`.

    Returns:
        The lower and the upper bound (L,) of the share of ranks up to 0, 1, ... L - 1.
    """
    gamma = float(np.quantile(_uniform(count, draws), 1.0 - level))
    levels = (np.arange(draws) + 1.0) / (draws + 1.0)
    low, high = binom.ppf(0.5 * gamma, count, levels), binom.ppf(1.0 - 0.5 * gamma, count, levels)
    return np.asarray(low) / count, np.asarray(high) / count


@functools.cache
def _tails(count: int, draws: int) -> tuple[Array, Array]:
    """P(X <= r) and P(X >= r) of binomial counts r up to `count`, at all ranks but one: (L, count + 1)."""
    levels = (np.arange(draws) + 1.0)[:, None] / (draws + 1.0)
    counts = np.arange(count + 1)[None]
    low, high = binom.cdf(counts, count, levels), binom.sf(counts - 1, count, levels)
    return np.asarray(low), np.asarray(high)


def _gamma(frequencies: Indices) -> Array:
    """Gamma (...,) of how often each rank came (..., L + 1)."""
    count, draws = int(frequencies.reshape(-1, frequencies.shape[-1])[0].sum()), frequencies.shape[-1] - 1
    low, high = _tails(count, draws)
    below = frequencies.cumsum(axis=-1)[..., :-1]
    rows = np.arange(draws)
    return np.asarray(2.0 * np.minimum(low[rows, below], high[rows, below]).min(axis=-1))


@functools.cache
def _uniform(count: int, draws: int) -> Array:
    generator = np.random.default_rng(0)
    chances = np.full(draws + 1, 1.0 / (draws + 1))
    return np.sort(_gamma(generator.multinomial(count, chances, size=SIMULATIONS)))

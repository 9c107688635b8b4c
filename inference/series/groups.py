"""Weights and resampling of M groups of N particles: log weights (M, N), normalised within each group."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def equal(count: int) -> float:
    """The log weight of each of `count` equally weighted particles."""
    return -math.log(count)


def reweighed(log_weights: Tensor, log_factor: Tensor) -> tuple[Tensor, Tensor]:
    """The weights times factors (M * N,), normalised, and the log of each group's mean factor (M,).

    A group in which no particle keeps any weight has the mean -inf, and goes on with equal weights.
    """
    changed = log_weights + log_factor.reshape(log_weights.shape)
    total = torch.logsumexp(changed, dim=1)
    lost = total == -torch.inf
    changed = changed - total[:, None]
    if bool(lost.any()):
        changed[lost] = equal(log_weights.shape[1])
    return changed, total


def effective_sample_sizes(log_weights: Tensor) -> Tensor:
    """Of each group, (M,) (Kong, Liu and Wong, JASA 89, 1994)."""
    return 1.0 / torch.exp(2.0 * log_weights).sum(dim=1)


def systematic(log_weights: Tensor) -> Tensor:
    """Ancestors (M, N) within each group, by one uniform draw and equal steps in each."""
    groups, count = log_weights.shape
    offset = torch.rand(groups, 1, dtype=torch.float64)
    below = log_weights.exp().cumsum_(dim=1).mul_(count).sub_(offset).ceil_().clamp_(0, count)
    # The last particle with weight takes the rounding error at the end, not one without weight after it.
    below = torch.where(below >= below[:, -1:], float(count), below)
    first = torch.arange(groups)[:, None] * count
    # Point j of a group is beyond the intervals of all particles with j points or fewer below their ends.
    ends = (below.long() + first).flatten()
    chosen = torch.bincount(ends, minlength=groups * count)[: groups * count].cumsum(0)
    return chosen.reshape(groups, count) - first


def multinomial(log_weights: Tensor, count: int) -> Tensor:
    """Independent ancestors (M, count) within each group."""
    return torch.multinomial(log_weights.exp(), count, replacement=True)


def rows(ancestors: Tensor, count: int) -> Tensor:
    """Ancestors (M, K) within groups of `count` as indices (M * K,) of the batch, group after group."""
    return (ancestors + torch.arange(len(ancestors))[:, None] * count).flatten()

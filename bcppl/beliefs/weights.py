"""Weights of particles: normalised, counted, merged over copies of a pose, and weighted quantiles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from bcppl.errors import InputError, NotANumberError, NoWeightError


def normalised(log_weights: Tensor, impossible: Sequence[str] = ()) -> Tensor:
    """Weights (N,) that sum to 1, from log weights (N,).

    Raises:
        NoWeightError: no particle has any weight; names the `impossible` addresses (`Trace.impossible`).
        NotANumberError: a weight is NaN or +inf.
    """
    if bool((torch.isnan(log_weights) | (log_weights == torch.inf)).any()):
        raise NotANumberError(
            "a particle's weight is not a number; a kernel or a resampler gave NaN or +inf."
        )
    if not bool((log_weights > -torch.inf).any()):
        where = f" at {', '.join(map(repr, impossible))}" if impossible else ""
        raise NoWeightError(
            f"no particle has any weight left: the value{where} is impossible at every particle; widen the "
            "prior, use more particles, or check the values that are given."
        )
    return torch.softmax(log_weights, dim=0)


def effective_sample_size(log_weights: Tensor) -> float:
    """1 / sum of squared normalised weights (Kong, Liu and Wong, JASA 89, 1994)."""
    weights = torch.softmax(log_weights, dim=0)
    total = float(weights.dot(weights))
    if math.isnan(total):
        normalised(log_weights)  # raises the error
    return 1.0 / total


# The rounding error of a cumulative sum of weights.
ROUNDING = 1e-12


def weighted_quantiles(values: Tensor, weights: Tensor, probabilities: object) -> Tensor:
    """Quantiles of each column of weighted values.

    The mean of the left and the right inverse of the weighted distribution function (definition 2 of Hyndman
    and Fan, Sample quantiles in statistical packages, The American Statistician 50, 1996, for weights): a
    value that has weight, or midway between two where the function is flat. It does not change when every
    particle is doubled, and mirrors when the values do.

    Args:
        values: (N, *event).
        weights: (N,) normalised.
        probabilities: one or several; others than from 0 to 1 are refused.

    Returns:
        (Q, *event), or (*event) for a single probability; float64, in the units of the values.
    """
    levels = torch.as_tensor(probabilities, dtype=torch.float64)
    if not bool(((levels >= 0) & (levels <= 1)).all()):
        raise InputError(f"quantiles have the probabilities {levels.tolist()}; give numbers from 0 to 1.")
    carrying = weights > 0
    kept = values[carrying].double().reshape(int(carrying.sum()), -1)
    ordered, order = kept.sort(dim=0)
    cumulative = weights[carrying][order].cumsum(dim=0).T.contiguous()
    points = levels.reshape(1, -1).expand(len(cumulative), -1).contiguous()
    last = len(ordered) - 1
    left = torch.searchsorted(cumulative, points - ROUNDING).clamp_max(last)
    right = torch.searchsorted(cumulative, points + ROUNDING, right=True).clamp_max(last)
    quantiles = 0.5 * (ordered.gather(0, left.T) + ordered.gather(0, right.T))
    return quantiles.reshape((*levels.shape, *values.shape[1:]))


def merged(world_from_part: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct poses (K, 7) among those (N, 7) with weight, and their weights (K,).

    Resampling makes copies, and q and -q are the same pose.
    """
    carrying = weights > 0
    distinct, which = distinct_poses(world_from_part[carrying])
    return distinct, torch.zeros(len(distinct), dtype=weights.dtype).index_add_(0, which, weights[carrying])


def distinct_poses(world_from_part: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct poses (K, 7) among those (N, 7), and the index (N,) int64 of each among them."""
    turn = world_from_part[:, 3:]
    # One sign for a quaternion and its opposite: that of its first number that is not 0.
    first = (turn != 0).to(torch.int8).argmax(dim=1, keepdim=True)
    upright = torch.cat([world_from_part[:, :3], turn * turn.gather(1, first).sign()], dim=1) + 0.0
    distinct, which = torch.unique(upright, dim=0, return_inverse=True)
    return distinct, which

"""Copies of a pose merged into one particle, with the sum of their weights."""

from __future__ import annotations

import torch
from torch import Tensor


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

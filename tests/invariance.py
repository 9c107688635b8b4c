"""Whether moves leave expectations over exact draws as they were: what tests of kernels share."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def matrix(rows: Any) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def largest_z(before: Tensor, after: Tensor, still: float = 1e-12) -> float:
    """The largest |z| of the mean change of expectations (N, K) from exact draws, after some moves.

    Each draw is compared with itself, so that the change's own standard error is what it is measured in. What
    changes by no more than `still` does not count; if that is all, nothing was tested.
    """
    change = after - before
    moving = change.std(dim=0) > still
    assert bool(moving.any()), "nothing moved"
    z = change.mean(dim=0)[moving] / (change.std(dim=0)[moving] / math.sqrt(len(change)))
    return float(z.abs().max())

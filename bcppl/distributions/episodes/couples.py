"""Couples on a peg: contacts that press against each other, and so do not let it turn any further."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.special import log_ndtr

from bcppl import poses
from bcppl.devices import on_device_of
from bcppl.distributions.episodes.rows import TURN
from bcppl.distributions.manifold import Gaps

_TURNED, _SPREADS = 0.0004, 8.0  # m by which `TURN` moves a place as far off as the peg is wide; deviations
_SHARE, _WIDTH = 0.5, 0.15  # of it by which the gap falls, at least, and the deviation of that
_OTHERWISE = 0.05  # probability that a couple has another cause


class Witnessed(Gaps, Protocol):
    """Gaps of which it is known where they are."""

    @property
    def witness(self) -> Tensor:
        """(N, T, 3) on the part, in its frame."""


class MeasuresWitness(Protocol):
    """As `MeasuresGap`."""

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Witnessed: ...  # noqa: D102


def coupled(rows: Tensor) -> Tensor:
    """Those of rows (R, COLUMNS) that speak of couples, (E, COLUMNS)."""
    return torch.from_numpy(rows.numpy()[np.nan_to_num(rows.numpy()[:, TURN]).any(axis=1)])


def log_blocked(measure: MeasuresWitness, pose: Tensor, rows: Tensor, spread: Tensor) -> Tensor:
    """Log-probability that a peg is not free to turn against the couples on it.

    Of two contacts that press against each other one is where the gap is least. Turned about that the peg
    would penetrate at the other one; about a single contact it turns freely.

    Args:
        measure: of the gap.
        pose: (N, 7) world_from_part.
        rows: (E, COLUMNS) as of `coupled`.
        spread: (N, E) standard deviations of the gaps, m.

    Returns:
        (N,) the sum over rows.
    """
    rows = on_device_of(rows, pose)
    peg = rows[:, :7]
    gaps = measure(pose, peg)
    about = poses.transform(pose, gaps.witness)
    wider = (_SPREADS / _TURNED * spread).clamp(min=1.0)
    axis = (poses.rotation_matrix(peg) @ rows[:, TURN][..., None])[..., 0]
    turn = poses.from_rotation_vector(torch.zeros_like(about), wider[..., None] * axis)
    turned = peg.expand(len(pose), -1, -1).clone()
    turned[..., :3] -= about
    turned = poses.compose(turn, turned)
    turned[..., :3] += about
    fallen = (gaps.distance - measure(pose, turned).distance) / (wider * _TURNED)
    blocked = log_ndtr((fallen - _SHARE) / _WIDTH) + math.log1p(-_OTHERWISE)
    return torch.logaddexp(blocked, blocked.new_tensor(math.log(_OTHERWISE))).sum(dim=1)

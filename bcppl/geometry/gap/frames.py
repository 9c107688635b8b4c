"""Poses as rotation matrices and translations, and one in the frame of another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.compiled import compiled
from bcppl.geometry.gap.sharp_edges import dot


class Frames(NamedTuple):
    """Poses (...,) as rotation matrices (..., 3, 3) and translations (..., 3) in metres."""

    rotation: Array
    translation: Array


def frames_of(pose: Tensor) -> Frames:
    """Rotation matrices and translations of poses (..., 7)."""
    rotation = np.ascontiguousarray(poses.rotation_matrix(pose.detach()).numpy())
    return Frames(rotation, np.ascontiguousarray(pose.detach()[..., :3].numpy()))


@compiled
def relative(part: Frames, n: int, peg: Frames, own: int, t: int, turn: Array, shift: Array) -> None:
    """Set `turn` (3, 3) and `shift` (3,) to the peg's frame in the part's.

    Written out: numpy's product of two small matrices takes longer than all that is looked up there.
    """
    for i in range(3):
        shift[i] = 0.0
        for k in range(3):
            along = part.rotation[n, k, i]
            shift[i] += along * (peg.translation[own, t, k] - part.translation[n, k])
        for j in range(3):
            turn[i, j] = 0.0
            for k in range(3):
                turn[i, j] += part.rotation[n, k, i] * peg.rotation[own, t, k, j]


@compiled
def placed(point: Array, turn: Array, shift: Array, result: Array) -> None:
    """Set `result` (3,) to a point of the peg's frame in the part's."""
    for axis in range(3):
        result[axis] = dot(turn[axis], point) + shift[axis]

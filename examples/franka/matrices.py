"""Homogeneous matrices as libfranka has them: 16 numbers, column by column."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array


def pose_of(matrix: Sequence[float]) -> Array:
    """The pose (7,) of a matrix."""
    columns = np.reshape(matrix, (4, 4)).T
    return np.concatenate([columns[:3, 3], Rotation.from_matrix(columns[:3, :3]).as_quat()[[3, 0, 1, 2]]])


def matrix_of(pose: Array) -> list[float]:
    """The matrix of a pose (7,)."""
    columns = np.eye(4)
    columns[:3, :3], columns[:3, 3] = Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix(), pose[:3]
    return [float(each) for each in columns.T.ravel()]

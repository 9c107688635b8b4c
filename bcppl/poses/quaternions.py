"""Unit quaternions as scipy orders them, x y z w: the algebra beneath poses.

Everything is batched over the leading dimensions, and has a gradient everywhere but at a half turn. A
rotation vector is an axis times an angle in radians. Formulas: Solà, Quaternion kinematics for the
error-state Kalman filter, arXiv:1711.02508, 2017.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bcppl.devices import constant

# What a product of quaternions, and a rotation matrix row by row, take of the outer product of two
# quaternions (of one with itself): rows x x, x y, x z, x w, y x, ... w w. A small batch costs by operations.
_PRODUCT = torch.tensor(
    [
        *([0, 0, 0, -1], [0, 0, 1, 0], [0, -1, 0, 0], [1, 0, 0, 0]),
        *([0, 0, -1, 0], [0, 0, 0, -1], [1, 0, 0, 0], [0, 1, 0, 0]),
        *([0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]),
        *([1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]),
    ],
    dtype=torch.float64,
)
_XX, _YY, _ZZ, _WW = (
    [1, 0, 0, 0, -1, 0, 0, 0, -1],
    [-1, 0, 0, 0, 1, 0, 0, 0, -1],
    [-1, 0, 0, 0, -1, 0, 0, 0, 1],
    [1, 0, 0, 0, 1, 0, 0, 0, 1],
)
_XY, _XZ, _YZ = [0, 1, 0, 1, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, 1, 0, 1, 0]
_XW, _YW, _ZW = [0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]
_ROTATION = torch.tensor(
    [*(_XX, _XY, _XZ, _XW), *(_XY, _YY, _YZ, _YW), *(_XZ, _YZ, _ZZ, _ZW), *(_XW, _YW, _ZW, _WW)],
    dtype=torch.float64,
)


_CONJUGATE = torch.tensor([-1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
_RELATIVE = _CONJUGATE.repeat_interleave(4)[:, None] * _PRODUCT  # the same of the first one's conjugate


def product(first: Tensor, second: Tensor) -> Tensor:
    """The quaternion (..., 4) of the rotation `second` followed by the rotation `first`."""
    return _outer(first, second) @ constant(_PRODUCT, first)


def relative(first: Tensor, second: Tensor) -> Tensor:
    """The quaternion (..., 4) of the rotation that is followed by `first` to give the rotation `second`."""
    return _outer(first, second) @ constant(_RELATIVE, first)


def _outer(first: Tensor, second: Tensor) -> Tensor:
    """The products (..., 16) of every entry of the first with every entry of the second."""
    return (first.unsqueeze(-1) * second.unsqueeze(-2)).flatten(-2)


def conjugate(quaternion: Tensor) -> Tensor:
    """The quaternion (..., 4) of the inverse rotation."""
    return quaternion * constant(_CONJUGATE, quaternion)


def wrapped_angle(angle: Tensor) -> Tensor:
    """Angles (...,) in [-pi, pi), radians."""
    return torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi


def from_rotation_vector(vector: Tensor) -> Tensor:
    """The quaternion (..., 4) of a rotation vector (..., 3)."""
    half = torch.linalg.vector_norm(vector, dim=-1, keepdim=True) / 2
    return torch.cat([0.5 * torch.sinc(half / math.pi) * vector, torch.cos(half)], dim=-1)


def rotation_vector(quaternion: Tensor) -> Tensor:
    """The rotation vector (..., 3) of a quaternion (..., 4), of length pi at most."""
    vector, real = quaternion[..., :3], quaternion[..., 3:]
    half = torch.atan2(torch.linalg.vector_norm(vector, dim=-1, keepdim=True), real.abs())
    # The sine of half the angle over it is 2 / pi at least.
    return torch.where(real > 0, 2.0, -2.0) / torch.sinc(half / math.pi) * vector


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """The rotation matrix (..., 3, 3) of a unit quaternion (..., 4)."""
    rows = _outer(quaternion, quaternion) @ constant(_ROTATION, quaternion)
    return rows.reshape(*quaternion.shape[:-1], 3, 3)


def from_rotation_matrix(rotation: Tensor) -> Tensor:
    """The quaternion (..., 4) of a rotation matrix (..., 3, 3), of unit length also where that is rounded.

    Of four expressions for the quaternion, the one that divides by the largest number (Markley, Unit
    quaternion from rotation matrix, JGCD 31, 2008, eqs. 7 to 9).
    """
    outer = (rotation.flatten(-2) @ constant(_ROTATION, rotation).T).unflatten(-1, (4, 4))
    rows = outer + torch.eye(4, dtype=rotation.dtype)  # 4 q qT
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)[..., None, None]
    row = rows.gather(-2, largest.expand(*largest.shape[:-1], 4))[..., 0, :]
    return row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)

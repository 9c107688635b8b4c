"""Unit quaternions as scipy orders them, x y z w: the algebra beneath poses.

Everything is batched over the leading dimensions, and has a gradient everywhere but at a half turn. A
rotation vector is an axis times an angle in radians. Formulas: Solà, Quaternion kinematics for the
error-state Kalman filter, arXiv:1711.02508, 2017.
"""

from __future__ import annotations

import torch
from torch import Tensor


def product(first: Tensor, second: Tensor) -> Tensor:
    """The quaternion (..., 4) of the rotation `second` followed by the rotation `first`."""
    first, second = torch.broadcast_tensors(first, second)
    (u, a), (v, b) = (first[..., :3], first[..., 3:]), (second[..., :3], second[..., 3:])
    vector = a * v + b * u + torch.linalg.cross(u, v)
    real = first[..., 3] * second[..., 3] - (u * v).sum(dim=-1)
    return torch.cat([vector, real[..., None]], dim=-1)


def conjugate(quaternion: Tensor) -> Tensor:
    """The quaternion (..., 4) of the inverse rotation."""
    return quaternion * quaternion.new_tensor([-1.0, -1.0, -1.0, 1.0])


def from_rotation_vector(vector: Tensor) -> Tensor:
    """The quaternion (..., 4) of a rotation vector (..., 3)."""
    half = torch.linalg.vector_norm(vector, dim=-1, keepdim=True) / 2
    small = half < _threshold(half)
    sinc = torch.where(
        small, 1 - half**2 / 6 + half**4 / 120, torch.sin(half) / torch.where(small, 1.0, half)
    )
    return torch.cat([sinc / 2.0 * vector, torch.cos(half)], dim=-1)


def rotation_vector(quaternion: Tensor) -> Tensor:
    """The rotation vector (..., 3) of a quaternion (..., 4), of length pi at most."""
    quaternion = quaternion * torch.where(quaternion[..., 3:] > 0, 1.0, -1.0)
    vector, real = quaternion[..., :3], quaternion[..., 3:]
    half = torch.atan2(torch.linalg.vector_norm(vector, dim=-1, keepdim=True), real)
    small = half < _threshold(half)
    inverse_sinc = torch.where(
        small, 1 + half**2 / 6 + 7 * half**4 / 360, half / torch.where(small, 1.0, torch.sin(half))
    )
    return 2.0 * inverse_sinc * vector


def _threshold(angle: Tensor) -> float:
    """The angle below which the series of its sine is more exact than the sine over the angle."""
    return float(2.0 * torch.finfo(angle.dtype).eps ** (1 / 6))


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """The rotation matrix (..., 3, 3) of a unit quaternion (..., 4)."""
    x, y, z, w = quaternion.unbind(dim=-1)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, xz, yz, xw, yw, zw = x * y, x * z, y * z, x * w, y * w, z * w
    rows = (
        *(xx - yy - zz + ww, 2 * (xy - zw), 2 * (xz + yw)),
        *(2 * (xy + zw), -xx + yy - zz + ww, 2 * (yz - xw)),
        *(2 * (xz - yw), 2 * (yz + xw), -xx - yy + zz + ww),
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def from_rotation_matrix(rotation: Tensor) -> Tensor:
    """The quaternion (..., 4) of a rotation matrix (..., 3, 3), of unit length also where that is rounded.

    Of four expressions for the quaternion, the one that divides by the largest number (Markley, Unit
    quaternion from rotation matrix, JGCD 31, 2008, eqs. 7 to 9).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in rotation.unbind(-2))
    outer = (
        *(1 + xx - yy - zz, yx + xy, zx + xz, zy - yz),
        *(xy + yx, 1 + yy - zz - xx, zy + yz, xz - zx),
        *(xz + zx, yz + zy, 1 + zz - xx - yy, yx - xy),
        *(zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz),
    )  # 4 q qT
    rows = torch.stack(outer, dim=-1).unflatten(-1, (4, 4))
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)[..., None, None]
    row = rows.gather(-2, largest.expand(*largest.shape[:-1], 4))[..., 0, :]
    return row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)

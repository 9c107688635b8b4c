"""Fused loops over poses: what `bcppl.poses` computes where no gradient is asked for.

A small batch of poses costs by operations, of which one function of `bcppl.poses` takes ten to twenty; each
of these is one. Rows are poses `[x, y, z, qw, qx, qy, qz]`; an operand with one row goes with all.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import torch
from torch import Tensor

from bcppl.arrays import Array
from bcppl.compiled import compiled
from bcppl.devices import is_on_host

SMALL = 1e-4  # rad: below, a series' first term is exact to rounding

Kernel = Callable[[Array, Array, Array], None]


@functools.cache
def _has_warp() -> bool:
    return find_spec("warp") is not None


def fused(kernel: Kernel, first: Tensor, second: Tensor, *shape: int) -> Tensor | None:
    """A kernel's result (..., *shape) of operands (..., K) that broadcast; None where torch computes it.

    That is where a gradient is asked for, with numbers of another type, and on a GPU without Warp.
    """
    if first.requires_grad or second.requires_grad:
        return None
    if first.dtype is not torch.float64 or second.dtype is not torch.float64:
        return None
    there = not (is_on_host(first) and is_on_host(second))
    if there and (first.device != second.device or not _has_warp()):
        return None
    batch = first.shape[:-1]
    if batch != second.shape[:-1]:
        batch = torch.Size(np.broadcast_shapes(batch, second.shape[:-1]))  # torch's takes ten times as long
        first, second = (
            each if each.shape[:-1].numel() == 1 else each.expand(*batch, each.shape[-1])
            for each in (first, second)
        )
    if there:
        from bcppl.poses.warp import fused_there

        one, other = (each.reshape(-1, each.shape[-1]) for each in (first, second))
        rows = max(len(one), len(other)) if batch.numel() else 0
        return fused_there(kernel, one, other, rows, *shape).reshape(*batch, *shape)
    own, rest = first.numpy().reshape(-1, first.shape[-1]), second.numpy().reshape(-1, second.shape[-1])
    result = np.empty((max(len(own), len(rest)), *shape)) if batch.numel() else np.empty((0, *shape))
    kernel(own, rest, result)
    return torch.from_numpy(result.reshape(*batch, *shape))


@compiled
def _turn(quaternion: Array, turn: tuple[float, float, float, float], result: Array) -> None:
    """Set `result` (4,) to a quaternion w x y z times another, of unit length."""
    a, b, c, d = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    w, x, y, z = turn
    result[0] = a * w - b * x - c * y - d * z
    result[1] = a * x + b * w + c * z - d * y
    result[2] = a * y - b * z + c * w + d * x
    result[3] = a * z + b * y - c * x + d * w
    length = math.sqrt(result[0] ** 2 + result[1] ** 2 + result[2] ** 2 + result[3] ** 2)
    for k in range(4):
        result[k] /= length


@compiled
def _rotate(quaternion: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector turned by a unit quaternion w x y z."""
    w, a, b, c = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    p, q, r = 2.0 * (b * z - c * y), 2.0 * (c * x - a * z), 2.0 * (a * y - b * x)
    return x + w * p + b * r - c * q, y + w * q + c * p - a * r, z + w * r + a * q - b * p


@compiled
def retract(pose: Array, tangent: Array, result: Array) -> None:
    """Poses (N, 7) moved by tangents (N, 6)."""
    one, other = len(pose) == 1, len(tangent) == 1
    for n in range(len(result)):
        own, step = pose[0 if one else n], tangent[0 if other else n]
        for k in range(3):
            result[n, k] = own[k] + step[k]
        half = 0.5 * math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
        share = 0.5 * math.sin(half) / half if half > 0.0 else 0.5
        turn = (math.cos(half), share * step[3], share * step[4], share * step[5])
        _turn(own[3:], turn, result[n, 3:])


@compiled
def local(pose: Array, goal: Array, result: Array) -> None:
    """The tangents (N, 6) from poses (N, 7) to others."""
    one, other = len(pose) == 1, len(goal) == 1
    for n in range(len(result)):
        own, there = pose[0 if one else n], goal[0 if other else n]
        for axis in range(3):
            result[n, axis] = there[axis] - own[axis]
        a, b, c, d = own[3], -own[4], -own[5], -own[6]
        w, x, y, z = there[3], there[4], there[5], there[6]
        real = a * w - b * x - c * y - d * z
        i = a * x + b * w + c * z - d * y
        j = a * y - b * z + c * w + d * x
        k = a * z + b * y - c * x + d * w
        half = math.atan2(math.sqrt(i * i + j * j + k * k), abs(real))
        share = (2.0 if real > 0.0 else -2.0) * (half / math.sin(half) if half > 0.0 else 1.0)
        result[n, 3], result[n, 4], result[n, 5] = share * i, share * j, share * k


@compiled
def _bent(
    w: tuple[float, float, float], v: tuple[float, float, float], once: float, twice: float
) -> tuple[float, float, float]:
    """The sum of v, `once` times w x v, and `twice` times w x (w x v)."""
    a, b, c = w[1] * v[2] - w[2] * v[1], w[2] * v[0] - w[0] * v[2], w[0] * v[1] - w[1] * v[0]
    x, y, z = w[1] * c - w[2] * b, w[2] * a - w[0] * c, w[0] * b - w[1] * a
    return v[0] + once * a + twice * x, v[1] + once * b + twice * y, v[2] + once * c + twice * z


@compiled
def exp(pose: Array, twist: Array, result: Array) -> None:
    """Poses (N, 7) moved by constant twists (N, 6)."""
    retract(pose, twist, result)
    one, other = len(pose) == 1, len(twist) == 1
    for n in range(len(result)):
        own, step = pose[0 if one else n], twist[0 if other else n]
        turn = _rotate(own[3:], step[3], step[4], step[5])
        angle = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
        once, twice = 0.5, 1.0 / 6.0
        if angle > SMALL:
            once = (1.0 - math.cos(angle)) / angle**2
            twice = (angle - math.sin(angle)) / angle**3
        moved = _bent(turn, (step[0], step[1], step[2]), once, twice)
        for axis in range(3):
            result[n, axis] = own[axis] + moved[axis]


@compiled
def log(pose: Array, goal: Array, result: Array) -> None:
    """The twists (N, 6) from poses (N, 7) to others."""
    local(pose, goal, result)
    one = len(pose) == 1
    for n in range(len(result)):
        step = result[n]
        turn = _rotate(pose[0 if one else n, 3:], step[3], step[4], step[5])
        angle = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
        twice = 1.0 / 12.0
        if angle > SMALL:
            twice = 1.0 / angle**2 - 0.5 / (angle * math.tan(0.5 * angle))
        moved = _bent(turn, (step[0], step[1], step[2]), -0.5, twice)
        for axis in range(3):
            step[axis] = moved[axis]


@compiled
def compose(first: Array, second: Array, result: Array) -> None:
    """Poses (N, 7) one after the other."""
    one, other = len(first) == 1, len(second) == 1
    for n in range(len(result)):
        own, next_ = first[0 if one else n], second[0 if other else n]
        x, y, z = _rotate(own[3:], next_[0], next_[1], next_[2])
        result[n, 0], result[n, 1], result[n, 2] = own[0] + x, own[1] + y, own[2] + z
        _turn(own[3:], (next_[3], next_[4], next_[5], next_[6]), result[n, 3:])


@compiled
def inverse(pose: Array, _: Array, result: Array) -> None:
    """The inverse of poses (N, 7)."""
    for n in range(len(result)):
        own = pose[n]
        result[n, 3] = own[3]
        for k in range(4, 7):
            result[n, k] = -own[k]
        x, y, z = _rotate(result[n, 3:], own[0], own[1], own[2])
        result[n, 0], result[n, 1], result[n, 2] = -x, -y, -z


@compiled
def rotation_matrix(pose: Array, _: Array, result: Array) -> None:
    """The rotations (N, 3, 3) of poses (N, 7)."""
    for n in range(len(result)):
        w, x, y, z = pose[n, 3], pose[n, 4], pose[n, 5], pose[n, 6]
        result[n, 0, 0], result[n, 0, 1], result[n, 0, 2] = (
            w * w + x * x - y * y - z * z,
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        )
        result[n, 1, 0], result[n, 1, 1], result[n, 1, 2] = (
            2.0 * (x * y + w * z),
            w * w - x * x + y * y - z * z,
            2.0 * (y * z - w * x),
        )
        result[n, 2, 0], result[n, 2, 1], result[n, 2, 2] = (
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            w * w - x * x - y * y + z * z,
        )

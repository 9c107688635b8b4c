"""The loops of `bcppl.poses.kernels` by Warp, a thread for each row: one launch in place of twenty."""

from __future__ import annotations

from typing import Any

import warp as wp
from torch import Tensor

from bcppl import warp_arrays
from bcppl.poses import kernels

SMALL = wp.constant(wp.float64(kernels.SMALL))
ZERO, HALF, ONE, TWO = (wp.constant(wp.float64(x)) for x in (0.0, 0.5, 1.0, 2.0))
_THIRD, _TWELFTH = wp.constant(wp.float64(1.0 / 6.0)), wp.constant(wp.float64(1.0 / 12.0))


@wp.func  # type: ignore[untyped-decorator]
def _shift(values: wp.array2d[wp.float64], n: int, first: int) -> wp.vec3d:
    return wp.vec3d(values[n, first], values[n, first + 1], values[n, first + 2])


@wp.func  # type: ignore[untyped-decorator]
def _turn(values: wp.array2d[wp.float64], n: int) -> wp.vec4d:
    return wp.vec4d(values[n, 3], values[n, 4], values[n, 5], values[n, 6])


@wp.func  # type: ignore[untyped-decorator]
def _product(q: wp.vec4d, r: wp.vec4d) -> wp.vec4d:
    return wp.vec4d(
        q[0] * r[0] - q[1] * r[1] - q[2] * r[2] - q[3] * r[3],
        q[0] * r[1] + q[1] * r[0] + q[2] * r[3] - q[3] * r[2],
        q[0] * r[2] + q[2] * r[0] + q[3] * r[1] - q[1] * r[3],
        q[0] * r[3] + q[1] * r[2] - q[2] * r[1] + q[3] * r[0],
    )


@wp.func  # type: ignore[untyped-decorator]
def _rotated(q: wp.vec4d, v: wp.vec3d) -> wp.vec3d:
    axis = wp.vec3d(q[1], q[2], q[3])
    twice = TWO * wp.cross(axis, v)
    return v + q[0] * twice + wp.cross(axis, twice)


@wp.func  # type: ignore[untyped-decorator]
def _put(result: wp.array2d[wp.float64], n: int, shift: wp.vec3d, turn: wp.vec4d) -> None:
    unit = wp.normalize(turn)
    for k in range(3):
        result[n, k] = shift[k]
    for k in range(4):
        result[n, 3 + k] = unit[k]


@wp.func  # type: ignore[untyped-decorator]
def _retracted(
    pose: wp.array2d[wp.float64], n: int, shift: wp.vec3d, w: wp.vec3d, result: wp.array2d[wp.float64], m: int
) -> None:
    half = HALF * wp.length(w)
    share = HALF
    if half > ZERO:
        share = HALF * wp.sin(half) / half
    turn = wp.vec4d(wp.cos(half), share * w[0], share * w[1], share * w[2])
    _put(result, m, _shift(pose, n, 0) + shift, _product(_turn(pose, n), turn))


@wp.func  # type: ignore[untyped-decorator]
def _turned_by(pose: wp.array2d[wp.float64], n: int, goal: wp.array2d[wp.float64], m: int) -> wp.vec3d:
    q = _turn(pose, n)
    turn = _product(wp.vec4d(q[0], -q[1], -q[2], -q[3]), _turn(goal, m))
    axis = wp.vec3d(turn[1], turn[2], turn[3])
    half = wp.atan2(wp.length(axis), wp.abs(turn[0]))
    share = TWO
    if half > ZERO:
        share = TWO * half / wp.sin(half)
    if turn[0] <= ZERO:
        share = -share
    return share * axis


@wp.func  # type: ignore[untyped-decorator]
def _bent(w: wp.vec3d, v: wp.vec3d, once: wp.float64, twice: wp.float64) -> wp.vec3d:
    across = wp.cross(w, v)
    return v + once * across + twice * wp.cross(w, across)


@wp.kernel  # type: ignore[untyped-decorator]
def retract(
    first: wp.array2d[wp.float64], second: wp.array2d[wp.float64], result: wp.array2d[wp.float64]
) -> None:
    """Poses (N, 7) moved by tangents (N, 6)."""
    m = wp.tid()
    n = wp.min(m, first.shape[0] - 1)
    k = wp.min(m, second.shape[0] - 1)
    _retracted(first, n, _shift(second, k, 0), _shift(second, k, 3), result, m)


@wp.kernel  # type: ignore[untyped-decorator]
def exp(
    first: wp.array2d[wp.float64], second: wp.array2d[wp.float64], result: wp.array2d[wp.float64]
) -> None:
    """Poses (N, 7) moved by constant twists (N, 6)."""
    m = wp.tid()
    n = wp.min(m, first.shape[0] - 1)
    k = wp.min(m, second.shape[0] - 1)
    w = _shift(second, k, 3)
    angle = wp.length(w)
    once = HALF
    twice = _THIRD
    if angle > SMALL:
        once = (ONE - wp.cos(angle)) / (angle * angle)
        twice = (angle - wp.sin(angle)) / (angle * angle * angle)
    moved = _bent(_rotated(_turn(first, n), w), _shift(second, k, 0), once, twice)
    _retracted(first, n, moved, w, result, m)


@wp.kernel  # type: ignore[untyped-decorator]
def local(
    first: wp.array2d[wp.float64], second: wp.array2d[wp.float64], result: wp.array2d[wp.float64]
) -> None:
    """The tangents (N, 6) from poses (N, 7) to others."""
    m = wp.tid()
    n = wp.min(m, first.shape[0] - 1)
    k = wp.min(m, second.shape[0] - 1)
    shift = _shift(second, k, 0) - _shift(first, n, 0)
    turn = _turned_by(first, n, second, k)
    for axis in range(3):
        result[m, axis] = shift[axis]
        result[m, 3 + axis] = turn[axis]


@wp.kernel  # type: ignore[untyped-decorator]
def log(
    first: wp.array2d[wp.float64], second: wp.array2d[wp.float64], result: wp.array2d[wp.float64]
) -> None:
    """The twists (N, 6) from poses (N, 7) to others."""
    m = wp.tid()
    n = wp.min(m, first.shape[0] - 1)
    k = wp.min(m, second.shape[0] - 1)
    w = _turned_by(first, n, second, k)
    angle = wp.length(w)
    twice = _TWELFTH
    if angle > SMALL:
        twice = ONE / (angle * angle) - HALF / (angle * wp.tan(HALF * angle))
    shift = _shift(second, k, 0) - _shift(first, n, 0)
    moved = _bent(_rotated(_turn(first, n), w), shift, -HALF, twice)
    for axis in range(3):
        result[m, axis] = moved[axis]
        result[m, 3 + axis] = w[axis]


@wp.kernel  # type: ignore[untyped-decorator]
def compose(
    first: wp.array2d[wp.float64], second: wp.array2d[wp.float64], result: wp.array2d[wp.float64]
) -> None:
    """Poses (N, 7) one after the other."""
    m = wp.tid()
    n = wp.min(m, first.shape[0] - 1)
    k = wp.min(m, second.shape[0] - 1)
    q = _turn(first, n)
    _put(result, m, _shift(first, n, 0) + _rotated(q, _shift(second, k, 0)), _product(q, _turn(second, k)))


@wp.kernel  # type: ignore[untyped-decorator]
def inverse(
    first: wp.array2d[wp.float64], second: wp.array2d[wp.float64], result: wp.array2d[wp.float64]
) -> None:
    """The inverse of poses (N, 7)."""
    m = wp.tid()
    q = _turn(first, m)
    back = wp.vec4d(q[0], -q[1], -q[2], -q[3])
    shift = -_rotated(back, _shift(first, m, 0))
    for k in range(3):
        result[m, k] = shift[k]
    for k in range(4):
        result[m, 3 + k] = back[k]


@wp.kernel  # type: ignore[untyped-decorator]
def rotation_matrix(
    first: wp.array2d[wp.float64], second: wp.array2d[wp.float64], result: wp.array2d[wp.float64]
) -> None:
    """The rotations (N, 9) of poses (N, 7), row by row."""
    m = wp.tid()
    q = _turn(first, m)
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    result[m, 0] = w * w + x * x - y * y - z * z
    result[m, 1] = TWO * (x * y - w * z)
    result[m, 2] = TWO * (x * z + w * y)
    result[m, 3] = TWO * (x * y + w * z)
    result[m, 4] = w * w - x * x + y * y - z * z
    result[m, 5] = TWO * (y * z - w * x)
    result[m, 6] = TWO * (x * z - w * y)
    result[m, 7] = TWO * (y * z + w * x)
    result[m, 8] = w * w - x * x - y * y + z * z


_OF: dict[Any, Any] = {
    kernels.retract: retract,
    kernels.exp: exp,
    kernels.local: local,
    kernels.log: log,
    kernels.compose: compose,
    kernels.inverse: inverse,
    kernels.rotation_matrix: rotation_matrix,
}


def fused_there(kernel: Any, first: Tensor, second: Tensor, rows: int, *shape: int) -> Tensor:
    """A kernel's result (rows, *shape) of operands (1 or rows, K) on a GPU."""
    result = first.new_empty(rows, *shape)
    if rows:
        written = [(result.view(rows, -1), wp.float64)]
        warp_arrays.launch(_OF[kernel], rows, [(first, wp.float64), (second, wp.float64)], written)
    return result

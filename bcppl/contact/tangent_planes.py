"""The point nearest to another one that is on the free side of a few planes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bcppl.compiled import compiled

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_ROUNDING = 2e-8  # m: no violation of a plane


@compiled
def nearest_allowed(point: Array, normals: Array, offsets: Array, kept: Mask) -> Array:
    """The point on the free side of kept planes that is nearest to a point, by trying which ones hold it."""
    count = len(offsets)
    best, least = point.copy(), np.inf
    if _violation(point, normals, offsets, kept) <= _ROUNDING:
        return best
    least_violation = np.inf
    for a in range(count):
        if not kept[a]:
            continue
        for b in range(a, count):
            if not kept[b]:
                continue
            for c in range(b, count):
                if not kept[c]:
                    continue
                tried, sound = _on_planes(point, normals, offsets, a, b, c)
                if not sound:
                    continue
                off = ((tried - point) ** 2).sum()
                violation = _violation(tried, normals, offsets, kept)
                if violation <= _ROUNDING:
                    if off < least:
                        best, least = tried, off
                elif least == np.inf and violation < least_violation:
                    best, least_violation = tried, violation
    return best


@compiled
def _violation(point: Array, normals: Array, offsets: Array, kept: Mask) -> float:
    worst = 0.0
    for p in range(len(offsets)):
        if kept[p]:
            worst = max(worst, offsets[p] - (normals[p] * point).sum())
    return worst


@compiled
def _on_planes(point: Array, normals: Array, offsets: Array, a: int, b: int, c: int) -> tuple[Array, bool]:
    """The point of up to three planes nearest to a point: projections by Gram and Schmidt."""
    chosen = (a, b, c)
    basis, values = np.zeros((3, 3)), np.zeros(3)
    rank = 0
    for k in range(3):
        if k > 0 and chosen[k] == chosen[k - 1]:
            continue
        normal = normals[chosen[k]].copy()
        value = offsets[chosen[k]]
        for r in range(rank):
            share = (normal * basis[r]).sum()
            normal -= share * basis[r]
            value -= share * values[r]
        length = np.sqrt((normal * normal).sum())
        if length < 1e-3:
            return point, False
        basis[rank], values[rank] = normal / length, value / length
        rank += 1
    found = point.copy()
    for r in range(rank):
        found += (values[r] - (basis[r] * found).sum()) * basis[r]
    return found, True

"""Projection of a point onto an intersection of half-spaces."""

from __future__ import annotations

import numpy as np

from bcppl.arrays import Array, Mask
from bcppl.compiled import compiled

_ROUNDING = 2e-8  # m: no violation of a constraint


@compiled
def project_onto_half_spaces(point: Array, normals: Array, offsets: Array, active: Mask) -> Array:
    """The point nearest to another one with normals @ x >= offsets for the active constraints.

    Every set of up to three constraints is tried as the one that holds with equality. Where no such point
    satisfies all, the result is the one that violates them least.
    """
    count = len(offsets)
    best, least = point.copy(), np.inf
    if _violation(point, normals, offsets, active) <= _ROUNDING:
        return best
    least_violation = np.inf
    for a in range(count):
        if not active[a]:
            continue
        for b in range(a, count):
            if not active[b]:
                continue
            for c in range(b, count):
                if not active[c]:
                    continue
                projected, independent = _on_planes(point, normals, offsets, a, b, c)
                if not independent:
                    continue
                off = ((projected - point) ** 2).sum()
                violation = _violation(projected, normals, offsets, active)
                if violation <= _ROUNDING:
                    if off < least:
                        best, least = projected, off
                elif least == np.inf and violation < least_violation:
                    best, least_violation = projected, violation
    return best


@compiled
def _violation(point: Array, normals: Array, offsets: Array, active: Mask) -> float:
    worst = 0.0
    for p in range(len(offsets)):
        if active[p]:
            worst = max(worst, offsets[p] - (normals[p] * point).sum())
    return worst


@compiled
def _on_planes(point: Array, normals: Array, offsets: Array, a: int, b: int, c: int) -> tuple[Array, bool]:
    """A point projected onto up to three planes, by Gram-Schmidt, and whether they are independent."""
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
    projected = point.copy()
    for r in range(rank):
        projected += (values[r] - (basis[r] * projected).sum()) * basis[r]
    return projected, True

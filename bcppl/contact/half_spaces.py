"""Projection of a point onto an intersection of half-spaces."""

from __future__ import annotations

import numpy as np

from bcppl.arrays import Array, Mask
from bcppl.compiled import compiled
from bcppl.geometry.gap.sharp_edges import dot

_ROUNDING = 2e-8  # m: no violation of a constraint


@compiled
def project_onto_half_spaces(point: Array, normals: Array, offsets: Array, active: Mask, best: Array) -> None:
    """Set `best` (3,) to the point nearest to another one with normals @ x >= offsets where they are active.

    Every set of up to three constraints is tried as the one that holds with equality. Where no such point
    satisfies all, the result is the one that violates them least.
    """
    count = len(offsets)
    best[:] = point
    if _violation(point, normals, offsets, active) <= _ROUNDING:
        return
    projected, basis, values = np.empty(3), np.empty((3, 3)), np.empty(3)
    least, least_violation = np.inf, np.inf
    for a in range(count):
        if not active[a]:
            continue
        for b in range(a, count):
            if not active[b]:
                continue
            for c in range(b, count):
                if not active[c]:
                    continue
                if not _on_planes(point, normals, offsets, (a, b, c), projected, basis, values):
                    continue
                off = 0.0
                for axis in range(3):
                    off += (projected[axis] - point[axis]) ** 2
                violation = _violation(projected, normals, offsets, active)
                if violation <= _ROUNDING:
                    if off < least:
                        best[:], least = projected, off
                elif least == np.inf and violation < least_violation:
                    best[:], least_violation = projected, violation


@compiled
def _violation(point: Array, normals: Array, offsets: Array, active: Mask) -> float:
    worst = 0.0
    for p in range(len(offsets)):
        if active[p]:
            worst = max(worst, offsets[p] - dot(normals[p], point))
    return worst


@compiled
def _on_planes(
    point: Array,
    normals: Array,
    offsets: Array,
    chosen: tuple[int, int, int],
    projected: Array,
    basis: Array,
    values: Array,
) -> bool:
    """Project a point onto up to three planes, by Gram-Schmidt; False where they are not independent.

    `basis` (3, 3) and `values` (3,) are room for that.
    """
    rank = 0
    for k in range(3):
        if k > 0 and chosen[k] == chosen[k - 1]:
            continue
        basis[rank], values[rank] = normals[chosen[k]], offsets[chosen[k]]
        for r in range(rank):
            share = dot(basis[rank], basis[r])
            values[rank] -= share * values[r]
            for axis in range(3):
                basis[rank, axis] -= share * basis[r, axis]
        length = np.sqrt(dot(basis[rank], basis[rank]))
        if length < 1e-3:
            return False
        values[rank] /= length
        for axis in range(3):
            basis[rank, axis] /= length
        rank += 1
    projected[:] = point
    for r in range(rank):
        off = values[r] - dot(basis[r], projected)
        for axis in range(3):
            projected[axis] += off * basis[r, axis]
    return True

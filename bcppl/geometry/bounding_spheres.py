"""Bounding spheres of compact groups of points, by which a minimum over all of them is found early."""

from __future__ import annotations

import numpy as np

from bcppl.arrays import Array, Indices

GROUP = 16  # members, at most


def compact_groups(points: Array) -> list[Indices]:
    """Indices of points (P, 3) in groups of at most sixteen, by bisection across their widest axis."""
    return _bisected(points, np.arange(len(points)))


def _bisected(points: Array, members: Indices) -> list[Indices]:
    if len(members) <= GROUP:
        return [members] if len(members) else []
    return [group for half in halves(points, members) for group in _bisected(points, half)]


def halves(points: Array, members: Indices) -> tuple[Indices, Indices]:
    """Members of points (P, 3) in two halves, across the axis along which they are widest."""
    axis = int(np.ptp(points[members], axis=0).argmax())
    order = members[np.argsort(points[members, axis], kind="stable")]
    return order[: len(order) // 2], order[len(order) // 2 :]


def bounding_sphere(points: Array) -> Array:
    """Centre and radius (4,) of a bounding sphere of points (P, 3)."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return np.array([*middle, np.linalg.norm(points - middle, axis=1).max()])

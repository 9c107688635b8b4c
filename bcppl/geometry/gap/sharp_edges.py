"""The sharp convex edges of a part, and the minimum distance of a segment of one to a convex solid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bcppl.arrays import Array, Indices
from bcppl.compiled import compiled
from bcppl.geometry.bounding_spheres import bounding_sphere, compact_groups
from bcppl.geometry.parts import Part

_LONGEST = 0.008  # m; longer edges are subdivided
_SHARP = np.radians(5.0)  # smallest dihedral angle
_ROUNDS = 12  # cutting planes, at most
_EXACT = 1e-8  # m
_CANCELLED = 0.1  # length of a sum of unit normals below which they are opposite


class SharpEdges(NamedTuple):
    """Segments of edges with a two-level hierarchy of bounding spheres; those of a group are contiguous.

    Attributes:
        ends: (E, 2, 3) end points in the part's frame, metres.
        spheres: (E, 4) centre and radius of each segment's bounding sphere.
        groups: (G, 4) of each group's bounding sphere.
        stops: (G,) index after each group's last segment.
    """

    ends: Array
    spheres: Array
    groups: Array
    stops: Indices


def sharp_edges(part: Part) -> SharpEdges:
    """The sharp convex edges of a part, in groups of at most sixteen segments."""
    mesh = part.mesh.copy()
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    sharp = mesh.face_adjacency_convex & (mesh.face_adjacency_angles > _SHARP)
    segments = [np.empty((0, 2, 3))]
    for start, stop in np.asarray(mesh.vertices)[mesh.face_adjacency_edges[sharp]]:
        count = max(1, int(np.ceil(np.linalg.norm(stop - start) / _LONGEST)))
        points = np.linspace(start, stop, count + 1)
        segments.append(np.stack([points[:-1], points[1:]], axis=1))
    ends = np.concatenate(segments)
    members = compact_groups(ends.mean(axis=1))
    if not members:
        return SharpEdges(ends, np.empty((0, 4)), np.empty((0, 4)), np.empty(0, dtype=np.int64))
    ends = ends[np.concatenate(members)]
    stops = np.cumsum([len(group) for group in members])
    groups = np.stack([bounding_sphere(group.reshape(-1, 3)) for group in np.split(ends, stops[:-1])])
    return SharpEdges(ends, np.stack([bounding_sphere(each) for each in ends]), groups, stops)


# Compiled code slices a row more slowly than it looks its numbers up: these are given the array and the row.


@compiled
def may_be_nearer(spheres: Array, row: int, turn: Array, shift: Array, box: Array, least: float) -> bool:
    """Whether a sphere in the part's frame may come closer than `least` to the peg's bounding box."""
    reach = spheres[row, 3] + least
    x, y, z = spheres[row, 0] - shift[0], spheres[row, 1] - shift[1], spheres[row, 2] - shift[2]
    for axis in range(3):
        along = turn[0, axis] * x + turn[1, axis] * y + turn[2, axis] * z
        if along < box[0, axis] - reach or along > box[1, axis] + reach:
            return False
    return True


@compiled
def dot(first: Array, second: Array) -> float:
    """The dot product of two vectors (3,); numpy's own is slow on so few numbers."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@compiled
def to_peg_frame(turn: Array, shift: Array, points: Array, row: int, result: Array) -> None:
    """Set `result` (3,) to a point of the part's frame in the peg's."""
    x, y, z = points[row, 0] - shift[0], points[row, 1] - shift[1], points[row, 2] - shift[2]
    for axis in range(3):
        result[axis] = turn[0, axis] * x + turn[1, axis] * y + turn[2, axis] * z


@compiled
def is_separated(point: Array, planes: Array, reach: float) -> bool:
    """Whether a plane of a convex solid separates it from a point by more than `reach`."""
    x, y, z = point
    for f in range(len(planes)):
        if planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z - planes[f, 3] > reach:
            return True
    return False


@compiled
def segment_distance(
    start: Array, stop: Array, planes: Array, least: float, normal: Array
) -> tuple[float, float]:
    """The signed distance of a segment to a convex solid and its witness point, by cutting planes.

    The largest signed distance of a point to the solid's planes is convex and piecewise linear along the
    segment. Where its minimum lies between two planes, the segment crosses the edge between them: the
    distance is along the common normal of both edges, a convex combination of the planes' normals. It is
    negative inside, and exact only if less than `least`. Planes (P, 4) are outward unit normals and offsets;
    the witness point is a parameter along the segment, from 0 to 1, and `normal` (3,) is set to the solid's
    outward unit normal there.
    """
    low, high = 0.0, 1.0
    at_low, plane_low = _farthest_plane(start, stop, low, planes)
    slope_low = _slope(planes, plane_low, start, stop)
    if slope_low >= 0.0:
        normal[:] = planes[plane_low, :3]
        return at_low, low
    at_high, plane_high = _farthest_plane(start, stop, high, planes)
    slope_high = _slope(planes, plane_high, start, stop)
    if slope_high <= 0.0:
        normal[:] = planes[plane_high, :3]
        return at_high, high
    share, bound = low, at_low
    for _ in range(_ROUNDS):
        share = (at_low - at_high + slope_high * high - slope_low * low) / (slope_high - slope_low)
        share = min(max(share, low), high)
        bound = at_low + slope_low * (share - low)
        # The bound is a lower one: along a combined normal the distance is longer.
        if bound >= least and bound >= 0.0:
            return bound, share
        here, plane = _farthest_plane(start, stop, share, planes)
        if here <= bound + _EXACT:
            break
        slope = _slope(planes, plane, start, stop)
        if slope < 0.0:
            low, at_low, slope_low, plane_low = share, here, slope, plane
        else:
            high, at_high, slope_high, plane_high = share, here, slope, plane
    mixed = slope_high / (slope_high - slope_low)
    normal[:] = mixed * planes[plane_low, :3] + (1.0 - mixed) * planes[plane_high, :3]
    length = np.sqrt((normal * normal).sum())
    if length < _CANCELLED:  # opposite planes: the segment crosses a thin solid
        normal[:] = planes[plane_low, :3]
        return bound, share
    normal /= length
    return bound / length, share


@compiled
def _farthest_plane(start: Array, stop: Array, share: float, planes: Array) -> tuple[float, int]:
    """The largest signed distance of a point of a segment to the planes of a convex solid, and that plane."""
    x = start[0] + share * (stop[0] - start[0])
    y = start[1] + share * (stop[1] - start[1])
    z = start[2] + share * (stop[2] - start[2])
    farthest, plane = -np.inf, 0
    for f in range(len(planes)):
        away = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z - planes[f, 3]
        if away > farthest:
            farthest, plane = away, f
    return farthest, plane


@compiled
def _slope(planes: Array, plane: int, start: Array, stop: Array) -> float:
    """By how much the distance to a plane is longer at the end of a segment than at its start."""
    return (
        planes[plane, 0] * (stop[0] - start[0])
        + planes[plane, 1] * (stop[1] - start[1])
        + planes[plane, 2] * (stop[2] - start[2])
    )

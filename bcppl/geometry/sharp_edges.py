"""The edges at which a part is sharp and convex, and how near a stretch of one comes to a convex solid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bcppl.compiled import compiled
from bcppl.geometry.parts import Part

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]

_RUN = 0.008  # m; longer edges are cut
_SHARP = np.radians(5.0)
_GROUP = 16
_ROUNDS = 12
_EXACT = 1e-8  # m
_CANCELLED = 0.1


class SharpEdges(NamedTuple):
    """Stretches of edges, those of a group one after the other.

    Attributes:
        ends: (E, 2, 3) from point to point, in the part's frame, metres.
        balls: (E, 4) centre and radius of a ball around each.
        groups: (G, 4) of a ball around each group.
        stops: (G,) where each group's stretches end.
    """

    ends: Array
    balls: Array
    groups: Array
    stops: Numbers


def sharp_edges(part: Part) -> SharpEdges:
    """Those of a part; no group has more than sixteen."""
    mesh = part.mesh.copy()
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    sharp = mesh.face_adjacency_convex & (mesh.face_adjacency_angles > _SHARP)
    stretches = [np.empty((0, 2, 3))]
    for start, stop in np.asarray(mesh.vertices)[mesh.face_adjacency_edges[sharp]]:
        count = max(1, int(np.ceil(np.linalg.norm(stop - start) / _RUN)))
        points = np.linspace(start, stop, count + 1)
        stretches.append(np.stack([points[:-1], points[1:]], axis=1))
    ends = np.concatenate(stretches)
    members = _parted(ends.mean(axis=1), np.arange(len(ends)))
    if not members:
        return SharpEdges(ends, np.empty((0, 4)), np.empty((0, 4)), np.empty(0, dtype=np.int64))
    ends = ends[np.concatenate(members)]
    stops = np.cumsum([len(group) for group in members])
    groups = np.stack([_ball(group.reshape(-1, 3)) for group in np.split(ends, stops[:-1])])
    return SharpEdges(ends, np.stack([_ball(each) for each in ends]), groups, stops)


def _parted(middles: Array, members: Numbers) -> list[Numbers]:
    """Members in groups that lie together, by halving them across where they are widest."""
    if len(members) <= _GROUP:
        return [members] if len(members) else []
    axis = int(np.ptp(middles[members], axis=0).argmax())
    order = members[np.argsort(middles[members, axis], kind="stable")]
    half = len(order) // 2
    return _parted(middles, order[:half]) + _parted(middles, order[half:])


def _ball(points: Array) -> Array:
    """Centre and radius (4,) of a ball around points (P, 3)."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return np.array([*middle, np.linalg.norm(points - middle, axis=1).max()])


@compiled
def may_be_nearer(ball: Array, turn: Array, shift: Array, box: Array, least: float) -> bool:
    """Whether a ball in the part's frame may be nearer than `least` to the peg's box, or deeper in it."""
    reach = ball[3] + least
    x, y, z = ball[0] - shift[0], ball[1] - shift[1], ball[2] - shift[2]
    for axis in range(3):
        along = turn[0, axis] * x + turn[1, axis] * y + turn[2, axis] * z
        if along < box[0, axis] - reach or along > box[1, axis] + reach:
            return False
    return True


@compiled
def dot(first: Array, second: Array) -> float:
    """Of three numbers each: numpy's own is slow on so few."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]


@compiled
def turned_back(turn: Array, shift: Array, point: Array, found: Array) -> None:
    """A point of the part's frame in the peg's."""
    x, y, z = point[0] - shift[0], point[1] - shift[1], point[2] - shift[2]
    for axis in range(3):
        found[axis] = turn[0, axis] * x + turn[1, axis] * y + turn[2, axis] * z


@compiled
def is_beyond(point: Array, planes: Array, reach: float) -> bool:
    """Whether a point is farther than `reach` out of a convex solid by one of its planes."""
    beyond = False
    for f in range(len(planes)):
        beyond = dot(planes[f], point) - planes[f, 3] > reach
        if beyond:
            break
    return beyond


@compiled
def deepest(start: Array, stop: Array, planes: Array, least: float, normal: Array) -> tuple[float, float]:
    """Where a stretch of an edge is deepest in a convex solid, or nearest to it: by cutting planes.

    How far a point is out of the solid, by the plane that it is farthest out of, is convex and piecewise
    linear along the stretch. Where that is least between two planes, the stretch crosses the edge between
    them: the distance is along the normal of both edges, a mixture of the planes' normals.

    Args:
        start: (3,) its one end in the peg's frame.
        stop: (3,) the other.
        planes: (P, 4) of the solid.
        least: what it must be less than to matter.
        normal: (3,) becomes the solid's outward unit normal there.

    Returns:
        The distance, negative inside, or one of at least `least`; where on the stretch, from 0 to 1.
    """
    low, high = 0.0, 1.0
    at_low, plane_low = _out(start, stop, low, planes)
    slope_low = dot(planes[plane_low], stop) - dot(planes[plane_low], start)
    if slope_low >= 0.0:
        normal[:] = planes[plane_low, :3]
        return at_low, low
    at_high, plane_high = _out(start, stop, high, planes)
    slope_high = dot(planes[plane_high], stop) - dot(planes[plane_high], start)
    if slope_high <= 0.0:
        normal[:] = planes[plane_high, :3]
        return at_high, high
    share, bound = low, at_low
    for _ in range(_ROUNDS):
        share = (at_low - at_high + slope_high * high - slope_low * low) / (slope_high - slope_low)
        share = min(max(share, low), high)
        bound = at_low + slope_low * (share - low)
        # Along a normal that leans the distance is only longer.
        if bound >= least and bound >= 0.0:
            return bound, share
        here, plane = _out(start, stop, share, planes)
        if here <= bound + _EXACT:
            break
        slope = dot(planes[plane], stop) - dot(planes[plane], start)
        if slope < 0.0:
            low, at_low, slope_low, plane_low = share, here, slope, plane
        else:
            high, at_high, slope_high, plane_high = share, here, slope, plane
    mixed = slope_high / (slope_high - slope_low)
    normal[:] = mixed * planes[plane_low, :3] + (1.0 - mixed) * planes[plane_high, :3]
    length = np.sqrt((normal * normal).sum())
    if length < _CANCELLED:  # between opposite planes: the stretch crosses a thin solid
        normal[:] = planes[plane_low, :3]
        return bound, share
    normal /= length
    return bound / length, share


@compiled
def _out(start: Array, stop: Array, share: float, planes: Array) -> tuple[float, int]:
    """How far a point of a stretch is out of a convex solid, by the plane that it is farthest out of."""
    x = start[0] + share * (stop[0] - start[0])
    y = start[1] + share * (stop[1] - start[1])
    z = start[2] + share * (stop[2] - start[2])
    farthest, plane = -np.inf, 0
    for f in range(len(planes)):
        away = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z - planes[f, 3]
        if away > farthest:
            farthest, plane = away, f
    return farthest, plane

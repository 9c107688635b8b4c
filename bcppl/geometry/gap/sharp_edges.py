"""The sharp convex edges of a part, and the minimum distance of a segment of one to a convex solid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bcppl.arrays import Array, Indices
from bcppl.compiled import compiled
from bcppl.geometry.bounding_spheres import bounding_sphere, compact_groups
from bcppl.geometry.parts import Part

_LONGEST = 0.008  # m; longer edges are subdivided
# Smallest dihedral angle, rad. A flat side of a peg touches a finely meshed fillet or dome at its edges
# alone, however shallow these are. Below lie diagonals of flat faces, and the rounding of coordinates.
_SHARP = 1e-3
CANCELLED = 0.1  # length of a sum of unit normals below which they are opposite


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
    start: Array, stop: Array, planes: Array, least: float, rows: Array, normal: Array
) -> tuple[float, float]:
    """The signed distance of a segment to a convex solid, and its witness point.

    That is how far they are apart along the direction that separates them most (the theorem of separating
    axes): an outward normal of the solid, or a combination of two that is perpendicular to the segment, as
    where it crosses the edge between two faces. It is negative in penetration, and continuous in the
    segment's place. Beside the solid's vertices it is too small.

    Args:
        start: (3,) one end of the segment in the solid's frame.
        stop: (3,) the other.
        planes: (P, 4) outward unit normals and offsets.
        least: what is farther than this is not looked into further.
        rows: (P, 2) room: the ends' distances to the planes.
        normal: (3,) set to the solid's outward unit normal at the witness point.

    Returns:
        The distance, exact only if less than `least`, and the witness point's parameter along the segment,
        from 0 to 1.
    """
    best, place, share = -np.inf, 0, 0.0
    for f in range(len(planes)):
        ahead = stop[0] * planes[f, 0] + stop[1] * planes[f, 1] + stop[2] * planes[f, 2] - planes[f, 3]
        here = start[0] * planes[f, 0] + start[1] * planes[f, 1] + start[2] * planes[f, 2] - planes[f, 3]
        rows[f, 0], rows[f, 1] = here, ahead
        if min(here, ahead) > best:
            best, place, share = min(here, ahead), f, 0.0 if here <= ahead else 1.0
            if best >= least:
                return best, share
    normal[:] = planes[place, :3]
    for f in range(len(planes)):
        # Towards its end the segment comes nearer to the first plane and goes away from the second. Where it
        # starts within the first, or ends within the second, one of them alone separates it as much.
        first = rows[f, 0] - rows[f, 1]
        if first <= 0.0 or rows[f, 0] <= min(best, 0.0):
            continue
        for g in range(len(planes)):
            second = rows[g, 1] - rows[g, 0]
            if second <= 0.0 or rows[g, 1] <= min(best, 0.0):
                continue
            mixed = second / (first + second)
            apart = mixed * rows[f, 0] + (1.0 - mixed) * rows[g, 0]
            if apart <= (best if best < 0.0 else CANCELLED * best):
                continue
            x = mixed * planes[f, 0] + (1.0 - mixed) * planes[g, 0]
            y = mixed * planes[f, 1] + (1.0 - mixed) * planes[g, 1]
            z = mixed * planes[f, 2] + (1.0 - mixed) * planes[g, 2]
            length = np.sqrt(x * x + y * y + z * z)
            # Normals that are nearly opposite: the segment crosses a thin solid.
            if length > CANCELLED and apart / length > best:
                best = apart / length
                share = min(max((rows[f, 0] - rows[g, 0]) / (first + second), 0.0), 1.0)
                normal[0], normal[1], normal[2] = x / length, y / length, z / length
                if best >= least:
                    return best, share
    return best, share

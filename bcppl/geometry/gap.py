"""How far a held peg is from a part, for many poses of the part: nothing is simulated.

Where a peg stood when it felt something, or nothing, is known from the robot's joints. What a pose of the
part makes of that is a distance: about zero where contact was felt and positive elsewhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl import poses
from bcppl.compiled import compiled
from bcppl.effort import Effort
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.distance_grid import DistanceGrid, distance_grid, looked_up, sloped
from bcppl.geometry.fidelity import solid_of
from bcppl.geometry.parts import Part
from bcppl.geometry.sharp_edges import deepest, dot, is_beyond, may_be_nearer, sharp_edges, turned_back
from bcppl.threads import shared, thread_count

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]

_NEAR = 0.002  # m: nearer than this, edges count, and what the grid cannot tell is measured exactly
_FLAT = 1e-9
_MARGIN = 0.012  # m around the part that the grid covers
_SHARE = 8  # particles that a thread takes at a time
_PAIRS = 256  # pairs that it takes at least


class Gap(NamedTuple):
    """How a peg at T poses lies to a part at N.

    Attributes:
        distance: (N, T) metres, negative where they overlap: by how much the peg's deepest corner lies in the
            part, or the part's deepest edge in the peg.
        place: (N, T, 3) where that is, in the part's frame.
        normal: (N, T, 3) the part's outward unit normal there, in its frame.
    """

    distance: Tensor
    place: Tensor
    normal: Tensor

    def slope(self, world_from_part: Tensor) -> Tensor:
        """Derivatives (N, T, 6) of the distance in the tangent space at poses (N, 7) of the part.

        Metres for each metre along the world's axes and each radian about the part's.
        """
        rotation = poses.rotation_matrix(world_from_part)
        along = -(self.normal @ rotation.transpose(-1, -2))
        return torch.cat([along, -torch.linalg.cross(self.place, self.normal)], dim=-1)


class Frames(NamedTuple):
    """Poses (...,) as rotation matrices (..., 3, 3) and places (..., 3) in metres."""

    rotation: Array
    place: Array


def frames_of(pose: Tensor) -> Frames:
    """Of poses (..., 7)."""
    rotation = np.ascontiguousarray(poses.rotation_matrix(pose.detach()).numpy())
    return Frames(rotation, np.ascontiguousarray(pose.detach()[..., :3].numpy()))


class PegGap:
    """The gap between a part and a peg. Their meshes are closed; a peg that is not convex has convex pieces.

    Contact between solids with flat faces begins at a corner of the one, at a corner of the other, or where
    two edges cross. So the gap is the least of the distances of the peg's corners to the part and of the
    part's sharp edges to the peg. Corners are chosen by a grid of distances; those near an edge of the part,
    which a grid rounds off, are then measured exactly. The distance of an edge to the peg is that to its
    nearest plane: exact in contact, too small beside the peg's own edges and corners.

    Attributes:
        part, peg: the solids.
        effort: calls, and pairs of poses as `items`.

    Raises:
        InputError: a mesh is empty, open or not finite.
    """

    def __init__(self, part: Part, peg: Part) -> None:
        self.part, self.peg = part, peg
        self.effort = Effort()
        self._signed = SignedDistance(part)
        self._grid: DistanceGrid | None = None
        self._corners = _corners(peg)
        self._edges = sharp_edges(part)
        self._planes, self._ends = _planes(peg)
        self._box = np.stack([peg.vertices.min(axis=0), peg.vertices.max(axis=0)])

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gap:
        """Gaps for poses (N, 7) of the part and (T, 7) of the peg, or (N, T, 7): each particle its own."""
        distance, place, normal = self.measured(frames_of(world_from_part), frames_of(world_from_peg))
        return Gap(torch.from_numpy(distance), torch.from_numpy(place), torch.from_numpy(normal))

    def measured(self, part: Frames, peg: Frames) -> tuple[Array, Array, Array]:
        """As a call, of frames (N,) of the part and (T,) or (N, T) of the peg: a gap's fields as arrays."""
        peg = peg if peg.place.ndim == 3 else Frames(peg.rotation[None], peg.place[None])
        particles, stamps = len(part.place), peg.place.shape[1]
        with self.effort.measure(items=particles * stamps):
            if self._grid is None:
                self._grid = distance_grid(self.part, self._signed, _MARGIN)
            grid, edges = self._grid, self._edges
            distance = np.empty((particles, stamps))
            place, normal = np.empty((particles, stamps, 3)), np.empty((particles, stamps, 3))
            rounded = np.empty((particles, stamps), dtype=np.bool_)

            def work(first: int, last: int) -> int:
                _measure(
                    first,
                    last,
                    *part,
                    *peg,
                    self._corners,
                    grid.low,
                    grid.spacing,
                    grid.distance,
                    edges.ends,
                    edges.balls,
                    edges.groups,
                    edges.stops,
                    self._planes,
                    self._ends,
                    self._box,
                    distance,
                    place,
                    normal,
                    rounded,
                )
                return 0

            shared(work, 0, particles, max(_SHARE, _PAIRS // max(1, stamps)), thread_count())
            if rounded.any():
                exact = self._signed(torch.from_numpy(place[rounded]))
                distance[rounded] = exact.distance.numpy()
                normal[rounded] = exact.normal.numpy()
        return distance, place, normal


def _corners(peg: Part) -> Array:
    """The peg's distinct vertices (V, 3)."""
    return np.unique(np.round(peg.vertices, 9), axis=0)


def _planes(peg: Part) -> tuple[Array, Numbers]:
    """Planes (P, 4) of the peg's convex solids, outward normal and offset, and where each solid's end."""
    solids = [peg.mesh.convex_hull] if peg.mesh.is_convex or not peg.pieces else map(solid_of, peg.pieces)
    planes = []
    for solid in solids:
        normals = np.asarray(solid.face_normals)
        offsets = np.einsum("fi,fi->f", normals, np.asarray(solid.triangles)[:, 0])
        whole = np.round(np.column_stack([normals, offsets]), 9)
        planes.append(np.unique(whole, axis=0))
    return np.concatenate(planes), np.cumsum([len(each) for each in planes])


@compiled
def _measure(
    first: int,
    last: int,
    part_rotation: Array,
    part_place: Array,
    peg_rotation: Array,
    peg_place: Array,
    corners: Array,
    low: Array,
    spacing: float,
    grid: npt.NDArray[np.float32],
    edges: Array,
    balls: Array,
    groups: Array,
    stops: Numbers,
    planes: Array,
    ends: Numbers,
    box: Array,
    distance: Array,
    place: Array,
    normal: Array,
    rounded: npt.NDArray[np.bool_],
) -> None:
    stamps = peg_rotation.shape[1]
    slope, start, stop, middle = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for n in range(first, last):
        own = n if len(peg_rotation) > 1 else 0
        for t in range(stamps):
            # part_from_peg
            turn = part_rotation[n].T @ peg_rotation[own, t]
            shift = part_rotation[n].T @ (peg_place[own, t] - part_place[n])
            least, which = np.inf, 0
            for c in range(len(corners)):
                p = corners[c]
                x = turn[0, 0] * p[0] + turn[0, 1] * p[1] + turn[0, 2] * p[2] + shift[0]
                y = turn[1, 0] * p[0] + turn[1, 1] * p[1] + turn[1, 2] * p[2] + shift[1]
                z = turn[2, 0] * p[0] + turn[2, 1] * p[1] + turn[2, 2] * p[2] + shift[2]
                here = looked_up(x, y, z, low, spacing, grid)
                if here < least:
                    least, which = here, c
            place[n, t] = turn @ corners[which] + shift
            rounded[n, t] = not sloped(place[n, t], low, spacing, grid, slope) and abs(least) < _NEAR
            normal[n, t] = slope
            # An edge that is farther off than this would not touch either way.
            nearer = min(least, _NEAR)
            next_edge = 0
            for g in range(len(groups)):
                first_edge, next_edge = next_edge, stops[g]
                if not may_be_nearer(groups[g], turn, shift, box, nearer):
                    continue
                for e in range(first_edge, next_edge):
                    if not may_be_nearer(balls[e], turn, shift, box, nearer):
                        continue
                    turned_back(turn, shift, balls[e], middle)
                    turned_back(turn, shift, edges[e, 0], start)
                    turned_back(turn, shift, edges[e, 1], stop)
                    begin = 0
                    for s in range(len(ends)):
                        solid = planes[begin : ends[s]]
                        begin = ends[s]
                        if is_beyond(middle, solid, balls[e, 3] + nearer):
                            continue
                        inside, share = deepest(start, stop, solid, nearer, slope)
                        if inside < nearer:
                            nearer = least = inside
                            rounded[n, t] = False
                            place[n, t] = edges[e, 0] + share * (edges[e, 1] - edges[e, 0])
                            for axis in range(3):
                                normal[n, t, axis] = -dot(turn[axis], slope)
            distance[n, t] = least

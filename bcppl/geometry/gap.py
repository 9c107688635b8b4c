"""The gap between a held peg and a part, for many poses of the part, without simulation.

The gap is the gap function of contact mechanics: the signed minimum distance of two bodies, negative where
they penetrate. The peg's pose is known from the robot's joints, so a pose of the part predicts the gap: about
zero at a contact and positive elsewhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array, Indices, Mask
from bcppl.compiled import compiled
from bcppl.effort import Effort
from bcppl.geometry.bounding_spheres import bounding_sphere, compact_groups
from bcppl.geometry.distance import DistanceGrid, SignedDistance, distance_grid, interpolated, plane_gradient
from bcppl.geometry.hausdorff import planes_of, solid_of
from bcppl.geometry.parts import Part
from bcppl.geometry.sharp_edges import (
    SharpEdges,
    dot,
    is_separated,
    may_be_nearer,
    segment_distance,
    sharp_edges,
    to_peg_frame,
)
from bcppl.threads import parallel_sum, thread_count

_NEAR = 0.002  # m: below this gap edges are evaluated, and distances exactly where the grid is inexact
_MARGIN = 0.012  # m around the part that the grid covers
_STEEPEST = 3.0**0.5  # slope of a distance that is interpolated axis by axis, at most
_CHUNK = 8  # particles of a chunk of work, at least
_PAIRS = 2000  # pairs of poses of a chunk, at least: they take milliseconds, and a thread's beginning a tenth


class Gap(NamedTuple):
    """Minimum distances between a part at N poses and a peg at T, with witness points and normals.

    Attributes:
        distance: (N, T) metres; in penetration minus the depth of the peg's deepest vertex in the part, or of
            the part's deepest edge in the peg.
        witness: (N, T, 3) the witness point, in the part's frame.
        normal: (N, T, 3) the part's outward unit normal there, in its frame.
    """

    distance: Tensor
    witness: Tensor
    normal: Tensor

    def gradient(self, world_from_part: Tensor) -> Tensor:
        """Gradients (N, T, 6) of the distance in the tangent space at poses (N, 7) of the part.

        Metres per metre along the world's axes and per radian about the part's.
        """
        rotation = poses.rotation_matrix(world_from_part)
        along = -(self.normal @ rotation.transpose(-1, -2))
        return torch.cat([along, -torch.linalg.cross(self.witness, self.normal)], dim=-1)


class Frames(NamedTuple):
    """Poses (...,) as rotation matrices (..., 3, 3) and translations (..., 3) in metres."""

    rotation: Array
    translation: Array


def frames_of(pose: Tensor) -> Frames:
    """Rotation matrices and translations of poses (..., 7)."""
    rotation = np.ascontiguousarray(poses.rotation_matrix(pose.detach()).numpy())
    return Frames(rotation, np.ascontiguousarray(pose.detach()[..., :3].numpy()))


class PegGap:
    """The gap between a part and a peg. Their meshes are closed; a peg that is not convex has convex pieces.

    Polyhedra first touch at a vertex of one of them or where two edges cross. So the gap is the minimum over
    the distances of the peg's vertices to the part and of the part's sharp edges to the peg. The closest
    vertex is chosen by interpolated distances; near an edge of the part, where interpolation is inexact, its
    distance is then computed exactly. The distance of an edge to the peg is that to its closest plane: exact
    in contact, an underestimate beside the peg's own edges and vertices.

    Attributes:
        part, peg: the solids.
        effort: calls, and pairs of poses as `items`.

    Raises:
        InputError: a mesh is empty, open or not finite.
    """

    __caches__ = ("_grid",)  # of the part

    def __init__(self, part: Part, peg: Part) -> None:
        self.part, self.peg = part, peg
        self.effort = Effort()
        self._signed = SignedDistance(part)
        self._grid: DistanceGrid | None = None
        self._edges = sharp_edges(part)
        self._solids = _solids(peg)

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gap:
        """Gaps (N, T) at poses (N, 7) of the part and (T, 7) of the peg, or (N, T, 7), one per particle."""
        arrays = self.evaluate(frames_of(world_from_part), frames_of(world_from_peg))
        return Gap(*map(torch.from_numpy, arrays))

    def evaluate(self, part: Frames, peg: Frames) -> tuple[Array, Array, Array]:
        """The fields of `Gap` as arrays, at frames (N,) of the part and (T,) or (N, T) of the peg."""
        peg = peg if peg.translation.ndim == 3 else Frames(peg.rotation[None], peg.translation[None])
        particles, stamps = len(part.translation), peg.translation.shape[1]
        with self.effort.measure(items=particles * stamps):
            if self._grid is None:
                self._grid = distance_grid(self.part, self._signed, _MARGIN)
            given = (part, peg, self._grid, self._edges, self._solids)
            distance, rounded = np.empty((particles, stamps)), np.empty((particles, stamps), dtype=np.bool_)
            witness, normal = np.empty((particles, stamps, 3)), np.empty((particles, stamps, 3))
            result = (distance, witness, normal, rounded)

            def work(first: int, last: int) -> int:
                _evaluate(first, last, *given, *result)
                return 0

            parallel_sum(work, 0, particles, max(_CHUNK, _PAIRS // max(1, stamps)), thread_count())
            if rounded.any():
                exact = self._signed(torch.from_numpy(witness[rounded]))
                distance[rounded] = exact.distance.numpy()
                normal[rounded] = exact.normal.numpy()
        return distance, witness, normal


class _Solids(NamedTuple):
    """A peg as convex solids: distinct vertices (V, 3), and a bounding box (2, 3).

    Vertices of a compact group are contiguous: `stops` (G,) are the indices after each group's last one, and
    `spheres` (G, 4) lie about them. Planes (P, 4) are the outward unit normals and offsets of all solids,
    `ends` (S,) the index after each solid's last plane.
    """

    corners: Array
    stops: Indices
    spheres: Array
    planes: Array
    ends: Indices
    box: Array


def _solids(peg: Part) -> _Solids:
    meshes = [peg.mesh.convex_hull] if peg.mesh.is_convex or not peg.pieces else map(solid_of, peg.pieces)
    planes = [np.unique(np.round(planes_of(mesh), 9), axis=0) for mesh in meshes]
    corners = np.unique(np.round(peg.vertices, 9), axis=0)
    groups = compact_groups(corners)
    return _Solids(
        corners=corners[np.concatenate(groups)],
        stops=np.cumsum([len(group) for group in groups]),
        spheres=np.stack([bounding_sphere(corners[group]) for group in groups]),
        planes=np.concatenate(planes),
        ends=np.cumsum([len(each) for each in planes]),
        box=np.stack([peg.vertices.min(axis=0), peg.vertices.max(axis=0)]),
    )


@compiled
def _relative(part: Frames, n: int, peg: Frames, own: int, t: int, turn: Array, shift: Array) -> None:
    """Set `turn` (3, 3) and `shift` (3,) to the peg's frame in the part's.

    Written out: numpy's product of two small matrices takes longer than all that is looked up there.
    """
    for i in range(3):
        shift[i] = 0.0
        for k in range(3):
            along = part.rotation[n, k, i]
            shift[i] += along * (peg.translation[own, t, k] - part.translation[n, k])
        for j in range(3):
            turn[i, j] = 0.0
            for k in range(3):
                turn[i, j] += part.rotation[n, k, i] * peg.rotation[own, t, k, j]


@compiled
def _placed(point: Array, turn: Array, shift: Array, result: Array) -> None:
    """Set `result` (3,) to a point of the peg's frame in the part's."""
    for axis in range(3):
        result[axis] = dot(turn[axis], point) + shift[axis]


@compiled
def _interpolate(
    points: Array, first: int, last: int, turn: Array, shift: Array, grid: DistanceGrid, distance: Array
) -> None:
    """Set `distance` from `first` to `last` to interpolated ones, at points (P, 3) of the peg's frame."""
    # The rotation is looked up once: arrays given to a function for each point take longer than all of it.
    ax, ay, az = turn[0, 0], turn[0, 1], turn[0, 2]
    bx, by, bz = turn[1, 0], turn[1, 1], turn[1, 2]
    cx, cy, cz = turn[2, 0], turn[2, 1], turn[2, 2]
    for p in range(first, last):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        distance[p] = interpolated(
            ax * x + ay * y + az * z + shift[0],
            bx * x + by * y + bz * z + shift[1],
            cx * x + cy * y + cz * z + shift[2],
            grid,
        )


@compiled
def _evaluate(
    first: int,
    last: int,
    part: Frames,
    peg: Frames,
    grid: DistanceGrid,
    edges: SharpEdges,
    solids: _Solids,
    distance: Array,
    witness: Array,
    normal: Array,
    rounded: Mask,
) -> None:
    corners, stops, spheres = solids.corners, solids.stops, solids.spheres
    planes, box, bound, here = solids.planes, solids.box, np.empty(len(spheres)), np.empty(len(corners))
    gradient, start, stop, middle = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    turn, shift = np.empty((3, 3)), np.empty(3)
    for n in range(first, last):
        own = n if len(peg.rotation) > 1 else 0
        for t in range(peg.rotation.shape[1]):
            # part_from_peg
            _relative(part, n, peg, own, t, turn, shift)
            lowest, first_group = np.inf, 0
            _interpolate(spheres, 0, len(spheres), turn, shift, grid, bound)
            for g in range(len(spheres)):
                bound[g] -= _STEEPEST * spheres[g, 3]
                if bound[g] < lowest:
                    lowest, first_group = bound[g], g
            least, which = np.inf, 0
            for k in range(-1, len(spheres)):
                g = first_group if k < 0 else k
                # The closest group comes first, so that hardly any other has to be looked into.
                if k == first_group or bound[g] > least:
                    continue
                begin = stops[g - 1] if g else 0
                _interpolate(corners, begin, stops[g], turn, shift, grid, here)
                for c in range(begin, stops[g]):
                    if here[c] < least:
                        least, which = here[c], c
            _placed(corners[which], turn, shift, witness[n, t])
            rounded[n, t] = not plane_gradient(witness[n, t], grid, gradient) and abs(least) < _NEAR
            normal[n, t] = gradient
            # A farther edge cannot be in contact.
            nearer = min(least, _NEAR)
            next_edge = 0
            for g in range(len(edges.groups)):
                first_edge, next_edge = next_edge, edges.stops[g]
                if not may_be_nearer(edges.groups, g, turn, shift, box, nearer):
                    continue
                for e in range(first_edge, next_edge):
                    if not may_be_nearer(edges.spheres, e, turn, shift, box, nearer):
                        continue
                    to_peg_frame(turn, shift, edges.spheres, e, middle)
                    to_peg_frame(turn, shift, edges.ends[:, 0], e, start)
                    to_peg_frame(turn, shift, edges.ends[:, 1], e, stop)
                    begin = 0
                    for s in range(len(solids.ends)):
                        solid = planes[begin : solids.ends[s]]
                        begin = solids.ends[s]
                        if is_separated(middle, solid, edges.spheres[e, 3] + nearer):
                            continue
                        inside, share = segment_distance(start, stop, solid, nearer, gradient)
                        if inside < nearer:
                            nearer = least = inside
                            rounded[n, t] = False
                            witness[n, t] = edges.ends[e, 0] + share * (edges.ends[e, 1] - edges.ends[e, 0])
                            for axis in range(3):
                                normal[n, t, axis] = -dot(turn[axis], gradient)
            distance[n, t] = least

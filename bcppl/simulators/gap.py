"""How far a held peg is from a part, for many poses of the part: nothing is simulated.

Where a peg stood when it felt something, or nothing, is known from the robot's joints. What a pose of the
part makes of that is a distance: about zero where contact was felt and positive elsewhere.
"""

from __future__ import annotations

import os
import threading
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl import poses
from bcppl.parts import Part
from bcppl.simulators.distance import SignedDistance
from bcppl.simulators.distance_grid import DistanceGrid, distance_grid, looked_up, sloped
from bcppl.simulators.effort import Effort
from bcppl.simulators.fidelity import solid_of
from bcppl.simulators.placement import compiled

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]

_RUN = 0.008  # m of an edge that are passed over together
_ROUNDS = 12
_EXACT = 1e-8  # m
_CANCELLED = 0.1
_NEAR = 0.002  # m: nearer than this, edges count, and what the grid cannot tell is measured exactly
_SHARP = np.radians(5.0)
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
        self._edges, self._balls = _edges(part)
        self._planes, self._ends = _planes(peg)
        self._box = np.stack([peg.vertices.min(axis=0), peg.vertices.max(axis=0)])

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gap:
        """Gaps for poses (N, 7) of the part and (T, 7) of the peg, or (N, T, 7): each particle its own."""
        particles, stamps = len(world_from_part), world_from_peg.shape[-2]
        with self.effort.measure(items=particles * stamps):
            if self._grid is None:
                self._grid = distance_grid(self.part, self._signed, _MARGIN)
            grid = self._grid
            part = _frames(world_from_part)
            peg = _frames(world_from_peg if world_from_peg.ndim == 3 else world_from_peg[None])
            distance = np.empty((particles, stamps))
            place, normal = np.empty((particles, stamps, 3)), np.empty((particles, stamps, 3))
            rounded = np.empty((particles, stamps), dtype=np.bool_)

            def work(first: int, last: int) -> None:
                _measure(
                    first,
                    last,
                    *part,
                    *peg,
                    self._corners,
                    grid.low,
                    grid.spacing,
                    grid.distance,
                    self._edges,
                    self._balls,
                    self._planes,
                    self._ends,
                    self._box,
                    distance,
                    place,
                    normal,
                    rounded,
                )

            _shared(work, particles, max(_SHARE, _PAIRS // max(1, stamps)))
            exact = self._signed(torch.from_numpy(place[rounded]))
            distance[rounded] = exact.distance.numpy()
            normal[rounded] = exact.normal.numpy()
        return Gap(torch.from_numpy(distance), torch.from_numpy(place), torch.from_numpy(normal))


def _frames(pose: Tensor) -> tuple[Array, Array]:
    rotation = np.ascontiguousarray(poses.rotation_matrix(pose.detach()).numpy())
    return rotation, np.ascontiguousarray(pose.detach()[..., :3].numpy())


def _corners(peg: Part) -> Array:
    """The peg's distinct vertices (V, 3)."""
    return np.unique(np.round(peg.vertices, 9), axis=0)


def _edges(part: Part) -> tuple[Array, Array]:
    """Stretches (E, 2, 3) of the edges at which the part is sharp and convex, from point to point.

    Returns:
        The stretches, and centre and radius (E, 4) of a ball around each.
    """
    mesh = part.mesh.copy()
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    sharp = mesh.face_adjacency_convex & (mesh.face_adjacency_angles > _SHARP)
    stretches = [np.empty((0, 2, 3))]
    for start, stop in np.asarray(mesh.vertices)[mesh.face_adjacency_edges[sharp]]:
        count = max(1, int(np.ceil(np.linalg.norm(stop - start) / _RUN)))
        points = np.linspace(start, stop, count + 1)
        stretches.append(np.stack([points[:-1], points[1:]], axis=1))
    edges = np.concatenate(stretches)
    radii = 0.5 * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    return edges, np.column_stack([edges.mean(axis=1), radii])


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


def _shared(work: object, particles: int, share: int) -> None:
    """Runs of particles shared among threads, which end with the call."""
    assert callable(work)
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    runs = iter(range(0, particles, share))
    errors: list[BaseException] = []

    def take() -> None:
        try:
            for first in runs:
                work(first, min(first + share, particles))
        except BaseException as error:
            errors.append(error)

    others = [threading.Thread(target=take) for _ in range(min(available, -(-particles // share)) - 1)]
    for other in others:
        other.start()
    take()
    for other in others:
        other.join()
    if errors:
        raise errors[0]


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
    planes: Array,
    ends: Numbers,
    box: Array,
    distance: Array,
    place: Array,
    normal: Array,
    rounded: npt.NDArray[np.bool_],
) -> None:
    stamps = peg_rotation.shape[1]
    slope = np.empty(3)
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
            for e in range(len(edges)):
                if _may_be_nearer(balls[e], turn, shift, box, nearer):
                    start, stop = turn.T @ (edges[e, 0] - shift), turn.T @ (edges[e, 1] - shift)
                    begin = 0
                    for s in range(len(ends)):
                        inside, share = _deepest(start, stop, planes[begin : ends[s]], nearer, slope)
                        if inside < nearer:
                            nearer = least = inside
                            rounded[n, t] = False
                            place[n, t] = edges[e, 0] + share * (edges[e, 1] - edges[e, 0])
                            normal[n, t] = -(turn @ slope)
                        begin = ends[s]
            distance[n, t] = least


@compiled
def _may_be_nearer(ball: Array, turn: Array, shift: Array, box: Array, least: float) -> bool:
    """Whether a ball in the part's frame may be nearer than `least` to the peg's box, or deeper in it."""
    reach = ball[3] + least
    x, y, z = ball[0] - shift[0], ball[1] - shift[1], ball[2] - shift[2]
    for axis in range(3):
        along = turn[0, axis] * x + turn[1, axis] * y + turn[2, axis] * z
        if along < box[0, axis] - reach or along > box[1, axis] + reach:
            return False
    return True


@compiled
def _deepest(start: Array, stop: Array, planes: Array, least: float, normal: Array) -> tuple[float, float]:
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
    step: Array = stop - start
    low, high = 0.0, 1.0
    at_low, plane_low = _out(start, planes)
    slope_low = float(planes[plane_low, :3] @ step)
    if slope_low >= 0.0:
        normal[:] = planes[plane_low, :3]
        return at_low, low
    at_high, plane_high = _out(stop, planes)
    slope_high = float(planes[plane_high, :3] @ step)
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
        here, plane = _out(start + share * step, planes)
        if here <= bound + _EXACT:
            break
        slope = float(planes[plane, :3] @ step)
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
def _out(point: Array, planes: Array) -> tuple[float, int]:
    """How far a point is out of a convex solid, by the plane that it is farthest out of."""
    farthest, plane = -np.inf, 0
    for f in range(len(planes)):
        away = planes[f, 0] * point[0] + planes[f, 1] * point[1] + planes[f, 2] * point[2] - planes[f, 3]
        if away > farthest:
            farthest, plane = away, f
    return farthest, plane

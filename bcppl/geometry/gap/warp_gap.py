"""The gap between a peg and a part by Warp: on a GPU, or on one core without.

One thread measures the gap of one pose of the part to one of the peg, as `PegGap` does on the processor: by
the same grid of distances, and near an edge of the part by its mesh. What is relative to the part is in
single precision, which is 10 nm there. Without a GPU `PegGap` is faster.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from bcppl import poses, warp_arrays
from bcppl.arrays import Array
from bcppl.devices import on_device_of
from bcppl.geometry.distance import closed_mesh
from bcppl.geometry.gap.distance_grid import RefinedGrid, distance_grid
from bcppl.geometry.gap.peg_gap import MARGIN, Gap, PegGap
from bcppl.geometry.gap.sharp_edges import CANCELLED
from bcppl.geometry.gap.vertices import FADING, NEAR
from bcppl.geometry.gap.warp_vertices import Bodies, Closest, Grid, center_of, of_vertices
from bcppl.geometry.parts import Part

NOWHERE = wp.constant(-1e6)
_CANCELLED, _FADING, _NEAR = wp.constant(CANCELLED), wp.constant(FADING), wp.constant(NEAR)


@wp.func  # type: ignore[untyped-decorator]
def _may_be_nearer(bodies: Bodies, turn: wp.mat33, shift: wp.vec3, sphere: wp.vec4, least: float) -> bool:
    reach = sphere[3] + least
    there = wp.transpose(turn) * (center_of(sphere) - shift)
    for axis in range(3):
        if there[axis] < bodies.lowest[axis] - reach or there[axis] > bodies.highest[axis] + reach:
            return False
    return True


@wp.func  # type: ignore[untyped-decorator]
def _height(plane: wp.vec4, point: wp.vec3) -> float:
    return plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] - plane[3]


@wp.func  # type: ignore[untyped-decorator]
def _of_segment(
    start: wp.vec3, stop: wp.vec3, planes: wp.array[wp.vec4], begin: int, end: int, least: float
) -> Closest:
    """As `sharp_edges.segment_distance`; `point[0]` is the witness's share of the segment."""
    best = Closest()
    best.distance = NOWHERE
    for f in range(begin, end):
        here = _height(planes[f], start)
        ahead = _height(planes[f], stop)
        if wp.min(here, ahead) > best.distance:
            best.distance = wp.min(here, ahead)
            best.normal = center_of(planes[f])
            best.point = wp.vec3(wp.where(here <= ahead, 0.0, 1.0), 0.0, 0.0)
            if best.distance >= least:
                return best
    for f in range(begin, end):
        f_here = _height(planes[f], start)
        f_ahead = _height(planes[f], stop)
        first = f_here - f_ahead
        if first <= 0.0 or f_here <= wp.min(best.distance, 0.0):
            continue
        for g in range(begin, end):
            g_here = _height(planes[g], start)
            g_ahead = _height(planes[g], stop)
            second = g_ahead - g_here
            if second <= 0.0 or g_ahead <= wp.min(best.distance, 0.0):
                continue
            mixed = second / (first + second)
            apart = mixed * f_here + (1.0 - mixed) * g_here
            if apart <= wp.where(best.distance < 0.0, best.distance, _CANCELLED * best.distance):
                continue
            normal = mixed * center_of(planes[f]) + (1.0 - mixed) * center_of(planes[g])
            length = wp.length(normal)
            if length > _CANCELLED and apart / length > best.distance:
                share = wp.clamp((f_here - g_here) / (first + second), 0.0, 1.0)
                best.distance = apart / length
                best.normal = normal / length
                best.point = wp.vec3(share, 0.0, 0.0)
                if best.distance >= least:
                    return best
    return best


@wp.func  # type: ignore[untyped-decorator]
def _is_separated(point: wp.vec3, planes: wp.array[wp.vec4], begin: int, end: int, reach: float) -> bool:
    for f in range(begin, end):  # noqa: SIM110 (a kernel has no generators)
        if _height(planes[f], point) > reach:
            return True
    return False


@wp.func  # type: ignore[untyped-decorator]
def _with_edges(bodies: Bodies, turn: wp.mat33, shift: wp.vec3, of_vertices: Closest) -> Closest:
    found = of_vertices
    nearer = wp.min(of_vertices.distance, _NEAR)
    back = wp.transpose(turn)
    for g in range(bodies.edge_groups.shape[0]):
        if not _may_be_nearer(bodies, turn, shift, bodies.edge_groups[g], nearer):
            continue
        first = wp.int32(0)
        if g > 0:
            first = bodies.edge_stops[g - 1]
        for e in range(first, bodies.edge_stops[g]):
            if not _may_be_nearer(bodies, turn, shift, bodies.edge_spheres[e], nearer):
                continue
            middle = back * (center_of(bodies.edge_spheres[e]) - shift)
            start = back * (bodies.edge_ends[e, 0] - shift)
            stop = back * (bodies.edge_ends[e, 1] - shift)
            begin = wp.int32(0)
            for s in range(bodies.ends.shape[0]):
                end = bodies.ends[s]
                if not _is_separated(middle, bodies.planes, begin, end, bodies.edge_spheres[e][3] + nearer):
                    inside = _of_segment(start, stop, bodies.planes, begin, end, nearer)
                    if inside.distance < nearer:
                        nearer = inside.distance
                        found.distance = inside.distance
                        found.normal = -(turn * inside.normal)
                        along = bodies.edge_ends[e, 1] - bodies.edge_ends[e, 0]
                        found.point = bodies.edge_ends[e, 0] + inside.point[0] * along
                begin = end
    if found.distance > _FADING and found.distance < of_vertices.distance:
        share = (found.distance - _FADING) / (_NEAR - _FADING)
        found.distance += share * (of_vertices.distance - found.distance)
    return found


@wp.kernel  # type: ignore[untyped-decorator]
def _measure(
    bodies: Bodies,
    part_turn: wp.array[wp.mat33d],
    part_shift: wp.array[wp.vec3d],
    peg_turn: wp.array2d[wp.mat33d],
    peg_shift: wp.array2d[wp.vec3d],
    center: wp.vec3d,
    distance: wp.array2d[float],
    witness: wp.array2d[wp.vec3],
    normal: wp.array2d[wp.vec3],
) -> None:
    t, n = wp.tid()
    own = wp.min(n, peg_turn.shape[0] - 1)
    # The peg in the part's frame, about the mesh's centre: from there on single precision is enough.
    back = wp.transpose(part_turn[n])
    turn = wp.mat33(back * peg_turn[own, t])
    shift = wp.vec3(back * (peg_shift[own, t] - part_shift[n]) - center)
    found = _with_edges(bodies, turn, shift, of_vertices(bodies, turn, shift))
    distance[n, t] = found.distance
    witness[n, t] = found.point
    normal[n, t] = found.normal


class WarpGap(PegGap):
    """The gap between a part and a peg by Warp; see `PegGap`.

    It is `PegGap`'s to 30 nm.

    Args:
        part, peg: the solids.
        device: torch's, or as Warp names it: "cpu", "cuda", "cuda:1"; a GPU where there is one unless given.
    """

    __caches__ = ("_bodies", "_mesh", *PegGap.__caches__)  # of the part and the peg

    def __init__(self, part: Part, peg: Part, device: torch.device | str | None = None) -> None:
        super().__init__(part, peg)
        self.device = warp_arrays.warp_device(device)
        mesh = closed_mesh(part)
        # Single precision is finest around zero, so the mesh is centred there.
        self._center = mesh.bounds.mean(axis=0)
        middle = torch.from_numpy(np.asarray(self._center, np.float64))
        self._middle = middle.to(warp_arrays.torch_device(self.device))
        faces = wp.array(np.asarray(mesh.faces, np.int32).ravel(), dtype=int, device=self.device)
        vertices = self._array(mesh.vertices - self._center, wp.vec3)
        self._mesh = wp.Mesh(vertices, faces, support_winding_number=True)
        solids, edges, bodies = self._solids, self._edges, Bodies()
        offset = np.append(self._center, 0.0)
        bodies.mesh, bodies.grid = self._mesh.id, self._grid_there()
        bodies.corners = self._array(solids.corners, wp.vec3)
        bodies.planes = self._array(solids.planes, wp.vec4)
        bodies.spheres = self._array(solids.spheres, wp.vec4)
        bodies.lowest, bodies.highest = (wp.vec3(*map(float, side)) for side in solids.box)
        bodies.edge_ends = self._array(edges.ends - self._center, wp.vec3)
        bodies.edge_spheres = self._array(edges.spheres - offset, wp.vec4)
        bodies.edge_groups = self._array(edges.groups - offset, wp.vec4)
        for name, values in (("stops", solids.stops), ("ends", solids.ends), ("edge_stops", edges.stops)):
            setattr(bodies, name, wp.array(values.astype(np.int32), dtype=int, device=self.device))
        self._bodies = bodies

    def _grid_there(self) -> Grid:
        refined = RefinedGrid(distance_grid(self.part, self._signed, MARGIN), self._signed, NEAR)
        refined.measure()  # many poses are measured: it pays
        grid, there = refined.grid, Grid()
        there.low, there.spacing = wp.vec3(*map(float, grid.low - self._center)), grid.spacing
        there.distance, there.inexact = (
            wp.array(np.ascontiguousarray(each), dtype=float, device=self.device)
            for each in (grid.distance, grid.inexact)
        )
        return there

    def _array(self, values: Array, kind: Any) -> Any:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=kind, device=self.device)

    def __call__(self, world_from_part: Tensor, world_from_peg: Tensor) -> Gap:
        """Gaps (N, T) where the poses (N, 7) of the part are, at (T, 7) of the peg, or (N, T, 7)."""
        device = warp_arrays.torch_device(self.device)
        part, peg = (each.detach().to(device) for each in (world_from_part, world_from_peg))
        peg = peg if peg.ndim == 3 else peg[None]
        with self.effort.measure(items=len(part) * peg.shape[1]):
            turns = [poses.rotation_matrix(each) for each in (part, peg)]
            distance, witness, normal = self._launch(turns[0], part[:, :3], turns[1], peg[..., :3])
            found = (distance.double(), witness.double() + self._middle, normal.double())
        return Gap(*(on_device_of(each, world_from_part) for each in found))

    def _launch(self, *frames: Tensor) -> list[Tensor]:
        """Distances (N, T), witness points about the mesh's centre and normals, in single precision.

        Frames are turns (N, 3, 3) and shifts (N, 3) of the part, and (1 or N, T, ...) of the peg.
        """
        shape = (len(frames[0]), frames[2].shape[1])
        results = [frames[0].new_empty((*shape, *more), dtype=torch.float32) for more in ((), (3,), (3,))]
        if 0 in shape:
            return results
        kinds = (wp.mat33d, wp.vec3d) * 2
        written = list(zip(results, (wp.float32, wp.vec3, wp.vec3), strict=True))
        inputs = [self._bodies, *zip(frames, kinds, strict=True), wp.vec3d(*map(float, self._center))]
        # Neighbouring threads measure one pose of the peg, at which they do about the same.
        warp_arrays.launch(_measure, shape[::-1], inputs, written)
        return results

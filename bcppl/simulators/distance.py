"""Signed distance from points to a part's surface."""

from __future__ import annotations

from typing import NamedTuple

import igl
import numpy as np
import torch
import trimesh
from torch import Tensor

from bcppl.parts import Part
from bcppl.simulators.effort import Effort

# Nearer to the surface than this (m), the way to the closest point is rounding: the face's normal is taken.
ON_SURFACE = 1e-9


class Proximity(NamedTuple):
    """How points (..., 3) lie to a surface.

    Attributes:
        distance: (...,) signed distance in metres, positive outside.
        closest: (..., 3) the closest point of the surface.
        normal: (..., 3) the outward unit normal there, as the gradient of the distance: next to an edge or
            a corner it points from the closest point to the query, so it is continuous outside.
    """

    distance: Tensor
    closest: Tensor
    normal: Tensor


class SignedDistance:
    """The signed distance to a part's closed mesh, for batches of points in the part's frame.

    The sign comes from angle-weighted pseudonormals (Baerentzen and Aanaes, "Signed distance computation
    using the angle weighted pseudonormal", 2005), as libigl computes them; vertices doubled at seams are
    merged first. 45 000 points take 20 ms on one core for a prism of 8 triangles, 130 ms for a sphere of
    5120.

    Attributes:
        part: the part.
        effort: calls, and points as `items`.

    Raises:
        InputError: the part's mesh is empty, open or not finite (after merging doubled vertices).
    """

    def __init__(self, part: Part) -> None:
        self.part = part
        self.effort = Effort()
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces())
        Part(part.name, np.asarray(mesh.vertices), np.asarray(mesh.faces)).check()
        self._vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
        self._faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)

    def __call__(self, points: Tensor) -> Proximity:
        """Distance, closest point and normal of points (..., 3) in the part's frame, metres; no gradient."""
        shape = points.shape[:-1]
        flat = np.ascontiguousarray(points.detach().reshape(-1, 3).numpy(), dtype=np.float64)
        if len(flat) == 0:
            return Proximity(
                points.new_zeros(shape), points.new_zeros(points.shape), points.new_zeros(points.shape)
            )
        with self.effort.measure(items=len(flat)):
            distance, _, closest, normal = igl.signed_distance(
                flat,
                self._vertices,
                self._faces,
                sign_type=igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
            )
        away = np.abs(distance) > ON_SURFACE
        normal[away] = (flat[away] - closest[away]) / distance[away, None]
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        return Proximity(
            torch.from_numpy(distance).reshape(shape),
            torch.from_numpy(closest).reshape(*shape, 3),
            torch.from_numpy(normal).reshape(*shape, 3),
        )

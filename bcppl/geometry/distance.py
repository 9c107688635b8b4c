"""Signed distance from points to a part's surface."""

from __future__ import annotations

from typing import NamedTuple

import igl
import numpy as np
import torch
import trimesh
from torch import Tensor

from bcppl.arrays import Array, Indices
from bcppl.effort import Effort
from bcppl.geometry.parts import Part

_ON_EDGE = 1e-12  # barycentric coordinate up to which a point lies on an edge or a vertex
# m from the surface up to which the direction to the closest point is rounding: the pseudonormal is used.
ON_SURFACE = 1e-9


class Proximity(NamedTuple):
    """Signed distances of points (..., 3) to a surface, their closest points and the gradient.

    Attributes:
        distance: (...,) signed distance in metres, positive outside.
        closest: (..., 3) the closest point of the surface.
        normal: (..., 3) the gradient of the distance, the outward unit normal: next to an edge or a vertex it
            points from the closest point to the query point, so it is continuous outside.
    """

    distance: Tensor
    closest: Tensor
    normal: Tensor


class SignedDistance:
    """The signed distance to a part's closed mesh, for batches of points in the part's frame.

    The sign comes from angle-weighted pseudonormals (Baerentzen and Aanaes, "Signed distance computation
    using the angle weighted pseudonormal", 2005), as libigl computes them; duplicate vertices at seams are
    merged first. 45 000 points take 20 ms on one core for a prism of 8 triangles, 130 ms for a sphere of
    5120.

    Attributes:
        part: the part.
        effort: calls, and points as `items`.

    Raises:
        InputError: the part's mesh is empty, open or not finite (after merging duplicate vertices).
    """

    __caches__ = ("_tree",)  # of the vertices and faces

    def __init__(self, part: Part) -> None:
        self.part = part
        self.effort = Effort()
        mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces())
        Part(part.name, np.asarray(mesh.vertices), np.asarray(mesh.faces)).check()
        self._vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
        self._faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
        # The tree is built once; igl.signed_distance builds one at each call (80 ms for 30 000 triangles).
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        by_angle = igl.PerVertexNormalsWeightingType.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
        evenly = igl.PerEdgeNormalsWeightingType.PER_EDGE_NORMALS_WEIGHTING_TYPE_UNIFORM
        self._face_normals = igl.per_face_normals(self._vertices, self._faces)
        self._vertex_normals = igl.per_vertex_normals(self._vertices, self._faces, by_angle)
        self._edge_normals, _, edge_of = igl.per_edge_normals(self._vertices, self._faces, evenly)
        self._edge_of = edge_of.reshape(3, -1)

    def __call__(self, points: Tensor) -> Proximity:
        """Proximities of points (..., 3) in the part's frame, metres; detached from autograd."""
        shape = points.shape[:-1]
        flat = np.ascontiguousarray(points.detach().reshape(-1, 3).numpy(), dtype=np.float64)
        if len(flat) == 0:
            return Proximity(points.new_zeros(shape), points.clone(), points.clone())
        with self.effort.measure(items=len(flat)):
            squared, face, closest = self._tree.squared_distance(self._vertices, self._faces, flat)
            normal = self._pseudonormals(face, closest)
            distance = np.copysign(np.sqrt(squared), np.einsum("pi,pi->p", flat - closest, normal))
        away = np.abs(distance) > ON_SURFACE
        normal[away] = (flat[away] - closest[away]) / distance[away, None]
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        return Proximity(
            torch.from_numpy(distance).reshape(shape),
            torch.from_numpy(closest).reshape(*shape, 3),
            torch.from_numpy(normal).reshape(*shape, 3),
        )

    def _pseudonormals(self, face: Indices, closest: Array) -> Array:
        """Pseudonormals (P, 3) at points of the mesh: of a face, an edge or a vertex."""
        corners = self._vertices[self._faces[face]]
        opposite = corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]
        across = np.cross(opposite, closest[:, None] - corners[:, [1, 2, 0]])
        shares = np.einsum("pki,pi->pk", across, self._face_normals[face])
        shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1e-300)
        beside = shares <= _ON_EDGE
        normal = self._face_normals[face].copy()
        count = beside.sum(axis=1)
        edge = np.flatnonzero(count == 1)
        normal[edge] = self._edge_normals[self._edge_of[beside[edge].argmax(axis=1), face[edge]]]
        corner = np.flatnonzero(count >= 2)
        nearest = self._faces[face[corner], shares[corner].argmax(axis=1)]
        normal[corner] = self._vertex_normals[nearest]
        return normal

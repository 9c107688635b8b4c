"""Signed distance from points to a part's surface."""

from __future__ import annotations

import math
from typing import NamedTuple

import igl
import numpy as np
import torch
import trimesh
from torch import Tensor

from bcppl.arrays import Array, Indices
from bcppl.compiled import compiled
from bcppl.effort import Effort
from bcppl.geometry.parts import Part
from bcppl.geometry.triangle_tree import TriangleTree, closest_triangle, triangle_tree
from bcppl.threads import parallel_sum, thread_count

_ON_EDGE = 1e-12  # barycentric coordinate up to which a point lies on an edge or a vertex
# m from the surface up to which the direction to the closest point is rounding: the pseudonormal is used.
ON_SURFACE = 1e-9
_POINTS = 2000  # of a chunk of work


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


def closed_mesh(part: Part) -> trimesh.Trimesh:
    """A part's mesh, its duplicate vertices merged and its degenerate triangles left out.

    Raises:
        InputError: it is empty, open, not finite or in millimetres.
    """
    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
    if len(part.vertices) and len(part.faces):
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces())
    Part(part.name, np.asarray(mesh.vertices), np.asarray(mesh.faces)).check()
    return mesh


class SignedDistance:
    """The signed distance to a part's closed mesh, for batches of points in the part's frame.

    The sign comes from angle-weighted pseudonormals (Baerentzen and Aanaes, "Signed distance computation
    using the angle weighted pseudonormal", 2005), as libigl computes them; duplicate vertices at seams are
    merged first. On one core 45 000 points anywhere take 28 ms for a prism of 12 triangles, 280 ms for a
    sphere of 5120; points that follow one another nearby take less.

    Attributes:
        part: the part.
        effort: calls, and points as `items`.

    Raises:
        InputError: the part's mesh is empty, open or not finite (after merging duplicate vertices).
    """

    def __init__(self, part: Part) -> None:
        self.part = part
        self.effort = Effort()
        mesh = closed_mesh(part)
        vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
        by_angle = igl.PerVertexNormalsWeightingType.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
        evenly = igl.PerEdgeNormalsWeightingType.PER_EDGE_NORMALS_WEIGHTING_TYPE_UNIFORM
        edge_normals, _, edge_of = igl.per_edge_normals(vertices, faces, evenly)
        self.surface = Surface(
            triangle_tree(vertices, faces),
            faces,
            igl.per_face_normals(vertices, faces),
            edge_normals,
            igl.per_vertex_normals(vertices, faces, by_angle),
            np.ascontiguousarray(edge_of.reshape(3, -1), dtype=np.int64),
        )

    def __call__(self, points: Tensor) -> Proximity:
        """Proximities of points (..., 3) in the part's frame, metres; detached from autograd."""
        shape = points.shape[:-1]
        flat = np.ascontiguousarray(points.detach().reshape(-1, 3).numpy(), dtype=np.float64)
        if len(flat) == 0:
            return Proximity(points.new_zeros(shape), points.clone(), points.clone())
        distance, closest, normal = np.empty(len(flat)), np.empty_like(flat), np.empty_like(flat)

        def work(begin: int, end: int) -> int:
            _signed(begin, end, flat, self.surface, distance, closest, normal)
            return 0

        with self.effort.measure(items=len(flat)):
            parallel_sum(work, 0, len(flat), _POINTS, thread_count())
        return Proximity(
            torch.from_numpy(distance).reshape(shape),
            torch.from_numpy(closest).reshape(*shape, 3),
            torch.from_numpy(normal).reshape(*shape, 3),
        )


class Surface(NamedTuple):
    """A closed mesh: its triangles, faces (F, 3), and pseudonormals of faces, edges and vertices.

    `edge_of` (3, F) is the number of the edge across from each face's corner.
    """

    tree: TriangleTree
    faces: Indices
    face_normals: Array
    edge_normals: Array
    vertex_normals: Array
    edge_of: Indices


@compiled
def _signed(
    begin: int, end: int, points: Array, surface: Surface, distance: Array, closest: Array, normal: Array
) -> None:
    """Set signed distances (P,), closest points and unit gradients (P, 3) of points (P, 3)."""
    guess = 0
    for p in range(begin, end):
        distance[p], guess = signed_at(points[p], surface, guess, closest[p], normal[p])


@compiled
def signed_at(point: Array, surface: Surface, guess: int, closest: Array, normal: Array) -> tuple[float, int]:
    """Set the closest point (3,) of a surface and the unit gradient (3,) there.

    Returns:
        the signed distance, and the triangle, which is a `guess` for a point nearby.
    """
    tree, most, beside, edge = surface.tree, 0, 0, 0
    best, squared, u, v = closest_triangle(point[0], point[1], point[2], tree, guess)
    face, shares = tree.face[best], (1.0 - u - v, u, v)
    for k in range(3):
        if shares[k] <= _ON_EDGE:
            beside, edge = beside + 1, k
        if shares[k] > shares[most]:
            most = k
    # Of the face, of the edge across from the corner that has no share, or of the corner that has all.
    normals, place = surface.face_normals, face
    if beside == 1:
        normals, place = surface.edge_normals, surface.edge_of[edge, face]
    elif beside > 1:
        normals, place = surface.vertex_normals, surface.faces[face, most]
    length, outward = math.sqrt(squared), 0.0
    for axis in range(3):
        corner, along, other = (
            tree.triangles[best, 0, axis],
            tree.triangles[best, 1, axis],
            tree.triangles[best, 2, axis],
        )
        closest[axis] = corner + u * along + v * other
        outward += (point[axis] - closest[axis]) * normals[place, axis]
    distance = math.copysign(length, outward)
    total = 0.0
    for axis in range(3):
        normal[axis] = normals[place, axis]
        if length > ON_SURFACE:
            normal[axis] = (point[axis] - closest[axis]) / distance
        total += normal[axis] ** 2
    for axis in range(3):
        normal[axis] /= math.sqrt(total)
    return distance, best

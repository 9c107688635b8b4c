"""The surface of a peg: its intersections with lines, its sharp edges and its corners."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bcppl.arrays import Array, Indices, Mask
from bcppl.cached import cached_property
from bcppl.geometry.distance import closed_mesh
from bcppl.geometry.parts import Part

SHARP = np.radians(30.0)  # faces that meet at less than this form one smooth surface, edges one smooth curve
STEP = 2e-5  # m past a crossing where the next ray begins: thinner walls are missed
MOST_LAYERS = 12  # times that a line may enter the surface


class Crossings(NamedTuple):
    """Points (Q, 3) where lines enter a solid, and the indices (Q,) of the line and of the triangle."""

    line: Indices
    point: Array
    face: Indices


class Edges(NamedTuple):
    """Sharp convex edges (E, 3) from their start, normals (E, 9, 3) from one face's to the other's.

    `chain` (E,) is the index of the smooth curve that an edge belongs to.
    """

    start: Array
    extent: Array
    normals: Array
    chain: Indices


class PegSurface:
    """The surface of a part, in its frame.

    Attributes:
        mesh: closed, its duplicate vertices merged.
        center: (3,) of a bounding ball.
        radius: of that ball, metres.
        anchors: (F, 3) a corner of each triangle.
        normals: (F, 3) outward normals of the triangles.
        area: m^2.

    Raises:
        InputError: the mesh is empty, open, not finite or in millimetres.
    """

    def __init__(self, part: Part) -> None:
        self.mesh = mesh = closed_mesh(part)
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        self.center = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        self.radius = float(np.linalg.norm(vertices - self.center, axis=1).max())
        corners = vertices[mesh.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.normals = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        self.area = float(mesh.area)
        self.anchors = corners[:, 0]

    @cached_property
    def patch(self) -> Indices:
        """(F,) the smooth surface that each triangle belongs to."""
        smooth = self.mesh.face_adjacency[self.mesh.face_adjacency_angles < SHARP]
        return _groups(smooth, len(self.mesh.faces))

    @cached_property
    def _scene(self) -> EmbreeScene:
        scene = EmbreeScene()
        TriangleMesh(scene, self.mesh.vertices.astype(np.float32), self.mesh.faces.astype(np.int32))
        return scene

    def first_face(self, origin: Array, direction: Array) -> Indices:
        """The first triangle (L,) that rays meet, -1 for none, in single precision."""
        rays = (origin.astype(np.float32), direction.astype(np.float32))
        return np.asarray(self._scene.run(*rays), dtype=np.int64)

    def entries(self, point: Array, direction: Array) -> Crossings:
        """All points where lines through points (L, 3), with unit directions (L, 3), enter the solid.

        They are computed in double precision from the triangles that the ray tracer returns.
        """
        along = np.sum((self.center - point) * direction, axis=1, keepdims=True)
        origin = point + (along - 1.1 * self.radius) * direction
        line = np.arange(len(point))
        batches: list[tuple[Indices, Array, Indices]] = []
        for _ in range(2 * (1 if self.mesh.is_convex else MOST_LAYERS) - 1):
            face = self.first_face(origin, direction)
            hit = face >= 0
            line, origin, direction, face = line[hit], origin[hit], direction[hit], face[hit]
            normal = self.normals[face]
            cosine = np.sum(direction * normal, axis=1)
            # A ray that grazes a triangle in single precision may be parallel to it in double precision.
            safe = np.where(np.abs(cosine) < 1e-9, 1e-9, cosine)
            reach = np.sum((self.anchors[face] - origin) * normal, axis=1) / safe
            reach = np.where(np.abs(cosine) < 1e-9, 0.0, reach)
            at = origin + reach[:, None] * direction
            into = cosine < -1e-9
            batches.append((line[into], at[into], face[into]))
            if not len(line):
                break
            origin = origin + (np.maximum(reach, 0.0) + STEP)[:, None] * direction
        return Crossings(*(np.concatenate(column) for column in zip(*batches, strict=True)))

    @property
    def _sharp(self) -> Mask:
        """Pairs of adjacent triangles that meet at a sharp convex edge."""
        return np.asarray((self.mesh.face_adjacency_angles >= SHARP) & self.mesh.face_adjacency_convex)

    @cached_property
    def edges(self) -> Edges:
        """The sharp convex edges."""
        mesh, sharp = self.mesh, self._sharp
        pairs = np.asarray(mesh.face_adjacency_edges[sharp], dtype=np.int64)
        ends = np.asarray(mesh.vertices, dtype=np.float64)[pairs]
        start, extent = ends[:, 0], ends[:, 1] - ends[:, 0]
        a, b = (self.normals[np.asarray(mesh.face_adjacency[sharp])[:, side]] for side in (0, 1))
        angle = np.arccos(np.clip(np.sum(a * b, axis=1), -1.0, 1.0))[:, None, None]
        share = np.linspace(0.0, 1.0, 9)[:, None]
        turned = np.sin((1.0 - share) * angle) * a[:, None] + np.sin(share * angle) * b[:, None]
        normals = turned / np.linalg.norm(turned, axis=-1, keepdims=True) if len(pairs) else turned
        return Edges(start, extent, normals, _chains(pairs, extent))

    @cached_property
    def length(self) -> float:
        """The total length of the sharp convex edges, metres."""
        return float(np.linalg.norm(self.edges.extent, axis=1).sum())

    @cached_property
    def corners(self) -> tuple[Array, Array]:
        """Points (C, 3) where three or more sharp convex edges meet, and outward normals (C, K, 3) at each.

        The normals are those of the faces and between; where there are fewer, some are repeated.
        """
        mesh = self.mesh
        count = np.bincount(mesh.face_adjacency_edges[self._sharp].reshape(-1), minlength=len(mesh.vertices))
        chosen = np.flatnonzero(count >= 3)
        weights = np.array([(i, j, 9 - i - j) for i in range(10) for j in range(10 - i)]) / 9.0
        normals = []
        for vertex in chosen:
            around = self.normals[[f for f in mesh.vertex_faces[vertex] if f >= 0]]
            around = around[np.unique(np.round(around, 6), axis=0, return_index=True)[1]]
            threes = np.array([(i, j, k) for i in range(len(around)) for j in range(i) for k in range(j)])
            mixed = np.einsum("wt,ntx->nwx", weights, around[threes]).reshape(-1, 3)
            size = np.linalg.norm(mixed, axis=1, keepdims=True)
            normals.append((mixed / np.maximum(size, 1e-12))[size[:, 0] > 1e-6])
        most = max((len(n) for n in normals), default=1)
        padded = np.array([np.resize(n, (most, 3)) for n in normals]).reshape(-1, most, 3)
        return np.asarray(mesh.vertices, dtype=np.float64)[chosen], padded


def _groups(pairs: npt.ArrayLike, count: int) -> Indices:
    """Labels (count,) of the connected components of a graph with edges (P, 2)."""
    linked = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
    graph = coo_array((np.ones(len(linked)), (linked[:, 0], linked[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _chains(pairs: Indices, extent: Array) -> Indices:
    """Labels (E,) of edges that continue one another without a sharp turn."""
    ends: dict[int, list[int]] = {}
    for edge, vertices in enumerate(pairs):
        for vertex in vertices:
            ends.setdefault(int(vertex), []).append(edge)
    along = extent / np.maximum(np.linalg.norm(extent, axis=1, keepdims=True), 1e-30)
    smooth = [
        pair
        for pair in (edges for edges in ends.values() if len(edges) == 2)
        if abs(float(along[pair[0]] @ along[pair[1]])) > np.cos(SHARP)
    ]
    return _groups(smooth, len(pairs))

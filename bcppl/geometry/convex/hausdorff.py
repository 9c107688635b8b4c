"""Hausdorff distances between a part's mesh and the union of its convex pieces, in both directions."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import torch
import trimesh

from bcppl.arrays import Array
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.parts import Part, Piece

_BATCH = 4096  # points whose distances to all planes are in memory at once


@dataclass(frozen=True)
class HausdorffError:
    """Directed Hausdorff distances between a solid and the union of its convex pieces, metres.

    Attributes:
        added: from the pieces to the solid: the farthest that a piece extends outside the mesh.
        lost: from the solid to the pieces: the farthest that the mesh extends outside all pieces.
    """

    added: float
    lost: float

    @property
    def largest(self) -> float:
        """The Hausdorff distance, the larger of the two, metres."""
        return max(self.added, self.lost)


def hausdorff_error(part: Part, count: int = 20000, seed: int = 0) -> HausdorffError:
    """The Hausdorff error of a part's pieces, over vertices and `count` uniform samples of either surface.

    Raises:
        InputError: the mesh is empty, open or not finite.
        ValueError: the part has no pieces.
    """
    solids = [solid_of(piece) for piece in part.pieces]
    corners = np.concatenate([solid.vertices for solid in solids])
    whole = trimesh.util.concatenate(solids)
    spread, _ = trimesh.sample.sample_surface(whole, count, seed=seed)
    on_pieces = torch.from_numpy(np.concatenate([corners, spread]))
    # Where bodies overlap, the nearest surface may be one that lies inside another body.
    beyond = torch.full((len(on_pieces),), torch.inf, dtype=torch.float64)
    for body in bodies_of(part.mesh):
        single = Part(part.name, np.asarray(body.vertices), np.asarray(body.faces, dtype=np.int64))
        beyond = torch.minimum(beyond, SignedDistance(single)(on_pieces).distance)
    added = float(beyond.max())
    on_mesh = np.concatenate([part.vertices, part.surface_points(count, seed)])
    return HausdorffError(max(0.0, added), float(_outside(on_mesh, solids).max()))


def bodies_of(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """The connected components of a mesh, which may overlap; the whole mesh where one is open or a cavity."""
    bodies = list(mesh.split(only_watertight=False))
    sound = len(bodies) > 1 and all(body.is_watertight and body.volume > 0 for body in bodies)
    return bodies if sound else [mesh]


def solid_of(piece: Piece) -> trimesh.Trimesh:
    """A closed mesh of a convex piece in the part's frame; a cylinder has 256 sides."""
    if piece.kind == "hull":
        return trimesh.convex.convex_hull(piece.size)
    if piece.kind == "box":
        solid = trimesh.creation.box(2.0 * piece.size)
    else:
        solid = trimesh.creation.cylinder(piece.size[0], 2.0 * piece.size[1], sections=256)
    solid.apply_translation(piece.center)
    return solid


def planes_of(solid: trimesh.Trimesh) -> Array:
    """The planes (F, 4) of a mesh's faces: outward unit normal and offset."""
    normals = np.asarray(solid.face_normals)
    return np.column_stack([normals, np.sum(normals * solid.triangles[:, 0], axis=1)])


def _outside(points: Array, solids: list[trimesh.Trimesh]) -> Array:
    """Distances (P,) of points (P, 3) to the union of convex solids; 0 inside."""
    points, beyond = np.asfortranarray(points), np.full(len(points), np.inf)
    for solid in solids:
        close = np.flatnonzero(_beyond_box(points.T, solid) < beyond)
        beyond[close] = np.minimum(beyond[close], _beyond_planes(points[close], solid))
    # The farthest plane decides between inside and outside. It only bounds the distance to the surface below:
    # beyond an edge or a vertex that is more.
    distance, outside = np.where(beyond > 1e-9, np.inf, 0.0), np.flatnonzero(beyond > 1e-9)
    for solid in solids:
        close = outside[_beyond_box(points[outside].T, solid) < distance[outside]]
        close = close[_beyond_planes(points[close], solid) < distance[close]]
        if len(close):
            corners, faces = np.array(solid.vertices), np.array(solid.faces, dtype=np.int64)
            squared = igl.point_mesh_squared_distance(np.ascontiguousarray(points[close]), corners, faces)[0]
            distance[close] = np.minimum(distance[close], np.sqrt(squared))
    return distance


def _beyond_box(columns: Array, solid: trimesh.Trimesh) -> Array:
    """Lower bounds (P,) on the distances of points (3, P) to a solid, from its bounding box."""
    low, high = solid.bounds[..., None]
    return np.asarray(np.maximum(low - columns, columns - high).max(axis=0))


def _beyond_planes(points: Array, solid: trimesh.Trimesh) -> Array:
    """Lower bounds (P,) on the distances of points (P, 3) to a convex solid, from its planes; 0 inside."""
    planes, starts = planes_of(solid), range(0, len(points), _BATCH)
    farthest = [(points[k : k + _BATCH] @ planes[:, :3].T - planes[:, 3]).max(axis=1) for k in starts]
    return np.maximum(np.concatenate(farthest), 0.0) if farthest else np.empty(0)

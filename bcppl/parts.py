"""Parts: the rigid bodies that are looked for, touched, and held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
import trimesh

from bcppl.errors import InputError

Array = npt.NDArray[np.float64]

LARGEST_EXTENT = 5.0  # m: a part larger than this is a mesh in millimetres


@dataclass(frozen=True)
class Piece:
    """One convex piece of a part's collision geometry.

    Attributes:
        kind: "box", "cylinder" (its axis along z) or "hull".
        size: half extents (3,) of a box, radius and half length (2,) of a cylinder, both in metres;
            vertices (V, 3) of a hull in the part's frame.
        center: (3,) where a box or cylinder is centred, in the part's frame (its axes are the part's).
    """

    kind: str
    size: Array
    center: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class Part:
    """A rigid part: a closed triangle mesh and, where it is touched, exact convex pieces.

    Attributes:
        name: what people call it.
        vertices: (V, 3) in metres, in the part's frame.
        faces: (F, 3) indices of vertices, counter-clockwise seen from outside.
        pieces: convex pieces whose union is the solid; empty where the part is never touched in simulation.
        source: where the mesh comes from: attribution and licence.
    """

    name: str
    vertices: Array
    faces: npt.NDArray[np.int64]
    pieces: Sequence[Piece] = ()
    source: str = ""

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The mesh as trimesh has it, vertices as given."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    @property
    def extent(self) -> Array:
        """Side lengths (3,) of the bounding box along the part's axes, metres."""
        return np.asarray(self.vertices.max(axis=0) - self.vertices.min(axis=0))

    @cached_property
    def diameter(self) -> float:
        """The largest distance between two vertices, metres (as the BOP benchmark has it)."""
        from scipy.spatial.distance import pdist

        hull = self.vertices if len(self.vertices) <= 4 else self.mesh.convex_hull.vertices
        return float(pdist(hull).max())

    def surface_points(self, count: int = 1000, seed: int = 0) -> Array:
        """Points (count, 3) spread evenly over the surface by area, in the part's frame; ADD is over them."""
        points, _ = trimesh.sample.sample_surface(self.mesh, count, seed=seed)
        return np.ascontiguousarray(points, dtype=np.float64)

    def check(self, closed: bool = True) -> None:
        """Refuse a mesh that cannot be rendered or touched.

        Raises:
            InputError: the mesh is empty, not finite, larger than 5 m, or (with `closed`) open.
        """
        if len(self.faces) == 0 or len(self.vertices) == 0:
            raise InputError(f"part {self.name!r} has an empty mesh; export it again with its triangles.")
        if not np.isfinite(self.vertices).all():
            raise InputError(f"part {self.name!r} has a vertex that is not finite; export its mesh again.")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise InputError(
                f"part {self.name!r} has a face that points at no vertex; export its mesh again."
            )
        if self.extent.max() > LARGEST_EXTENT:
            raise InputError(
                f"part {self.name!r} is {self.extent.max():.0f} m long: its mesh is probably in millimetres; "
                "scale it by 0.001 to metres."
            )
        if closed and not self.mesh.is_watertight:
            edges = int(trimesh.grouping.group_rows(self.mesh.edges_sorted, require_count=1).shape[0])
            raise InputError(
                f"part {self.name!r} has an open mesh ({edges} open edges); close its holes, "
                "or merge vertices that are doubled at seams."
            )

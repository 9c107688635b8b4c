"""A peg as convex solids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bcppl.arrays import Array, Indices
from bcppl.geometry.bounding_spheres import bounding_sphere, compact_groups
from bcppl.geometry.convex.hausdorff import planes_of, solid_of
from bcppl.geometry.parts import Part


class Solids(NamedTuple):
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


def solids_of(peg: Part) -> Solids:
    """Of a peg: its convex pieces, or its hull where its mesh is convex or has none."""
    meshes = [peg.mesh.convex_hull] if peg.mesh.is_convex or not peg.pieces else map(solid_of, peg.pieces)
    planes = [np.unique(np.round(planes_of(mesh), 9), axis=0) for mesh in meshes]
    corners = np.unique(np.round(peg.vertices, 9), axis=0)
    groups = compact_groups(corners)
    return Solids(
        corners=corners[np.concatenate(groups)],
        stops=np.cumsum([len(group) for group in groups]),
        spheres=np.stack([bounding_sphere(corners[group]) for group in groups]),
        planes=np.concatenate(planes),
        ends=np.cumsum([len(each) for each in planes]),
        box=np.stack([peg.vertices.min(axis=0), peg.vertices.max(axis=0)]),
    )

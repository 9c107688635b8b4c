"""A peg as convex solids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bcppl.arrays import Array, Indices
from bcppl.errors import InputError
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
    """Of a peg: its hull where its mesh is convex, else its convex pieces.

    Raises:
        InputError: its mesh is not convex and it has no pieces; its hull would fill grooves and notches.
    """
    if not peg.mesh.is_convex and not peg.pieces:
        raise InputError(
            f"part {peg.name!r} has no convex pieces and its mesh is not convex, so the gap of this peg "
            "cannot be measured; give it convex pieces with `bcppl.geometry.extrusion.extruded` (from its "
            "outline), `bcppl.geometry.layers.prismatic` (upright walls) or "
            "`bcppl.geometry.convex.decomposition.decomposed` (any mesh)."
        )
    meshes = [peg.mesh.convex_hull] if peg.mesh.is_convex else map(solid_of, peg.pieces)
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

"""A part's mesh with fewer triangles, within micrometres of what it was."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import manifold3d
import numpy as np

from bcppl.geometry.parts import Part

# m, to where a peg touches, and to where an image sees it: depth errs by a tenth of a millimetre and more.
TOUCHED, SEEN = 1e-6, 1e-5


@lru_cache(maxsize=16)
def simplified(part: Part, tolerance: float = TOUCHED) -> Part:
    """The same solid, its surface moved by about a tolerance (m); the part itself where that saves nothing.

    Unions of pieces, as programs for design write them, have flat faces of many triangles. A tray of 22 000
    is left with 4 300. Edges are collapsed by Manifold. An open mesh stays as it is.
    """
    mesh = part.mesh.copy()
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    given = manifold3d.Mesh64(
        np.ascontiguousarray(mesh.vertices, np.float64), np.ascontiguousarray(mesh.faces, np.uint64)
    )
    solid = manifold3d.Manifold(given)
    if solid.status() != manifold3d.Error.NoError:
        return part
    fewer = solid.simplify(tolerance).to_mesh64()
    if len(fewer.tri_verts) >= len(part.faces):
        return part
    vertices, faces = np.asarray(fewer.vert_properties)[:, :3], np.asarray(fewer.tri_verts)
    return replace(part, vertices=vertices.copy(), faces=faces.astype(np.int64))

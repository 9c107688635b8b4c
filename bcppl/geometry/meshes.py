"""Parts from mesh files."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import trimesh

from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.geometry.parts import Part

LARGEST_UNSCALED = 1.0  # m: a larger mesh without a stated scale is in millimetres


def load_mesh(
    path: str | Path, name: str | None = None, scale: float | None = None, source: str = ""
) -> Part:
    """A part from an OBJ, STL, PLY or other mesh file that trimesh reads, checked, without convex pieces.

    Duplicate vertices, as of STL files and of seams of normals or textures, are merged: otherwise most closed
    meshes look open. All bodies of a file become one part. A mesh that is inside out is inverted, with a
    warning. A peg's frame must have its origin at the wrench sensor, above the tip: where the file has it
    elsewhere, use `Part.moved`.

    Args:
        path: the file; its coordinates are the part's frame.
        name: the part's name; None for the file's.
        scale: metres per unit of the file: 0.001 for millimetres. None assumes metres, and refuses a part
            longer than 1 m: a small part in millimetres would be a large one in metres.
        source: attribution and licence.

    Raises:
        InputError: there is no such file, it holds no mesh, or the mesh is empty, open, or in millimetres.
    """
    factor = 1.0 if scale is None else number_within(f"mesh file {path} has scale {{}}", scale, above=0.0)
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no mesh file {path}; give the path of an OBJ, STL or PLY file.")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # every format has its own reader with its own errors
        raise InputError(
            f"mesh file {path} cannot be read ({error}); export it again as OBJ or STL."
        ) from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"mesh file {path} holds no triangles; export it again as OBJ or STL.")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) and mesh.is_watertight and mesh.volume < 0:
        mesh.invert()
        warnings.warn(
            f"mesh file {path} is inside out; its faces are inverted.", RuntimeWarning, stacklevel=2
        )
    vertices = factor * np.asarray(mesh.vertices, dtype=np.float64)
    part = Part(name or path.stem, vertices, np.asarray(mesh.faces, dtype=np.int64), (), source)
    part.check()
    if scale is None and part.extent.max() > LARGEST_UNSCALED:
        raise InputError(
            f"mesh file {path} is {part.extent.max():.3g} m long if it is in metres; give scale=0.001 if it "
            "is in millimetres, scale=1.0 if the part is so large."
        )
    return part

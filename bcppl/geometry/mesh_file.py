"""Meshes in files: of formats whose size is that of their content, and of nothing but one file."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bcppl.errors import InputError, reason_of
from bcppl.untrusted.plain_xml import refuse_entities

if TYPE_CHECKING:
    import trimesh

FORMATS = (".obj", ".stl", ".ply", ".off", ".dae")  # no archives, which may hold a thousand times their size
LARGEST = 512 << 20  # bytes
LARGEST_TEXT = {
    ".obj": 32 << 20,
    ".off": 8 << 20,
    ".ply": 8 << 20,
}  # as text, which takes up to 20, 60, 60 times
MOST_BODIES = 1000  # groups, materials or solids: each takes half a millisecond and 50 kB
BODY = re.compile(rb"^\s*(?:o|g|usemtl|solid)\b", re.MULTILINE)
COUNTS = {
    ".ply": re.compile(rb"^\s*element\s+\S+\s+(\d+)", re.MULTILINE),
    ".off": re.compile(rb"\A\s*(?:C?OFF)?\s+(\d+)\s+(\d+)"),
}


def read_mesh(path: Path, process: bool = False) -> trimesh.Trimesh:
    """The triangles of a mesh file; all bodies of a file are one mesh. Materials and textures are not read.

    Args:
        path: of an OBJ, STL, PLY, OFF or DAE file.
        process: whether vertices at the same place are merged.

    Raises:
        InputError: it is of another format, cannot be read, claims more than its size explains, or has a
            vertex that is not finite or a face without vertices.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        known = ", ".join(each[1:].upper() for each in FORMATS)
        raise InputError(
            f"mesh file {path} is of none of the formats {known}; export it again as OBJ or STL."
        )
    import trimesh

    try:
        if path.stat().st_size > LARGEST:
            raise ValueError(f"it is larger than {LARGEST >> 20} MB")
        data = path.read_bytes()
        _refuse_claims(data, suffix)
        # A file object has no neighbours: neither materials nor textures are looked for beside it.
        mesh: Any = trimesh.load(
            io.BytesIO(data), file_type=suffix[1:], force="mesh", process=process, skip_materials=True
        )
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            raise ValueError("it holds no triangles")
        if not np.isfinite(mesh.vertices).all():
            raise ValueError("a vertex is not finite")
        if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
            raise ValueError("a face has no vertices")
    except Exception as error:  # every format has its own reader with its own errors
        # Of what it cannot read, trimesh guesses the encoding with a package that few have.
        guessed = isinstance(error, ImportError) and suffix != ".dae"
        reason = "it is damaged" if guessed else reason_of(error)
        raise InputError(
            f"mesh file {path} cannot be read ({reason}); export it again as OBJ or STL."
        ) from error
    return mesh


def _refuse_claims(data: bytes, suffix: str) -> None:
    """Refuse what takes far more memory or time than the size explains: claims, long text, many bodies."""
    header = data[: data.find(b"end_header")] if suffix == ".ply" else data[:1000]
    if suffix == ".dae":
        refuse_entities(data)
    if suffix in COUNTS:
        counts = [int(n) for found in COUNTS[suffix].finditer(header) for n in found.groups()]
        if sum(counts) > len(data):
            raise ValueError(f"it claims {sum(counts)} vertices and faces in {len(data)} bytes")
    most = LARGEST if suffix == ".ply" and b"ascii" not in header else LARGEST_TEXT.get(suffix, LARGEST)
    if len(data) > most:
        raise ValueError(f"it is larger than {most >> 20} MB; binary STL and PLY may have {LARGEST >> 20} MB")
    if suffix in (".obj", ".stl") and sum(1 for _ in BODY.finditer(data)) > MOST_BODIES:
        raise ValueError(f"it has more than {MOST_BODIES} bodies, groups or materials")

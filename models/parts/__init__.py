"""Parts by name: insert trays and their pegs, with exact convex pieces."""

from __future__ import annotations

from importlib.resources import as_file, files

import h5py
import numpy as np

from bcppl.errors import InputError
from bcppl.geometry.parts import Part, Piece

SHAPES = ("round", "rectangular")


def insert_tray(shape: str) -> Part:
    """The insert tray for an 8 mm peg, "round" or "rectangular".

    The part's frame: z up, the bottom at z = 0, the blind bore around the z axis from z = 3 mm up, chamfered
    from 27 to 28 mm. The round bore is 9 mm across, the rectangular one 9 mm by 8 mm.

    Raises:
        InputError: there is no such tray.
    """
    return _stored("tray", shape)


def insert_peg(shape: str) -> Part:
    """The 50 mm peg for the tray of that shape; its frame is that of `extrusion.box_peg`.

    The round one is 7.98 mm across, the rectangular one 7.96 mm by 6.92 mm.

    Raises:
        InputError: there is no such peg.
    """
    return _stored("peg", shape)


def _stored(kind: str, shape: str) -> Part:
    if shape not in SHAPES:
        raise InputError(f"there is no insert {kind} of shape {shape!r}; give one of {', '.join(SHAPES)}.")
    with as_file(files(__package__) / "insert_trays.h5") as path, h5py.File(path) as file:
        group = file[f"{shape} {kind}"]
        corners = np.asarray(group["corners"][()], dtype=np.float64)
        counts = np.asarray(group["counts"][()], dtype=np.int64)
        hulls = np.split(corners, np.cumsum(counts)[:-1])
        return Part(
            name=f"{shape} insert {kind}",
            vertices=np.asarray(group["vertices"][()], dtype=np.float64),
            faces=np.asarray(group["faces"][()], dtype=np.int64),
            pieces=tuple(Piece("hull", hull) for hull in hulls),
            source=str(file.attrs["source"]),
        )

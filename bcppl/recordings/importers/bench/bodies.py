"""The part, the peg and the guess of a bench, from meshes, dimensions and what is stated of poses."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from bcppl.errors import InputError
from bcppl.geometry.convex.decomposition import decomposed
from bcppl.geometry.extrusion import box_peg, round_peg
from bcppl.geometry.layers import prismatic
from bcppl.geometry.parts import Guess, Part, load_mesh
from bcppl.recordings.importers.bench.configuration.field_types import factor
from bcppl.recordings.importers.bench.configuration.fields import BodyFields, GuessFields, PegFields
from bcppl.recordings.importers.bench.pose_columns import stated_pose


def read_part(fields: BodyFields, folder: Path, report: list[str]) -> Part:
    """The part; its mesh's coordinates are its frame.

    Raises:
        InputError: the mesh cannot be read, or the pieces that are asked for cannot be made.
    """
    if fields.mesh is None:
        raise InputError("part needs a mesh; give the path of an STL, OBJ or PLY file.")
    return _described("part", _with_pieces("part", _shape(fields, folder, report), fields), report)


def read_peg(fields: PegFields, folder: Path, report: list[str]) -> Part:
    """The held peg, in its frame: the origin where it is held, z along it, away from its tip.

    Raises:
        InputError: as `read_part`, or its tip is not below its origin.
    """
    peg = _with_pieces("peg", _shape(fields, folder, report), fields)
    if fields.mesh is not None:
        peg = peg.moved(stated_pose("peg.peg_from_mesh", fields.peg_from_mesh))
    lowest, highest = peg.vertices[:, 2].min(), peg.vertices[:, 2].max()
    if not lowest < 0.0 or -lowest < 0.5 * highest:
        raise InputError(
            f"the peg reaches from z = {1000 * lowest:.1f} to {1000 * highest:.1f} mm of its frame, and "
            "its tip is to be the lowest z, below the origin where it is held; give peg.peg_from_mesh."
        )
    return _described("peg", peg, report)


def read_guess(fields: GuessFields) -> Guess:
    """The prior of the part's pose.

    Raises:
        InputError: its pose is none.
    """
    return Guess(
        world_from_part=stated_pose("guess.world_from_part", fields.world_from_part),
        translation=factor(fields.length) * np.array(fields.translation),
        tilt=min(factor(fields.angle) * fields.tilt, math.pi),
        yaw=min(factor(fields.angle) * fields.yaw, math.pi),
    )


def _shape(fields: BodyFields, folder: Path, report: list[str]) -> Part:
    scale = factor(fields.length)
    if fields.round is not None:
        diameter, length = fields.round
        return round_peg(0.5 * scale * diameter, scale * length, name=fields.name or "round peg")
    if fields.box is not None:
        width, *breadth, length = (scale * side for side in fields.box)
        return box_peg(width, length, breadth[0] if breadth else None, name=fields.name or "square peg")
    assert fields.mesh is not None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RuntimeWarning)
        part = load_mesh(folder / fields.mesh, fields.name, scale)
    report += [str(each.message) for each in caught]
    return part


def _with_pieces(which: str, part: Part, fields: BodyFields) -> Part:
    """The part with convex pieces; `auto` leaves out what cannot be cut into layers exactly."""
    if part.pieces or fields.pieces == "none":
        return part
    if fields.pieces == "coacd":
        assert fields.clearance is not None
        return decomposed(part, factor(fields.length) * fields.clearance).part
    try:
        return prismatic(part)
    except InputError as error:
        if fields.pieces == "layers":
            raise InputError(f"{which}.pieces is 'layers', but {error}") from error
        return replace(part, pieces=())


def _described(which: str, part: Part, report: list[str]) -> Part:
    sides = " x ".join(f"{1000.0 * side:.4g}" for side in part.extent)
    count = len(part.pieces)
    made = (
        f"{count} convex piece{'' if count == 1 else 's'}"
        if count
        else "no convex pieces, which contact physics needs and look_and_touch does not"
    )
    report.append(f"{which}: {part.name}, {sides} mm, {made}")
    return part

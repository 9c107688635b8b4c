"""The seven parts of the accuracy bench, each with the outline of its hole, and pegs of any clearance."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import shapely

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block_with_hole, peg_for
from bcppl.geometry.outlines import named_outline, rectangular_outline, round_outline
from bcppl.geometry.parts import Part
from bcppl.models.parts import insert_tray

PEG_LENGTH = 0.08  # m, from the wrench sensor to the tip
BLOCK = (0.06, 0.06, 0.025)  # m
OFFSET = (0.007, 0.005)  # m, of the hole in a block's frame
TRAY_TOP = 0.028  # m: height of a tray's top face in its frame, whose z = 0 is its underside


@dataclass(frozen=True, eq=False)
class BenchPart:
    """A part with a hole.

    Attributes:
        name: of the part.
        part: its geometry, for rendering and contact.
        hole: the hole's outline in its own frame, metres.
        part_from_hole: (7,) the hole's frame: origin at the centre of its outline in the plane of the part's
            top face, z out of the material.
        depth: of the hole below the top face, metres; a block's hole goes through.
    """

    name: str
    part: Part
    hole: shapely.Polygon
    part_from_hole: Array
    depth: float

    def peg(self, clearance: float) -> Part:
        """The peg that goes in with a diametral clearance (m), 80 mm long, its origin at the wrench sensor.

        Its axes are parallel to those of the hole's frame once it is in.

        Raises:
            InputError: the clearance is not positive, or leaves no peg.
        """
        name = f"peg for {self.name}, {1000 * clearance:g} mm of clearance"
        return peg_for(self.hole, clearance, PEG_LENGTH, name)


def _tray(shape: str) -> BenchPart:
    # The bore of the mesh is within 2 um of these; the corners of a round peg stand out by 3 um.
    hole = round_outline(0.009) if shape == "round" else rectangular_outline(0.009, 0.008)
    place = np.array([0.0, 0.0, TRAY_TOP, 1.0, 0.0, 0.0, 0.0])
    return BenchPart(f"{shape} tray", insert_tray(shape), hole, place, TRAY_TOP - 0.003)


def _block(name: str, outline: str, size: float) -> BenchPart:
    hole = named_outline(outline, size)
    part = block_with_hole(hole, BLOCK, OFFSET, name=f"block, {name}")
    return BenchPart(name, part, hole, np.array([*OFFSET, 0.0, 1.0, 0.0, 0.0, 0.0]), BLOCK[2])


PARTS: Mapping[str, Callable[[], BenchPart]] = {
    "round tray": lambda: _tray("round"),
    "rectangular tray": lambda: _tray("rectangular"),
    "round 8 mm": lambda: _block("round 8 mm", "round", 0.008),
    "round 16 mm": lambda: _block("round 16 mm", "round", 0.016),
    "square 8 mm": lambda: _block("square 8 mm", "square", 0.008),
    "hexagon 12 mm": lambda: _block("hexagon 12 mm", "hexagon", 0.012),
    "D 10 mm": lambda: _block("D 10 mm", "D", 0.010),
}


@functools.cache
def bench_part(name: str) -> BenchPart:
    """The part of a name in `PARTS`, built once.

    Raises:
        InputError: there is no such part.
    """
    if name not in PARTS:
        raise InputError(f"the bench has no part {name!r}; its parts are {', '.join(PARTS)}.")
    return PARTS[name]()

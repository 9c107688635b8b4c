"""Parts drawn from their exact outline: blocks with a hole, and pegs.

A hole is never decomposed from a mesh: convex pieces that stand in for a mesh eat its clearance.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
import trimesh

from bcppl.errors import InputError
from bcppl.geometry.parts import Part, Piece


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Piece:
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return Piece("box", 0.5 * (b - a), 0.5 * (a + b))


def _extruded(name: str, outline: shapely.Polygon, bottom: float, top: float, pieces: list[Piece]) -> Part:
    mesh = trimesh.creation.extrude_polygon(outline, top - bottom)
    vertices = np.asarray(mesh.vertices, dtype=np.float64) + np.array([0.0, 0.0, bottom])
    part = Part(name, vertices, np.asarray(mesh.faces, dtype=np.int64), pieces, source="drawn by bcppl")
    part.check()
    return part


def block_with_square_hole(
    size: tuple[float, float, float] = (0.06, 0.06, 0.025),
    hole: float = 0.0165,
    offset: tuple[float, float] = (0.0, 0.0),
    name: str = "block with a square hole",
) -> Part:
    """A rectangular block with a square hole through it.

    The part's frame: origin at the centre of the outer block's top face, x and y along its sides, z up,
    out of the material; the hole is centred at `offset` and its sides are parallel to x and y.

    Args:
        size: outer side lengths along x, y and z, metres.
        hole: side length of the hole, metres.
        offset: centre of the hole in the part's frame, metres.
        name: the part's name.

    Raises:
        InputError: the hole does not lie inside the block.
    """
    x, y, depth = 0.5 * size[0], 0.5 * size[1], size[2]
    half = 0.5 * hole
    if half <= 0 or abs(offset[0]) + half >= x or abs(offset[1]) + half >= y or depth <= 0:
        raise InputError(
            f"a hole of {hole:g} m at {offset} does not lie inside a block of {size} m; "
            "make it smaller or move it."
        )
    left, right = offset[0] - half, offset[0] + half
    front, back = offset[1] - half, offset[1] + half
    inner = shapely.box(left, front, right, back)
    outline = shapely.Polygon(shapely.box(-x, -y, x, y).exterior, [inner.exterior])
    # The walls overlap at the corners: no piece has a face inside the solid on which a peg could catch.
    pieces = [
        _box((-x, -y, -depth), (left, y, 0.0)),
        _box((right, -y, -depth), (x, y, 0.0)),
        _box((-x, -y, -depth), (x, front, 0.0)),
        _box((-x, back, -depth), (x, y, 0.0)),
    ]
    return _extruded(name, outline, -depth, 0.0, pieces)


def block(size: tuple[float, float, float], name: str = "block") -> Part:
    """A solid rectangular block; its frame is that of `block_with_square_hole`.

    Args:
        size: side lengths along x, y and z, metres.
        name: the part's name.
    """
    x, y, depth = 0.5 * size[0], 0.5 * size[1], size[2]
    return _extruded(name, shapely.box(-x, -y, x, y), -depth, 0.0, [_box((-x, -y, -depth), (x, y, 0.0))])


def box_peg(width: float, length: float, breadth: float | None = None, name: str = "square peg") -> Part:
    """A peg of rectangular section.

    The peg's frame: origin at the wrench sensor (the middle of the peg's upper end), z along the peg and
    away from the tip; the tip is at z = -length.

    Args:
        width: side length along x, metres.
        length: from the sensor to the tip, metres.
        breadth: side length along y, metres; None for a square section.
        name: the part's name.
    """
    x, y = 0.5 * width, 0.5 * (width if breadth is None else breadth)
    pieces = [_box((-x, -y, -length), (x, y, 0.0))]
    return _extruded(name, shapely.box(-x, -y, x, y), -length, 0.0, pieces)


def round_peg(radius: float, length: float, sides: int = 64, name: str = "round peg") -> Part:
    """A round peg, drawn and touched as a prism; its frame is that of `box_peg`.

    MuJoCo keeps four points of a flat contact: pressed flat on a plane, a round face's centre of pressure is
    off by up to 1 mm at a radius of 8 mm with 64 sides, and by up to 2 mm with MuJoCo's own cylinder.

    Args:
        radius: of the cylinder on which the prism's corners lie, metres.
        length: from the sensor to the tip, metres.
        sides: of the prism; the middles of its sides lie radius * (1 - cos(pi / sides)) inside the cylinder.
        name: the part's name.
    """
    angles = 2.0 * math.pi * np.arange(sides) / sides
    outline = shapely.Polygon(radius * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    corners = np.asarray(outline.exterior.coords)[:-1]
    hull = np.concatenate([np.insert(corners, 2, z, axis=1) for z in (-length, 0.0)])
    return _extruded(name, outline, -length, 0.0, [Piece("hull", hull)])

"""Solids extruded from outlines, blocks and pegs among them: an exact mesh, and convex prisms for contact.

A hole is never decomposed from a mesh: convex pieces that approximate a mesh take up its clearance.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
import trimesh
from shapely.affinity import rotate, translate

from bcppl.errors import InputError
from bcppl.geometry.convex.cover import Cell, convex_cells, straightened
from bcppl.geometry.outlines import check_outline, positive, rectangular_outline, round_outline
from bcppl.geometry.parts import Part, Piece

OVERLAP = 0.002  # m, the largest overlap of adjacent prisms
BEVEL = 0.0001  # m below the end faces at which prisms overlap by that much; deeper than contacts penetrate


def extruded(name: str, outline: shapely.Polygon, bottom: float, top: float) -> Part:
    """The solid extruded along z from an outline in the x-y plane, exact but for rounding.

    Its pieces are convex prisms whose union is the solid within 1e-9 m. Along the outline's own sides they
    overlap by up to 2 mm, so that no wall has a seam. On the end faces they meet without overlap: there each
    prism extends into its neighbours as a bevel, 0.1 mm below the face, so that a sliding peg does not catch.

    The outline is in metres, with or without holes; bottom and top are the z of the end faces, metres.

    Raises:
        InputError: the outline is empty, crosses itself, is in several pieces, or is probably in millimetres;
            or the top is not above the bottom.
    """
    check_outline(outline, name)
    if not bottom < top:
        raise InputError(
            f"part {name!r} would extend from z = {bottom:g} to {top:g} m; give a top above its bottom."
        )
    return _solid(name, shapely.normalize(outline), convex_cells(outline, OVERLAP), bottom, top)


def _solid(name: str, outline: shapely.Polygon, cells: list[Cell], bottom: float, top: float) -> Part:
    mesh = trimesh.creation.extrude_polygon(outline, top - bottom)
    vertices = np.asarray(mesh.vertices, dtype=np.float64) + np.array([0.0, 0.0, bottom])
    pieces = [_prism(cell, bottom, top) for cell in cells]
    part = Part(name, vertices, np.asarray(mesh.faces, dtype=np.int64), pieces, "drawn by bcppl")
    part.check()
    return part


def _prism(cell: Cell, bottom: float, top: float) -> Piece:
    """A cell extruded: its core over the full height, its overlap with other cells between the bevels."""
    low, high = cell.core.min(axis=0), cell.core.max(axis=0)
    own = np.prod(high - low)
    if len(cell.core) == len(cell.grown) == 4 and abs(shapely.Polygon(cell.core).area - own) <= 1e-12 * own:
        a, b = np.append(low, bottom), np.append(high, top)
        return Piece("box", 0.5 * (b - a), 0.5 * (a + b))
    bevel = min(BEVEL, 0.25 * (top - bottom))
    levels = [(cell.core, bottom), (cell.core, top)]
    if len(cell.grown) != len(cell.core) or not np.allclose(cell.grown, cell.core):
        levels += [(straightened(cell.grown), bottom + bevel), (straightened(cell.grown), top - bevel)]
    return Piece("hull", np.concatenate([np.insert(corners, 2, z, axis=1) for corners, z in levels]))


def _convex(outline: shapely.Polygon) -> Cell:
    corners = np.asarray(outline.exterior.coords)[:-1]
    return Cell(corners, corners)


def block(size: tuple[float, float, float], name: str = "block") -> Part:
    """A solid rectangular block with side lengths along x, y and z in metres.

    The part's frame: origin at the centre of the top face, x and y along the sides, z up, out of the
    material.
    """
    outline = rectangular_outline(size[0], size[1])
    return _solid(name, outline, [_convex(outline)], -size[2], 0.0)


def block_with_hole(
    hole: shapely.Polygon,
    size: tuple[float, float, float] = (0.06, 0.06, 0.025),
    offset: tuple[float, float] = (0.0, 0.0),
    turn: float = 0.0,
    name: str = "block with a hole",
) -> Part:
    """A rectangular block with a through hole of any outline; its frame is that of `block`.

    Args:
        hole: the hole's outline in its own frame, metres, without holes of its own.
        size: outer side lengths along x, y and z, metres.
        offset: origin of the hole's outline in the part's frame, metres.
        turn: rotation of the hole about z, radians.
        name: the part's name.

    Raises:
        InputError: the outline is not valid, or the hole does not lie inside the block.
    """
    return extruded(name, _pierced(hole, size, offset, turn, name), -size[2], 0.0)


def block_with_square_hole(
    size: tuple[float, float, float] = (0.06, 0.06, 0.025),
    hole: float = 0.0165,
    offset: tuple[float, float] = (0.0, 0.0),
    name: str = "block with a square hole",
) -> Part:
    """A rectangular block with a square through hole, its walls four boxes; its frame is that of `block`.

    Args:
        size: outer side lengths along x, y and z, metres.
        hole: side length of the hole, its sides parallel to x and y, metres.
        offset: centre of the hole in the part's frame, metres.
        name: the part's name.

    Raises:
        InputError: the hole does not lie inside the block.
    """
    outline = _pierced(rectangular_outline(hole, hole), size, offset, 0.0, name)
    (x0, y0, x1, y1), (left, front, right, back) = outline.bounds, outline.interiors[0].bounds
    # The walls overlap at the corners, so no piece has a face inside the solid on which a peg could catch.
    walls = [(x0, y0, left, y1), (right, y0, x1, y1), (x0, y0, x1, front), (x0, back, x1, y1)]
    return _solid(name, outline, [_convex(shapely.box(*wall)) for wall in walls], -size[2], 0.0)


def _pierced(
    hole: shapely.Polygon,
    size: tuple[float, float, float],
    offset: tuple[float, float],
    turn: float,
    name: str,
) -> shapely.Polygon:
    """The outline of a block with a hole in it."""
    check_outline(hole, f"hole of {name}")
    placed = translate(rotate(hole, turn, origin=(0.0, 0.0), use_radians=True), *offset)
    outer = rectangular_outline(size[0], size[1])
    if not outer.contains_properly(placed):
        low, high = np.reshape(placed.bounds, (2, 2))
        raise InputError(
            f"the hole of {name!r} spans {low.tolist()} to {high.tolist()} m and does not lie inside a block "
            f"of {size[0]:g} m by {size[1]:g} m; make it smaller or move it."
        )
    return shapely.Polygon(outer.exterior, [placed.exterior])


def box_peg(width: float, length: float, breadth: float | None = None, name: str = "square peg") -> Part:
    """A peg of rectangular cross section.

    The peg's frame: origin at the centre of the peg's upper end, where it is held, z along the peg and
    away from the tip; the tip is at z = -length.

    Args:
        width: side length along x, metres.
        length: from the upper end to the tip, metres.
        breadth: side length along y, metres; None for a square cross section.
        name: the part's name.
    """
    outline = rectangular_outline(width, width if breadth is None else breadth)
    return _solid(name, outline, [_convex(outline)], -length, 0.0)


def round_peg(radius: float, length: float, sides: int = 64, name: str = "round peg") -> Part:
    """A round peg as a prism, in its mesh and in contact; its frame is that of `box_peg`.

    MuJoCo keeps four points of a flat contact: with the tip pressed flat on a plane, the centre of pressure
    is off by up to 1 mm at a radius of 8 mm with 64 sides, and by up to 2 mm with MuJoCo's own cylinder.

    Args:
        radius: of the cylinder that circumscribes the prism, metres.
        length: from the sensor to the tip, metres.
        sides: of the prism; the centres of its sides lie radius * (1 - cos(pi / sides)) inside the cylinder.
        name: the part's name.
    """
    angles = 2.0 * math.pi * np.arange(sides) / sides
    outline = shapely.Polygon(radius * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    return _solid(name, outline, [_convex(outline)], -length, 0.0)


def cylinder_peg(diameter: float, length: float, name: str = "cylindrical peg") -> Part:
    """A round peg, in metres, that is an exact cylinder in contact; its frame is that of `box_peg`.

    With the tip pressed flat on a plane its centre of pressure is less exact than that of `round_peg`.
    """
    drawn = extruded(name, round_outline(diameter), -length, 0.0)
    piece = Piece("cylinder", np.array([0.5 * diameter, 0.5 * length]), np.array([0.0, 0.0, -0.5 * length]))
    return Part(name, drawn.vertices, drawn.faces, [piece], drawn.source)


def peg_for(hole: shapely.Polygon, clearance: float, length: float, name: str = "peg") -> Part:
    """The peg that fits a hole with a stated clearance, half of it on each side.

    The peg's frame is that of `box_peg`, its axes parallel to those of the hole's outline; with the peg in
    the hole its origin is above that of the outline.

    Args:
        hole: the hole's outline, metres.
        clearance: difference of the diameters, or of the distances between opposite flats, metres.
        length: from the sensor to the tip, metres.
        name: the part's name.

    Raises:
        InputError: the outline is not valid, the clearance is not positive, or it leaves no peg in one piece.
    """
    check_outline(hole, f"hole for {name}")
    positive(name, clearance=clearance)
    outline = hole.buffer(-0.5 * clearance, join_style="mitre", mitre_limit=100.0)
    if outline.is_empty or not isinstance(outline, shapely.Polygon):
        raise InputError(
            f"a clearance of {clearance:g} m leaves no peg in one piece for {name!r}; make it smaller."
        )
    return extruded(name, outline, -length, 0.0)

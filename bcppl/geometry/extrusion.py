"""Outlines drawn out to solids, exactly: a mesh to be seen and located on, convex prisms to be touched."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import shapely
import trimesh

from bcppl.errors import InputError
from bcppl.geometry.cover import Cell, convex_cells, straightened
from bcppl.geometry.parts import LARGEST_EXTENT, Part, Piece

Array = npt.NDArray[np.float64]

REACH = 0.002  # m by which prisms overlap, at most
_TOUCHING = 1e-9  # m: a wall thinner than this is none in MuJoCo's single precision
RAMP = 0.0001  # m below the end faces at which they overlap so far; more than a contact sinks in


def extruded(
    name: str, outline: shapely.Polygon, bottom: float, top: float, source: str = "drawn by bcppl"
) -> Part:
    """A part drawn out along z from an outline in its x-y plane, exact but for rounding.

    Its pieces are convex prisms whose union is the solid within 1e-9 m. Along the outline's own sides they
    overlap by up to 2 mm, so that no wall has a seam. On the end faces they meet; there each prism goes on
    into its neighbours as a ramp that falls 0.1 mm below the face, so that what slides across is not caught.

    Args:
        name: the part's name.
        outline: in metres, with or without holes.
        bottom: z of the lower face, metres.
        top: z of the upper face, metres.
        source: attribution and licence.

    Raises:
        InputError: the outline is empty, crosses itself, is in several pieces, or is probably in millimetres;
            or the top is not above the bottom.
    """
    check_outline(outline, name)
    if not (np.isfinite([bottom, top]).all() and top > bottom):
        raise InputError(
            f"part {name!r} would reach from z = {bottom:g} to {top:g} m; give a top above its bottom."
        )
    mesh = trimesh.creation.extrude_polygon(shapely.normalize(outline), top - bottom)
    vertices = np.asarray(mesh.vertices, dtype=np.float64) + np.array([0.0, 0.0, bottom])
    pieces = prisms(outline, bottom, top)
    part = Part(name, vertices, np.asarray(mesh.faces, dtype=np.int64), pieces, source)
    part.check()
    return part


def check_outline(outline: shapely.Polygon, name: str) -> None:
    """Refuse an outline that cannot be drawn out.

    Raises:
        InputError: it is empty, crosses itself, has a hole that touches its border or another hole, is in
            several pieces, or is probably in millimetres.
    """
    if not isinstance(outline, shapely.Polygon):
        kind = getattr(outline, "geom_type", type(outline).__name__)
        raise InputError(
            f"the outline of {name!r} is a {kind}; give one shapely.Polygon, a part for each piece."
        )
    if outline.is_empty or not np.isfinite(shapely.get_coordinates(outline)).all():
        raise InputError(
            f"the outline of {name!r} is empty or has a corner that is not finite; give three or more."
        )
    if not outline.is_valid:
        raise InputError(
            f"the outline of {name!r} is no simple polygon ({shapely.is_valid_reason(outline)}); "
            "draw sides that do not cross and holes that lie inside."
        )
    border = outline.exterior
    for a, b in itertools.combinations([border, *outline.interiors], 2):
        if shapely.distance(a, b) < _TOUCHING:
            x, y = shapely.get_coordinates(shapely.shortest_line(a, b))[0]
            beside = "its border" if a is border else "another"
            raise InputError(
                f"the outline of {name!r} has a hole that touches {beside} at ({x:.6g}, {y:.6g}) m; move the "
                "hole, or cut the wall open there."
            )
    low, high = np.reshape(outline.bounds, (2, 2))
    if (high - low).max() > LARGEST_EXTENT:
        raise InputError(
            f"the outline of {name!r} is {(high - low).max():.0f} m long: it is probably in millimetres; "
            "scale it by 0.001 to metres."
        )


def prisms(outline: shapely.Polygon, bottom: float, top: float) -> list[Piece]:
    """Convex prisms whose union is an outline drawn out from z = bottom to top; a rectangle is one box."""
    return [prism(cell, bottom, top) for cell in convex_cells(outline, REACH)]


def prism(cell: Cell, bottom: float, top: float) -> Piece:
    """A cell drawn out: its core to the full height, what it has grown by only below its end faces."""
    low, high = cell.core.min(axis=0), cell.core.max(axis=0)
    own = np.prod(high - low)
    if len(cell.core) == len(cell.grown) == 4 and abs(shapely.Polygon(cell.core).area - own) <= 1e-12 * own:
        a, b = np.append(low, bottom), np.append(high, top)
        return Piece("box", 0.5 * (b - a), 0.5 * (a + b))
    ramp = min(RAMP, 0.25 * (top - bottom))
    levels = [(cell.core, bottom), (cell.core, top)]
    if len(cell.grown) != len(cell.core) or not np.allclose(cell.grown, cell.core):
        levels += [(straightened(cell.grown), bottom + ramp), (straightened(cell.grown), top - ramp)]
    return Piece("hull", np.concatenate([np.insert(corners, 2, z, axis=1) for corners, z in levels]))

"""Outlines of holes and pegs: plane polygons by name, checked, and the clearance of one in another."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np
import shapely

from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.parts import LARGEST_EXTENT

SIDES = 64  # of a round outline: at a diameter of 16 mm it deviates from the circle by 5 um either way
_TOUCHING = 1e-9  # m: a wall thinner than this has no thickness in MuJoCo's single precision


def round_outline(diameter: float, sides: int = SIDES) -> shapely.Polygon:
    """A circle as a regular polygon, as far outside the circle at its corners as inside at its sides.

    Either error is radius * tan(pi / (2 * sides))^2: with 64 sides 5 um at a diameter of 16 mm, 48 sides
    9 um, 32 sides 19 um. The diameter is in metres, and a corner lies on the x axis.

    Raises:
        InputError: the diameter is not positive.
    """
    positive("a round outline", diameter=diameter)
    return shapely.Polygon(_arc(diameter, 0.0, 2.0 * math.pi, sides, closed=True))


def rectangular_outline(width: float, breadth: float) -> shapely.Polygon:
    """A rectangle, `width` along x and `breadth` along y, metres, centred at the origin."""
    positive("a rectangular outline", width=width, breadth=breadth)
    return shapely.box(-0.5 * width, -0.5 * breadth, 0.5 * width, 0.5 * breadth)


def hexagonal_outline(across_flats: float) -> shapely.Polygon:
    """A regular hexagon, `across_flats` metres between opposite sides, a corner on the x axis."""
    positive("a hexagonal outline", across_flats=across_flats)
    angles = math.pi / 3.0 * np.arange(6)
    return shapely.Polygon(across_flats / math.sqrt(3.0) * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def d_outline(diameter: float, flat: float) -> shapely.Polygon:
    """A circle with a flat, as of a shaft for a set screw.

    Args:
        diameter: of the circle, metres.
        flat: from the flat, which faces +x, to the opposite side of the circle, metres.

    Raises:
        InputError: the flat does not cut the circle.
    """
    positive("a D-shaped outline", diameter=diameter, flat=flat)
    if flat >= diameter:
        raise InputError(
            f"a flat {flat:g} m from the far side does not cut a circle of {diameter:g} m; reduce it."
        )
    half = math.acos(2.0 * flat / diameter - 1.0)
    return shapely.Polygon(_arc(diameter, half, 2.0 * math.pi - half, SIDES))


def keyed_outline(diameter: float, key_width: float, key_height: float) -> shapely.Polygon:
    """A circle with a key towards +x: a keyway in a hole, a feather on a peg.

    Args:
        diameter: of the circle, metres.
        key_width: along y, metres.
        key_height: from the circle's farthest point along x to the key's top, metres.

    Raises:
        InputError: the key is as wide as the circle or wider.
    """
    positive("a keyed outline", diameter=diameter, key_width=key_width, key_height=key_height)
    if key_width >= diameter:
        raise InputError(
            f"the key is {key_width:g} m wide on a circle of {diameter:g} m; make it narrower than that."
        )
    half = math.asin(key_width / diameter)
    top, side = 0.5 * diameter + key_height, 0.5 * key_width
    arc = _arc(diameter, half, 2.0 * math.pi - half, SIDES)
    return shapely.Polygon(np.concatenate([arc, [[top, -side], [top, side]]]))


# Outlines of one size: the diameter or the distance across flats, metres.
NAMED: Mapping[str, Callable[[float], shapely.Polygon]] = {
    "round": round_outline,
    "square": lambda size: rectangular_outline(size, size),
    "rectangle": lambda size: rectangular_outline(size, 0.625 * size),
    "hexagon": hexagonal_outline,
    "D": lambda size: d_outline(size, 0.875 * size),
    "keyway": lambda size: keyed_outline(size, 0.3125 * size, 0.1875 * size),
}


def named_outline(name: str, size: float = 0.016) -> shapely.Polygon:
    """The outline of a name in `NAMED`: round, square, rectangle, hexagon, D or keyway.

    At a size of 16 mm a rectangle is 10 mm broad, a D is 14 mm to its flat, a key is 5 mm wide and 3 mm high.

    Raises:
        InputError: there is no such name.
    """
    if name not in NAMED:
        raise InputError(f"there is no outline {name!r}; the outlines are {', '.join(NAMED)}.")
    return NAMED[name](size)


def check_outline(outline: shapely.Polygon, name: str) -> None:
    """Refuse an outline that cannot be extruded.

    Raises:
        InputError: it is empty, crosses itself, has a hole that touches its border or another hole, is in
            several pieces, or is probably in millimetres.
    """
    if not isinstance(outline, shapely.Polygon):
        kind = getattr(outline, "geom_type", type(outline).__name__)
        raise InputError(
            f"the outline of {name!r} is a {kind}; give one shapely.Polygon, a part for each piece."
        )
    if outline.is_empty or not outline.is_valid:
        raise InputError(
            f"the outline of {name!r} is empty or no simple polygon ({shapely.is_valid_reason(outline)}); "
            "draw sides that do not cross and holes that lie inside."
        )
    border = outline.exterior
    for a, b in itertools.combinations([border, *outline.interiors], 2):
        if shapely.distance(a, b) < _TOUCHING:
            x, y = shapely.get_coordinates(shapely.shortest_line(a, b))[0]
            beside = "its border" if a is border else "another"
            raise InputError(
                f"the outline of {name!r} has a hole that touches {beside} at ({x:.6g}, {y:.6g}) m; move it."
            )
    low, high = np.reshape(outline.bounds, (2, 2))
    if (high - low).max() > LARGEST_EXTENT:
        raise InputError(
            f"outline {name!r} is {(high - low).max():.0f} m long, probably in millimetres: rescale it."
        )


def check_fit(hole: shapely.Polygon, peg: shapely.Polygon) -> float:
    """The clearance (m) of a peg's outline in a hole's, both in one frame: twice their minimum distance.

    Raises:
        InputError: the peg does not fit, or an outline is not valid.
    """
    check_outline(hole, "hole")
    check_outline(peg, "peg")
    if not hole.contains_properly(peg):
        beyond = shapely.difference(peg, hole)
        spacing = max(0.002 * beyond.length, 1e-6)
        points = shapely.points(shapely.get_coordinates(shapely.segmentize(beyond, spacing)))
        excess = float(shapely.distance(points, hole).max(initial=0.0))
        if excess < 1e-9:
            raise InputError("the peg's outline touches the hole's, so it has no clearance; make it smaller.")
        raise InputError(
            f"the peg's outline protrudes by up to {1000 * excess:.3g} mm from the hole's; make it smaller."
        )
    return 2.0 * float(shapely.distance(peg, hole.boundary))


def positive(what: str, **lengths: float) -> None:
    """Refuse lengths that are not positive, by the names they are given under."""
    for name, value in lengths.items():
        number_within(f"{what} has {name.replace('_', ' ')} {{}} m", value, above=0.0)


def _arc(diameter: float, start: float, stop: float, sides: int, closed: bool = False) -> Array:
    """Points on an arc whose chords are as far inside the circle as their corners are outside; ends on it."""
    count = max(1, math.ceil(sides * (stop - start) / (2.0 * math.pi) - 1e-9))
    angles = start + (stop - start) / count * np.arange(count + (not closed))
    half = (stop - start) / (2 * count)
    radius = np.full(len(angles), diameter / (1.0 + math.cos(half)))
    if not closed:  # a flat or a key begins where the circle itself does
        radius[[0, -1]] = 0.5 * diameter
    return np.asarray(radius[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1))

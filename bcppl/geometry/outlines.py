"""Outlines of holes by name, blocks with such a hole, and the pegs that go in with a stated clearance."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import shapely
from shapely.affinity import rotate, translate

from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.geometry.extrusion import check_outline, extruded
from bcppl.geometry.parts import Part, Piece

SIDES = 64  # of a round outline: at a diameter of 16 mm it is off the circle by 5 um either way


def round_outline(diameter: float, sides: int = SIDES) -> shapely.Polygon:
    """A circle as a regular polygon, as much outside the circle at its corners as inside at its sides.

    Either error is radius * tan(pi / (2 * sides))^2: with 64 sides 5 um at a diameter of 16 mm, 48 sides
    9 um, 32 sides 19 um. A corner lies on the x axis.

    Args:
        diameter: metres.
        sides: of the polygon.

    Raises:
        InputError: the diameter is not positive or there are fewer than three sides.
    """
    _positive("a round outline", diameter=diameter)
    if sides < 3:
        raise InputError(f"a round outline has {sides} sides; give at least three.")
    return shapely.Polygon(_arc(diameter, 0.0, 2.0 * math.pi, sides, closed=True))


def roundness_error(diameter: float, sides: int = SIDES) -> float:
    """How far `round_outline` is from its circle, either way, metres."""
    return 0.5 * diameter * math.tan(math.pi / (2 * sides)) ** 2


def rectangular_outline(width: float, breadth: float) -> shapely.Polygon:
    """A rectangle, `width` along x and `breadth` along y, metres, centred at the origin."""
    _positive("a rectangular outline", width=width, breadth=breadth)
    return shapely.box(-0.5 * width, -0.5 * breadth, 0.5 * width, 0.5 * breadth)


def hexagonal_outline(across_flats: float) -> shapely.Polygon:
    """A regular hexagon, `across_flats` metres from side to side, a corner on the x axis."""
    _positive("a hexagonal outline", across_flats=across_flats)
    angles = math.pi / 3.0 * np.arange(6)
    return shapely.Polygon(across_flats / math.sqrt(3.0) * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def d_outline(diameter: float, flat: float, sides: int = SIDES) -> shapely.Polygon:
    """A circle with a flat, as of a shaft for a set screw.

    Args:
        diameter: of the circle, metres.
        flat: from the flat, which faces +x, to the far side of the circle, metres.
        sides: of the polygon that a full circle would be.

    Raises:
        InputError: the flat does not cut the circle.
    """
    _positive("a D-shaped outline", diameter=diameter, flat=flat)
    if flat >= diameter:
        raise InputError(
            f"the flat of a D-shaped outline is {flat:g} m from the far side of a circle of {diameter:g} m; "
            "make it less than the diameter."
        )
    half = math.acos(2.0 * flat / diameter - 1.0)
    return shapely.Polygon(_arc(diameter, half, 2.0 * math.pi - half, sides))


def keyed_outline(
    diameter: float, key_width: float, key_height: float, sides: int = SIDES
) -> shapely.Polygon:
    """A circle with a key that stands out of it towards +x: a keyway in a hole, a feather on a peg.

    Args:
        diameter: of the circle, metres.
        key_width: along y, metres.
        key_height: from the circle's farthest point along x to the key's top, metres.
        sides: of the polygon that a full circle would be.

    Raises:
        InputError: the key is as wide as the circle or wider.
    """
    _positive("a keyed outline", diameter=diameter, key_width=key_width, key_height=key_height)
    if key_width >= diameter:
        raise InputError(
            f"the key is {key_width:g} m wide on a circle of {diameter:g} m; make it narrower than that."
        )
    half = math.asin(key_width / diameter)
    top, side = 0.5 * diameter + key_height, 0.5 * key_width
    arc = _arc(diameter, half, 2.0 * math.pi - half, sides)
    return shapely.Polygon(np.concatenate([arc, [[top, -side], [top, side]]]))


# Outlines of one size, metres: what it measures across.
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

    A rectangle is 10 mm broad for 16 mm of size, a D is 14 mm to its flat, a key is 5 mm wide and 3 mm high.

    Raises:
        InputError: there is no such name.
    """
    if name not in NAMED:
        raise InputError(f"there is no outline {name!r}; the outlines are {', '.join(NAMED)}.")
    return NAMED[name](size)


def block_with_hole(
    hole: shapely.Polygon,
    size: tuple[float, float, float] = (0.06, 0.06, 0.025),
    offset: tuple[float, float] = (0.0, 0.0),
    turn: float = 0.0,
    name: str = "block with a hole",
) -> Part:
    """A rectangular block with a hole of any outline through it.

    The part's frame is that of `shapes.block_with_square_hole`: origin at the centre of the outer block's top
    face, x and y along its sides, z up, out of the material.

    Args:
        hole: the hole's outline in its own frame, metres, without holes of its own.
        size: outer side lengths along x, y and z, metres.
        offset: where the origin of the hole's outline lies in the part's frame, metres.
        turn: of the hole about z, radians.
        name: the part's name.

    Raises:
        InputError: the outline is not valid, a number is not finite, or the hole does not lie inside the
            block.
    """
    _positive(name, size_x=size[0], size_y=size[1], size_z=size[2])
    check_outline(hole, f"hole of {name}")
    number_within(f"the hole of {name!r} has turn {{}}", turn)
    if len(offset) != 2:
        raise InputError(f"the hole of {name!r} has offset {offset!r}; give its x and y in metres.")
    for axis, value in zip("xy", offset, strict=True):
        number_within(f"the hole of {name!r} has offset {{}} along {axis}", value)
    placed = translate(rotate(hole, turn, origin=(0.0, 0.0), use_radians=True), *offset)
    outer = rectangular_outline(size[0], size[1])
    if not outer.contains_properly(placed):
        low, high = np.reshape(placed.bounds, (2, 2))
        raise InputError(
            f"the hole of {name!r} spans {low.tolist()} to {high.tolist()} m and does not lie inside a block "
            f"of {size[0]:g} m by {size[1]:g} m; make it smaller or move it."
        )
    return extruded(name, shapely.Polygon(outer.exterior, [placed.exterior]), -size[2], 0.0)


def peg_for(hole: shapely.Polygon, clearance: float, length: float, name: str = "peg") -> Part:
    """The peg that goes into a hole with a stated clearance: half of it to each side.

    The peg's frame is that of `shapes.box_peg`: origin at the wrench sensor, above the origin of the hole's
    outline once the peg is in, its axes parallel to the outline's; the tip is at z = -length.

    Args:
        hole: the hole's outline, metres.
        clearance: of the diameter, or of opposite flats, metres.
        length: from the sensor to the tip, metres.
        name: the part's name.

    Raises:
        InputError: the outline is not valid, the clearance is not positive, or it leaves no peg in one piece.
    """
    check_outline(hole, f"hole for {name}")
    _positive(name, clearance=clearance, length=length)
    outline = hole.buffer(-0.5 * clearance, join_style="mitre", mitre_limit=100.0)
    if outline.is_empty or not isinstance(outline, shapely.Polygon):
        raise InputError(
            f"a clearance of {clearance:g} m leaves no peg in one piece for {name!r}; make it smaller."
        )
    return extruded(name, outline, -length, 0.0)


def check_fit(hole: shapely.Polygon, peg: shapely.Polygon) -> float:
    """The clearance (m) that a peg's outline has in a hole's, both in one frame: twice the narrowest gap.

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
            f"the peg's outline stands up to {1000 * excess:.3g} mm out of the hole's; make it smaller."
        )
    return 2.0 * float(shapely.distance(peg, hole.boundary))


def cylinder_peg(diameter: float, length: float, name: str = "cylindrical peg") -> Part:
    """A round peg that is touched as an exact cylinder; its frame is that of `shapes.box_peg`.

    Pressed flat on a plane its centre of pressure is less exact than a prism's, `shapes.round_peg`.

    Args:
        diameter: metres.
        length: from the sensor to the tip, metres.
        name: the part's name.
    """
    drawn = extruded(name, round_outline(diameter), -length, 0.0)
    piece = Piece("cylinder", np.array([0.5 * diameter, 0.5 * length]), np.array([0.0, 0.0, -0.5 * length]))
    return Part(name, drawn.vertices, drawn.faces, [piece], drawn.source)


def _arc(
    diameter: float, start: float, stop: float, sides: int, closed: bool = False
) -> npt.NDArray[np.float64]:
    """Points on an arc whose chords are as far inside the circle as their corners are outside; ends on it."""
    count = max(1, math.ceil(sides * (stop - start) / (2.0 * math.pi) - 1e-9))
    angles = start + (stop - start) / count * np.arange(count + (not closed))
    half = (stop - start) / (2 * count)
    radius = np.full(len(angles), diameter / (1.0 + math.cos(half)))
    if not closed:  # a flat or a key begins where the circle itself does
        radius[[0, -1]] = 0.5 * diameter
    return np.asarray(radius[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def _positive(what: str, **lengths: float) -> None:
    for name, value in lengths.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{what} has {name.replace('_', ' ')} {value!r}; give metres greater than 0.")

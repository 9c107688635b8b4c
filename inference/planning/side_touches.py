"""Touches of two of a part's sides, and the way from one to the other, for a plan of 3-2-1 touches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely

from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.inference.planning.faces import Side, section
from bcppl.inference.planning.metrology_parameters import MetrologyParameters
from bcppl.inference.planning.waypoints import UP, Waypoint, half_stroke

_AWAY = 0.002  # m from the part on the way around it
_DEPTHS = (1.0, 0.5, 0.25)  # shares of the depth at which sides are touched that are tried
_OVERHANG, _SECTIONS = 0.0005, 6  # m by which what is above a side may stand out, and where that is asked
_PARALLEL = 0.95  # cosine of the angle between two sides that determine one direction


class SideTouch(NamedTuple):
    """A guarded stroke onto a side and a slide along it, the tip at a height, in the part's frame: metres.

    `clear` and `stop` (3,) are the ends of a stroke beside the face, `press` (3,) the depth of the press, and
    `inset` is of the ends of a slide from the face's.
    """

    face: Side
    height: float
    clear: Array
    stop: Array
    press: Array
    inset: float
    parameters: MetrologyParameters

    @classmethod
    def of(
        cls, belief: Belief, face: Side, foot: Array, height: float, parameters: MetrologyParameters
    ) -> SideTouch:
        """That of a face, by a peg whose outline is `foot` (K, 2), as long as its place is unsure."""
        normal = np.array([*face.normal, 0.0])
        reach = float((foot @ -face.normal).max())  # of the peg towards the face
        ends = np.array([[*face.start, height], [*face.stop, height]])
        tangent = np.array([-normal[1], normal[0], 0.0])
        inset = min(face.length / 3.0, half_stroke(belief, ends, tangent, parameters))
        inwards = inset * (ends[1] - ends[0]) / max(face.length, 1e-9)
        # The stroke may be at either end, where yaw moves the face further than in its middle.
        stroke = half_stroke(belief, ends + np.array([inwards, -inwards]), normal, parameters)
        return cls(
            face,
            height,
            (reach + stroke) * normal,
            (reach - stroke) * normal,
            parameters.press_depth * normal,
            inset,
            parameters,
        )

    @property
    def middle(self) -> Array:
        """(2,)."""
        return 0.5 * (self.face.start + self.face.stop)

    def slide(self, before: Array, after: Array) -> tuple[Array, Array]:
        """The ends (2,) of a slide, in the order in which the ways from and to other positions are short."""
        along = (self.face.stop - self.face.start) / max(self.face.length, 1e-9)
        a, b = self.face.start + self.inset * along, self.face.stop - self.inset * along
        ahead = np.linalg.norm(a - before) + np.linalg.norm(b - after)
        reverse = np.linalg.norm(b - before) + np.linalg.norm(a - after)
        return (a, b) if ahead <= reverse else (b, a)

    def at(self, position: Array) -> Array:
        """(3,)."""
        return np.array([*position, self.height])

    def slide_to(self, position: Array) -> Waypoint:
        """Of a slide to a position (2,)."""
        return self.parameters.slide(self.at(position) + self.stop - self.press)

    def rocked(self, position: Array) -> list[Waypoint]:
        """Of a pressed peg that leans and turns both ways, at a position (2,)."""
        tangent = np.array([-self.face.normal[1], self.face.normal[0], 0.0])
        here = self.at(position) + self.stop - self.press
        speed = self.parameters.sliding_speed
        leans = [
            angle * axis for angle, axis in ((self.parameters.lean, tangent), (self.parameters.turn, UP))
        ]
        return [
            Waypoint(here, "held", speed, sign * lean) for lean in leans if lean.any() for sign in (1, -1)
        ]

    def touch(self, position: Array) -> list[Waypoint]:
        """Of a touch at a position (2,)."""
        here = self.at(position)
        return self.parameters.touch(here + self.clear, here + self.stop, here + self.stop - self.press)


def side_height(part: Part, top: float, parameters: MetrologyParameters) -> float:
    """The height z at which sides are touched: as deep as nothing above stands out farther."""
    deepest = min(parameters.side_depth, 0.5 * float(part.extent[2]))
    for share in _DEPTHS:
        height = top - share * deepest
        outline = shapely.Polygon(section(part, height).exterior).buffer(_OVERHANG)
        above = (section(part, z) for z in np.linspace(height, top - _OVERHANG, _SECTIONS))
        if all(outline.covers(each) for each in above):
            return height
    raise InputError(
        f"the sides of part {part.name!r} are under an overhang, which the peg would meet first; plan "
        "touches by hand (bcppl.inference.planning.touch)."
    )


def way_around(
    outline: shapely.Polygon,
    start: Array,
    other: SideTouch,
    position: Array,
    radius: float,
    above: float,
) -> list[Waypoint]:
    """Waypoints from beside one side to beside a position of the other, without contact."""
    body = outline.convex_hull.buffer(radius + _AWAY)
    goal = other.at(position) + other.clear
    outward = other.clear / np.linalg.norm(other.clear)
    corner = start + ((goal - start) @ outward) * outward
    for between in ([], [corner]):
        if not body.intersects(shapely.LineString([p[:2] for p in (start, *between, goal)])):
            return [other.parameters.free(p) for p in between]
    return [other.parameters.free(np.array([*p[:2], above])) for p in (start, goal)]


def two_sides(faces: list[Side], near: Array, radius: float) -> tuple[Side, Side]:
    """A long side, the one nearest to the peg, and one that is across it."""
    longest = [face for face in faces if face.length > 0.8 * faces[0].length]

    def away(face: Side) -> float:
        return float(np.linalg.norm(0.5 * (face.start + face.stop) + radius * face.normal - near))

    first = min(longest, key=away)
    across = [face for face in faces if abs(float(face.normal @ first.normal)) < 0.5]
    if across:
        return first, min(across, key=lambda face: (-round(face.length, 3), away(face)))
    second = min(faces, key=lambda face: abs(float(face.normal @ first.normal)))
    if abs(float(second.normal @ first.normal)) > _PARALLEL:
        raise InputError(
            "the part's sides are all parallel, so that touches of two leave it free to move along them; "
            "plan touches by hand (bcppl.inference.planning.touch)."
        )
    return first, second

"""A fixed plan of touches: the 3-2-1 rule of metrology.

Three points on the top determine a part's height and tilt, two on one side its position across and its yaw,
one on the next side the remaining position. A peg that presses and slides touches all points on its path. One
that leans and turns while it presses touches with several of its own points, so it shows how it is held.
"""

from __future__ import annotations

import math
import warnings
from typing import NamedTuple

import numpy as np
import shapely

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.holes import lowest_outline
from bcppl.geometry.parts import Part
from bcppl.inference.planning.faces import Side, TopPoints, points_on_top, section, sides
from bcppl.inference.planning.waypoints import (
    DAMPING,
    STIFFNESS,
    UP,
    Waypoint,
    half_stroke,
    leaning,
    tip_of,
    top_of,
)
from bcppl.robot.plan import Manner, Plan

_ABOVE = 0.06  # m above the top where the plan begins
_AWAY = 0.002  # m from the part on the way around it
_DEPTHS = (1.0, 0.5, 0.25)  # shares of the depth at which sides are touched that are tried
_OVERHANG, _SECTIONS = 0.0005, 6  # m by which what is above a side may stand out, and where that is asked
_PARALLEL = 0.95  # cosine of the angle between two sides that determine one direction
_SURE = 0.95  # a mode with less of the belief's weight is one of several


class MetrologyParameters(NamedTuple):
    """Parameters of the plan.

    Attributes:
        first_contact: when it is expected, seconds.
        duration: of the plan, seconds.
        guarded_speed, free_speed, sliding_speed: m/s; exceeded only as far as the plan would otherwise not
            end in time.
        haste: by which factor they may be. A plan that needs more keeps to them, and lasts longer.
        slowest_slide: m/s; where there is time to spare, slides are slower, down to this.
        contact_force: newtons that stop a guarded motion.
        press_depth: metres of the command beyond the point of contact: an impact may have stopped it.
        side_depth: metres below the top at which sides are touched, where the part is high enough.
        lean, turn: radians by which the pressed peg leans away from a side and towards it, and turns about
            its axis both ways, at the end of each slide along a side; 0 leaves it out.
        standard_deviations: half a stroke, in standard deviations of the surface's position along it.
        shortest_half_stroke, longest_half_stroke: limits of that, metres.
    """

    first_contact: float = 3.0
    duration: float = 6.0
    guarded_speed: float = 0.06
    free_speed: float = 0.25
    sliding_speed: float = 0.09
    haste: float = 1.25
    slowest_slide: float = 0.02
    contact_force: float = 4.0
    press_depth: float = 0.003
    side_depth: float = 0.012
    standard_deviations: float = 3.0
    lean: float = 0.0
    turn: float = 0.0
    shortest_half_stroke: float = 0.003
    longest_half_stroke: float = 0.012

    def free(self, position: Array) -> Waypoint:
        """Of a free motion to a position (3,)."""
        return Waypoint(position, "free", self.free_speed)

    def slide(self, position: Array) -> Waypoint:
        """Of a slide to a position (3,)."""
        return Waypoint(position, "held", self.sliding_speed)

    def touch(self, clear: Array, stop: Array, pressed: Array) -> list[Waypoint]:
        """Of a guarded stroke between two positions (3,), and a press to a third."""
        speed = self.guarded_speed
        return [self.free(clear), Waypoint(stop, "guarded", speed), Waypoint(pressed, "held", speed)]


# Where the peg's pose in the hand is uncertain. The time for it is that before the first contact.
ROCKED = MetrologyParameters(first_contact=1.5, lean=math.radians(4.0), turn=math.radians(8.0))


def _checked(parameters: MetrologyParameters) -> MetrologyParameters:
    for name, value in parameters._asdict().items():
        if name in ("lean", "turn"):
            number_within(f"a plan of 3-2-1 touches has {name} {{}} radians", value, least=0.0)
        else:
            number_within(f"a plan of 3-2-1 touches has {name} {{}}", value, above=0.0)
    return parameters


def three_two_one(
    belief: Belief, part: Part, peg: Part, parameters: MetrologyParameters | None = None
) -> Plan:
    """Three touches on the part's top, two on one side and two on the next, joined by slides.

    The plan is for the belief's mean, and the peg keeps the part's orientation there, unless `parameters` (as
    `ROCKED`) let it lean and turn. Strokes towards a face are as long as the face's position is uncertain.

    Args:
        belief: over world_from_part.
        part: its z axis points out of its top.
        peg: the held peg, its frame where it is held and its tip at its lowest z.
        parameters: of the plan.

    Raises:
        InputError: the part's top has no room for the peg, its sides are under an overhang or all parallel,
            the belief has the part upside down, or a parameter is out of range.

    Warns:
        RuntimeWarning: the belief has several modes, or is wider than the longest stroke.
    """
    chosen = _checked(MetrologyParameters() if parameters is None else parameters)
    _refuse_upside_down(belief)
    _warn_of_modes(belief)
    top = top_of(part)
    height = _side_height(part, top, chosen)
    unsure = half_stroke(belief, np.array([0.0, 0.0, top]), UP, chosen)
    foot = shapely.get_coordinates(lowest_outline(peg, top - height + unsure))
    radius = float(np.linalg.norm(foot, axis=1).max())
    lateral = max(half_stroke(belief, np.array([0.0, 0.0, top]), axis, chosen) for axis in np.eye(3)[:2])
    points = points_on_top(part, peg, lateral)
    last = points.positions[2]
    first, second = _two_sides(sides(part, height), last, radius)
    one = _SideTouch.of(belief, first, foot, height, chosen)
    other = _SideTouch.of(belief, second, foot, height, chosen)
    begin, end = one.slide(last, other.middle)
    here, there = other.slide(end, end)
    above = top + half_stroke(belief, np.array([*begin, top]), UP, chosen)
    corner = one.at(end) + one.clear
    waypoints = [
        *_on_top(belief, points, top, chosen),
        chosen.free(np.array([*begin, above]) + one.clear),
        *one.touch(begin),
        one.slide_to(end),
        *one.rocked(end),
        chosen.free(corner),
        *_around(section(part, height), corner, other, here, radius, above),
        *other.touch(here),
        other.slide_to(there),
        *other.rocked(there),
    ]
    return _timed(belief, waypoints, peg, chosen)


class _SideTouch(NamedTuple):
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
    ) -> _SideTouch:
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


def _refuse_upside_down(belief: Belief) -> None:
    if not float(poses.rotation_matrix(belief.mean)[2, 2]) > 0.0:
        raise InputError(
            "the part's top faces down at the belief's mean, so that a peg would come from below; check the "
            "guess, or turn the part's mesh until its z axis points out of its top."
        )


def _warn_of_modes(belief: Belief) -> None:
    modes = belief.modes()
    if modes[0].mass < _SURE:
        warnings.warn(
            f"the belief has several modes, the heaviest with {100.0 * modes[0].mass:.0f} % of its weight, "
            "and touches are planned for their mean; look once more, or plan for one "
            "(belief.modes()[0].belief).",
            RuntimeWarning,
            stacklevel=3,
        )


def _side_height(part: Part, top: float, parameters: MetrologyParameters) -> float:
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


def _around(
    outline: shapely.Polygon,
    start: Array,
    other: _SideTouch,
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


def _two_sides(faces: list[Side], near: Array, radius: float) -> tuple[Side, Side]:
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


def _on_top(belief: Belief, points: TopPoints, top: float, parameters: MetrologyParameters) -> list[Waypoint]:
    a, b, c = (np.array([*point, top]) for point in points.positions)
    up = half_stroke(belief, np.stack([a, b, c]), UP, parameters) * UP
    on = -up - parameters.press_depth * UP

    def touch(point: Array) -> list[Waypoint]:
        return parameters.touch(point + up, point - up, point + on)

    free, slide = parameters.free, parameters.slide
    to_last = [free(b + up), *touch(c)] if points.lifted else [slide(c + on)]
    return [free(a + _ABOVE * UP), *touch(a), slide(b + on), *to_last, free(c + up)]


def _timed(belief: Belief, waypoints: list[Waypoint], peg: Part, parameters: MetrologyParameters) -> Plan:
    """The plan through waypoints in the part's frame, faster where it would otherwise not end in time.

    Around a large part haste is not enough: such a plan is slower, and longer.
    """
    positions = np.stack([waypoint.position for waypoint in waypoints])
    kinds = np.array([waypoint.manner for waypoint in waypoints[1:]])
    guarded = kinds == "guarded"
    leans = np.stack([waypoint.lean for waypoint in waypoints])
    # A peg that leans about its tip moves its other end.
    swept = float(np.ptp(peg.vertices[:, 2])) * np.linalg.norm(np.diff(leans, axis=0), axis=1)
    lengths = np.maximum(np.linalg.norm(np.diff(positions, axis=0), axis=1), swept)
    spans = np.maximum(lengths / np.array([waypoint.speed for waypoint in waypoints[1:]]), 0.04)
    first = int(guarded.argmax())
    # Half of the first stroke is over at the first contact; the rest of the plan must fit in the time left.
    after = np.concatenate([[0.5 * spans[first]], spans[first + 1 :]])
    duration = parameters.duration
    left = duration - parameters.first_contact
    if after.sum() > left:
        strokes = guarded[first:]
        slow = after[strokes].sum()
        if slow < 0.6 * left:  # guarded strokes keep their speed where that leaves enough for the rest
            shrink = np.where(strokes, 1.0, (left - slow) / after[~strokes].sum())
        else:
            shrink = np.full(len(after), left / after.sum())
        if parameters.haste * shrink.min() >= 1.0:
            spans[first:] *= shrink
        else:
            duration = parameters.first_contact + after.sum()
    begin = parameters.first_contact - spans[:first].sum() - 0.5 * spans[first]
    if not begin > 0.0:
        raise InputError(
            f"the first contact is planned at first_contact = {parameters.first_contact:g} s, and the way "
            f"there takes {parameters.first_contact - begin:.2g} s; give more time, or a higher free_speed."
        )
    spare = duration - (begin + spans.sum())
    slides = (kinds == "held") & (lengths > 1.01 * parameters.press_depth)
    if spare > 0.0 and slides.any():  # slower slides are more informative
        slower = np.minimum(spans * (1.0 + spare / spans[slides].sum()), lengths / parameters.slowest_slide)
        spans = np.where(slides, np.maximum(spans, slower), spans)
    times = np.concatenate([[0.0], begin + np.concatenate([[0.0], np.cumsum(spans)])])
    path = leaning(belief, [waypoints[0], *waypoints], tip_of(peg))
    manners: tuple[Manner, ...] = ("free", *(waypoint.manner for waypoint in waypoints[1:]))
    if times[-1] < duration - 1e-6:
        times = np.append(times, duration)
        path, manners = np.concatenate([path, path[-1:]]), (*manners, "held")
    return Plan(
        "3-2-1",
        times,
        path,
        manners,
        parameters.contact_force,
        np.array(STIFFNESS),
        np.array(DAMPING),
    )

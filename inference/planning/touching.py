"""Plans of touches and slides: the peg makes contact with a point of the surface, presses, and retracts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
import trimesh

from bcppl import poses
from bcppl.arguments import number_within, seed_number, whole_number
from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.inference.planning.waypoints import (
    DAMPING,
    NO_LEAN,
    STIFFNESS,
    UP,
    Waypoint,
    half_stroke,
    tip_of,
    top_of,
    turned,
)
from bcppl.robot.plan import Plan


class TouchParameters(NamedTuple):
    """Parameters of touches and slides: metres, m/s, seconds, newtons.

    Attributes:
        safe_height: of the tip above the part's top where a plan begins and ends, beyond the uncertainty.
        side_depth: below the top at which sides are touched at least, beyond the uncertainty.
        free_speed, guarded_speed, sliding_speed: at most.
        contact_force: that stops the guarded stroke.
        press_depth: of the command beyond the point of contact.
        dwell: for which the press is held.
        slide_length: of a slide.
        standard_deviations: half a stroke, in standard deviations of the surface's position along it.
        shortest_half_stroke, longest_half_stroke: limits of that.
        stiffness, damping: of the arm.
    """

    safe_height: float = 0.02
    side_depth: float = 0.004
    free_speed: float = 0.2
    guarded_speed: float = 0.04
    sliding_speed: float = 0.06
    contact_force: float = 4.0
    press_depth: float = 0.0015
    dwell: float = 0.25
    slide_length: float = 0.025
    standard_deviations: float = 3.0
    shortest_half_stroke: float = 0.003
    longest_half_stroke: float = 0.014
    stiffness: tuple[float, ...] = STIFFNESS
    damping: tuple[float, ...] = DAMPING


class SurfacePoint(NamedTuple):
    """A point (3,) of a part's surface, in its frame, metres, and its outward unit normal (3,)."""

    position: Array
    normal: Array


# The largest lengths and speeds, m and m/s: beyond, they are in millimetres.
_LARGEST = {"safe_height": 1.0, "side_depth": 0.5, "press_depth": 0.05, "slide_length": 1.0}
_LARGEST |= {"shortest_half_stroke": 0.5, "longest_half_stroke": 0.5}
_LARGEST |= {"free_speed": 5.0, "guarded_speed": 1.0, "sliding_speed": 1.0}
_MOST = 1_000_000  # points
_REST = 0.15  # s before any motion, for the tare
_QUICKEST = 0.05  # s that a motion takes at least
_ALIKE = 2e-5  # m: vertices of a peg within it are equally far
UPRIGHT = 0.5  # a normal with a smaller z is a side's
_OVER = 0.006  # m above the part, beyond the uncertainty, between two touches
_NEAR_TIP = 0.25  # of a peg's length: a side is met by a point within it of the tip
_SHORTER = 0.6  # of the dwell, for each of two touches


def surface_points(part: Part, count: int, seed: int = 0) -> list[SurfacePoint]:
    """Points drawn evenly by area over a part's surface, inner walls and bottom included."""
    count = whole_number("{} points of a surface were asked for", count, most=_MOST)
    seed = seed_number(seed)
    part.check(closed=False)
    points, faces = trimesh.sample.sample_surface(part.mesh, count, seed=np.random.default_rng(seed))
    normals = part.mesh.face_normals[faces]
    return [SurfacePoint(np.asarray(p), np.asarray(n)) for p, n in zip(points, normals, strict=True)]


def face_name(normal: Array) -> str:
    """The name of a surface by the direction of its outward normal (3,) in the part's frame."""
    if normal[2] > 1.0 - 1e-3:
        return "top"
    if normal[2] < -UPRIGHT:
        return "bottom"
    heading = math.degrees(math.atan2(normal[1], normal[0])) % 360.0
    kind = "side" if abs(normal[2]) < UPRIGHT else "slope"
    return f"{kind} at {round(heading) % 360}°"


def leading_point(peg: Part, direction: Array) -> Array:
    """The point (3,) of a peg that is farthest along a direction (3,), in its frame, metres.

    Of an edge or a face, the middle of its lowest end: the tip's.
    """
    along = peg.vertices @ direction
    foremost = peg.vertices[along > along.max() - _ALIKE]
    lowest = foremost[foremost[:, 2] < foremost[:, 2].min() + _ALIKE]
    return np.asarray(0.5 * (lowest.min(axis=0) + lowest.max(axis=0)))


def touch(
    belief: Belief,
    part: Part,
    peg: Part,
    point: SurfacePoint,
    parameters: TouchParameters | None = None,
    name: str = "touch",
    lean: Array = NO_LEAN,
) -> Plan:
    """A touch along the inward normal of a point: approach from above, guarded stroke, press, retreat.

    The plan is for the belief's mean, and the peg keeps the part's orientation there, unless it leans. The
    stroke is as long as the surface's position is uncertain, its middle at the mean. A side is touched far
    enough below the top that the tip meets it in spite of the uncertainty.

    Args:
        belief: over world_from_part.
        part: its z axis points out of its top.
        peg: the held peg, its frame where it is held and its tip at its lowest z.
        point: of contact.
        parameters: of the touch.
        name: of the plan.
        lean: (3,) rotation vector by which the peg is turned from the part's axes, in the part's frame, rad;
            at a side away from it, for the tip is to meet it.

    Raises:
        InputError: a parameter is out of range, or the peg leans towards a side.
    """
    return slide(belief, part, peg, point, np.zeros(3), parameters, name, lean)


def slide(
    belief: Belief,
    part: Part,
    peg: Part,
    point: SurfacePoint,
    displacement: Array,
    parameters: TouchParameters | None = None,
    name: str = "slide",
    lean: Array = NO_LEAN,
) -> Plan:
    """A touch after which the peg slides along the surface, pressed on, before it retracts.

    The slide begins at the point; its displacement (3,) is along the surface, in the part's frame, metres.
    The other arguments are those of `touch`.

    Raises:
        InputError: a parameter is out of range, the normal is not of unit length, the displacement leaves the
            surface, or the peg leans towards a side.
    """
    chosen = _checked(parameters)
    point = _checked_point(point)
    lean = np.asarray(lean, dtype=np.float64)
    displacement = _refuse_off_surface(point, displacement)
    stroke = _Stroke.of(belief, part, _turned(peg, lean, point), point, chosen)
    sliding: list[Waypoint] = []
    if np.linalg.norm(displacement) > 0.0:
        sliding.append(Waypoint(stroke.pressed + displacement, "held", chosen.sliding_speed))
    waypoints = [
        *stroke.down(chosen),
        *sliding,
        Waypoint(stroke.clear + displacement, "free", chosen.free_speed),
        Waypoint(stroke.above + displacement, "free", chosen.free_speed),
    ]
    return _plan(belief, name, stroke.above, waypoints, chosen, lean)


def pair(
    belief: Belief,
    part: Part,
    peg: Part,
    first: SurfacePoint,
    second: SurfacePoint,
    parameters: TouchParameters | None = None,
    name: str = "pair",
) -> Plan:
    """Two touches in one plan; between them the peg is lifted over the part: see `touch`.

    Raises:
        InputError: a parameter is out of range.
    """
    chosen = _checked(parameters)
    chosen = chosen._replace(dwell=_SHORTER * chosen.dwell)
    points = _checked_point(first), _checked_point(second)
    one, other = (_Stroke.of(belief, part, peg, point, chosen) for point in points)
    over = min(one.above[2], other.above[2]) - chosen.safe_height + _OVER
    between = [
        one.clear,
        np.array([*one.clear[:2], max(one.clear[2], over)]),
        np.array([*other.clear[:2], max(other.clear[2], over)]),
    ]
    waypoints = [
        *one.down(chosen),
        *(Waypoint(position, "free", chosen.free_speed) for position in between),
        *other.down(chosen),
        *(Waypoint(position, "free", chosen.free_speed) for position in (other.clear, other.above)),
    ]
    return _plan(belief, name, one.above, waypoints, chosen)


class _Stroke(NamedTuple):
    """A guarded stroke onto a point: positions (3,) of the peg's origin, in the part's frame.

    It begins and ends `above` the part, leads from `clear` to `stop`, and its command ends at `pressed`.
    """

    above: Array
    clear: Array
    stop: Array
    pressed: Array

    @classmethod
    def of(
        cls, belief: Belief, part: Part, peg: Part, point: SurfacePoint, parameters: TouchParameters
    ) -> _Stroke:
        normal, contact = point.normal, _contact(belief, part, peg, point, parameters)
        half = half_stroke(belief, point.position, normal, parameters)
        top = top_of(part)
        lift = half_stroke(belief, np.array([0.0, 0.0, top]), UP, parameters) + parameters.safe_height
        clear = contact + half * normal
        return cls(
            np.array([*clear[:2], max(clear[2], top + lift - tip_of(peg))]),
            clear,
            contact - half * normal,
            contact - (half + parameters.press_depth) * normal,
        )

    def down(self, parameters: TouchParameters) -> list[Waypoint]:
        """To the surface, a press, and the dwell."""
        return [
            Waypoint(self.clear, "free", parameters.free_speed),
            Waypoint(self.stop, "guarded", parameters.guarded_speed),
            Waypoint(self.pressed, "held", parameters.guarded_speed),
            Waypoint(self.pressed, "held", parameters.guarded_speed),
        ]


def _turned(peg: Part, lean: Array, point: SurfacePoint) -> Part:
    """The peg in a frame with the part's axes; refuses one whose upper end would meet a side."""
    if not lean.any():
        return peg
    axes = poses.retract(poses.identity(), torch.from_numpy(np.concatenate([np.zeros(3), lean])))
    turned = peg.moved(axes)
    above = float(leading_point(turned, -point.normal)[2]) - tip_of(turned)
    if abs(point.normal[2]) < UPRIGHT and above > _NEAR_TIP * float(np.ptp(turned.vertices[:, 2])):
        raise InputError(
            f"a peg that leans towards the {face_name(point.normal)} would meet it {1e3 * above:.0f} mm "
            "above its tip, which would hang as far below the point; let it lean away."
        )
    return turned


def _checked(parameters: TouchParameters | None) -> TouchParameters:
    checked = TouchParameters() if parameters is None else parameters
    for name, value in checked._asdict().items():
        if name not in ("stiffness", "damping"):  # which the plan checks
            most = _LARGEST.get(name, math.inf)
            number_within(f"a touch has {name} {{}}", value, above=0.0, most=most)
    return checked


def _checked_point(point: SurfacePoint) -> SurfacePoint:
    position, normal = (np.asarray(each, dtype=np.float64) for each in point)
    if not abs(float(np.linalg.norm(normal)) - 1.0) < 1e-3:
        raise InputError(
            f"the normal of a touch is {normal.tolist()}; give a unit vector out of the surface."
        )
    return SurfacePoint(position, normal)


def _refuse_off_surface(point: SurfacePoint, displacement: Array) -> Array:
    """The displacement (3,) of a slide that begins at a point, which is along the surface there."""
    normal, along = point.normal, np.asarray(displacement, dtype=np.float64)
    if not (np.isfinite(along).all() and abs(float(along @ normal)) <= 0.05 * np.linalg.norm(along)):
        raise InputError(
            f"a slide by {along.tolist()} m leaves the surface, whose normal is {normal.round(3).tolist()}; "
            "give a displacement across that."
        )
    return along


def _contact(
    belief: Belief, part: Part, peg: Part, point: SurfacePoint, parameters: TouchParameters
) -> Array:
    """The peg's origin (3,) in contact with a point, in the part's frame."""
    position = point.position.copy()
    if abs(point.normal[2]) < UPRIGHT:
        top, bottom = top_of(part), float(part.vertices[:, 2].min())
        uncertainty = half_stroke(belief, np.array([0.0, 0.0, top]), UP, parameters)
        highest = max(top - uncertainty - parameters.side_depth, 0.5 * (top + bottom))
        lower = max(position[2] - highest, 0.0)
        uphill = UP - point.normal[2] * point.normal  # along the face, which may slope
        position -= lower / uphill[2] * uphill
    return position - leading_point(peg, -point.normal)


def _plan(
    belief: Belief,
    name: str,
    start: Array,
    waypoints: Sequence[Waypoint],
    parameters: TouchParameters,
    lean: Array = NO_LEAN,
) -> Plan:
    """The plan of a peg whose origin moves from a position through waypoints, turned from the part's axes."""
    positions = np.stack([start, start, *(waypoint.position for waypoint in waypoints)])
    lengths = np.linalg.norm(np.diff(positions[1:], axis=0), axis=1)
    spans = [_REST]
    for length, waypoint in zip(lengths, waypoints, strict=True):
        rests = length == 0.0 and waypoint.manner == "held"
        spans.append(parameters.dwell if rests else max(float(length) / waypoint.speed, _QUICKEST))
    return Plan(
        name,
        np.concatenate([[0.0], np.cumsum(spans)]),
        turned(belief, positions, lean),
        ("free", *(waypoint.manner for waypoint in waypoints)),
        parameters.contact_force,
        np.array(parameters.stiffness),
        np.array(parameters.damping),
    )

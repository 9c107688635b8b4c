"""A fixed plan of touches: the 3-2-1 rule of metrology.

Three points on the top determine a part's height and tilt, two on one side its position across and its yaw,
one on the next side the remaining position. A peg that presses and slides touches all points on its path. One
that leans and turns while it presses touches with several of its own points, so it shows how it is held.
"""

from __future__ import annotations

import warnings

import numpy as np
import shapely

from bcppl import poses
from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.holes import lowest_outline
from bcppl.geometry.parts import Part
from bcppl.inference.planning.faces import TopPoints, points_on_top, section, sides
from bcppl.inference.planning.metrology_parameters import MetrologyParameters, checked
from bcppl.inference.planning.side_touches import SideTouch, side_height, two_sides, way_around
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
_SURE = 0.95  # a mode with less of the belief's weight is one of several


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
    chosen = checked(MetrologyParameters() if parameters is None else parameters)
    _refuse_upside_down(belief)
    _warn_of_modes(belief)
    top = top_of(part)
    height = side_height(part, top, chosen)
    unsure = half_stroke(belief, np.array([0.0, 0.0, top]), UP, chosen)
    foot = shapely.get_coordinates(lowest_outline(peg, top - height + unsure))
    radius = float(np.linalg.norm(foot, axis=1).max())
    lateral = max(half_stroke(belief, np.array([0.0, 0.0, top]), axis, chosen) for axis in np.eye(3)[:2])
    points = points_on_top(part, peg, lateral)
    last = points.positions[2]
    first, second = two_sides(sides(part, height), last, radius)
    one = SideTouch.of(belief, first, foot, height, chosen)
    other = SideTouch.of(belief, second, foot, height, chosen)
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
        *way_around(section(part, height), corner, other, here, radius, above),
        *other.touch(here),
        other.slide_to(there),
        *other.rocked(there),
    ]
    return _timed(belief, waypoints, peg, chosen)


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

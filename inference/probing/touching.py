"""Short touches and slides: a place of a part's surface is met by a peg, pressed on, and left again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import trimesh

from bcppl import poses
from bcppl.arguments import number_within, seed_number, whole_number
from bcppl.beliefs import Belief
from bcppl.inference.probing.metrology import DAMPING, STIFFNESS, half_stroke
from bcppl.parts import Part
from bcppl.recordings.plan import Manner, Plan

Array = npt.NDArray[np.float64]


class Touching(NamedTuple):
    """How a short touch is made: metres, seconds, newtons.

    Attributes:
        safe: how far above the part's top the tip is where a touch begins and ends, beyond what the belief is
            unsure of.
        depth: below the top at which sides are touched at least, beyond what the belief is unsure of.
        free, guarded, sliding: m/s, at most.
        force: at which the guarded stroke stops.
        press: how far the command goes on towards the surface once it was met.
        dwell: how long that is held.
        length: of a slide.
        sure: a stroke begins and ends so many standard deviations from where the belief has the surface.
        shortest, longest: between which a stroke's half lies.
        stiffness, damping: of the arm.
    """

    safe: float = 0.02
    depth: float = 0.004
    free: float = 0.2
    guarded: float = 0.04
    sliding: float = 0.06
    force: float = 4.0
    press: float = 0.0015
    dwell: float = 0.25
    length: float = 0.025
    sure: float = 3.0
    shortest: float = 0.003
    longest: float = 0.014
    stiffness: tuple[float, ...] = STIFFNESS
    damping: tuple[float, ...] = DAMPING


class Spot(NamedTuple):
    """A place of a part's surface, in its frame.

    Attributes:
        place: (3,) metres.
        normal: (3,) outward, of unit length.
    """

    place: Array
    normal: Array


_STILL = 0.15  # s before anything moves, in which the wrench is tared
_QUICKEST = 0.05  # s that a motion takes at least
_ALIKE = 2e-5  # m: vertices of a peg so near to its farthest one are as far
_UPRIGHT = 0.5  # a normal whose z is less is a side's
_UP = np.array([0.0, 0.0, 1.0])


def spots_of(part: Part, count: int, seed: int = 0) -> list[Spot]:
    """Places drawn evenly by area over a part's surface, inner walls and bottom included.

    Raises:
        InputError: the count is no positive whole number, or the part has an empty mesh.
    """
    count, seed = whole_number("{} places of a surface were asked for", count), seed_number(seed)
    part.check(closed=False)
    places, faces = trimesh.sample.sample_surface(part.mesh, count, seed=np.random.default_rng(seed))
    normals = part.mesh.face_normals[faces]
    return [Spot(np.asarray(p), np.asarray(n)) for p, n in zip(places, normals, strict=True)]


def face_of(normal: Array) -> str:
    """A surface in words, by its outward normal (3,) in the part's frame: where it looks to."""
    if normal[2] > 1.0 - 1e-3:
        return "top"
    if normal[2] < -_UPRIGHT:
        return "bottom"
    heading = math.degrees(math.atan2(normal[1], normal[0])) % 360.0
    kind = "side" if abs(normal[2]) < _UPRIGHT else "slope"
    return f"{kind} at {round(heading) % 360}°"


def leading_point(peg: Part, direction: Array) -> Array:
    """The point (3,) of a peg that is farthest along a direction (3,), in its frame, metres.

    Where an edge or a face is, the middle of its lowest end: the tip's.
    """
    along = peg.vertices @ direction
    foremost = peg.vertices[along > along.max() - _ALIKE]
    lowest = foremost[foremost[:, 2] < foremost[:, 2].min() + _ALIKE]
    return np.asarray(0.5 * (lowest.min(axis=0) + lowest.max(axis=0)))


def touch(
    belief: Belief, part: Part, peg: Part, spot: Spot, touching: Touching | None = None, name: str = "touch"
) -> Plan:
    """A touch along the inward normal of a spot: from above the part, a guarded stroke, a press, and away.

    The plan is laid out around the belief's mean; the peg keeps the part's orientation there. The stroke is
    as long as the belief is unsure of where the surface is, its middle where the mean has it. A side is
    touched far enough below the top that the tip is sure to meet it.

    Args:
        belief: over world_from_part.
        part: its z axis points out of its top.
        peg: what is held, its frame at the wrench sensor and its tip at its lowest z.
        spot: where.
        touching: speeds and forces.
        name: of the plan.

    Raises:
        InputError: a number of `touching` is not positive.
    """
    return slide(belief, part, peg, spot, np.zeros(3), touching, name)


def slide(
    belief: Belief,
    part: Part,
    peg: Part,
    spot: Spot,
    way: Array,
    touching: Touching | None = None,
    name: str = "slide",
) -> Plan:
    """A touch from which the peg is led on along the surface, pressed on, before it leaves.

    Args:
        belief: over world_from_part.
        part: its z axis points out of its top.
        peg: what is held.
        spot: where it begins.
        way: (3,) along the surface, in the part's frame, metres.
        touching: speeds and forces.
        name: of the plan.

    Raises:
        InputError: a number of `touching` is not positive.
    """
    chosen = _checked(Touching() if touching is None else touching)
    normal = spot.normal
    met = _met(belief, part, peg, spot, chosen)
    half = half_stroke(belief, spot.place, normal, chosen)
    lift = half_stroke(belief, np.array([0.0, 0.0, _top(part)]), _UP, chosen) + chosen.safe
    clear = met + half * normal
    pressed = met - (half + chosen.press) * normal
    above = np.array([*clear[:2], max(clear[2], _top(part) + lift - float(peg.vertices[:, 2].min()))])
    led: list[tuple[Array, Manner, float]] = []
    if np.linalg.norm(way) > 0.0:
        led.append((pressed + way, "held", _span(way, np.zeros(3), chosen.sliding)))
    knots: list[tuple[Array, Manner, float]] = [
        (above, "free", _STILL),
        (clear, "free", _span(above, clear, chosen.free)),
        (met - half * normal, "guarded", _span(clear, met - half * normal, chosen.guarded)),
        (pressed, "held", _span(met - half * normal, pressed, chosen.guarded)),
        (pressed, "held", chosen.dwell),
        *led,
        (clear + way, "free", _span(clear, pressed, chosen.free)),
        (above + way, "free", _span(clear, above, chosen.free)),
    ]
    return _plan(belief, name, [above, *(place for place, _, _ in knots)], knots, chosen)


def middle_of_stroke(plan: Plan) -> tuple[Array, Array] | None:
    """Where a plan is thought to meet the surface; None where nothing is guarded.

    Returns:
        The peg's pose (7,) in the middle of its first guarded motion, and that motion's direction (3,) in the
        world.
    """
    for k, manner in enumerate(plan.manners):
        way = plan.world_from_peg[k + 1, :3] - plan.world_from_peg[k, :3]
        length = float(np.linalg.norm(way))
        if manner == "guarded" and length > 0.0:
            middle = plan.world_from_peg[k].copy()
            middle[:3] += 0.5 * way
            return middle, way / length
    return None


def _checked(touching: Touching) -> Touching:
    for name, value in touching._asdict().items():
        if not isinstance(value, tuple):
            number_within(f"a touch has {name} {{}}", value, above=0.0)
    return touching


def _top(part: Part) -> float:
    return float(part.vertices[:, 2].max())


def _met(belief: Belief, part: Part, peg: Part, spot: Spot, touching: Touching) -> Array:
    """Where the peg's origin (3,) is when it meets a spot, in the part's frame."""
    place = spot.place.copy()
    if abs(spot.normal[2]) < _UPRIGHT:
        top, bottom = _top(part), float(part.vertices[:, 2].min())
        unsure = half_stroke(belief, np.array([0.0, 0.0, top]), _UP, touching)
        highest = max(top - unsure - touching.depth, 0.5 * (top + bottom))
        place[2] = min(place[2], highest)
    return place - leading_point(peg, -spot.normal)


def _span(start: Array, stop: Array, speed: float) -> float:
    """Seconds that a way takes."""
    return max(float(np.linalg.norm(stop - start)) / speed, _QUICKEST)


def _plan(
    belief: Belief,
    name: str,
    places: Sequence[Array],
    knots: Sequence[tuple[Array, Manner, float]],
    touching: Touching,
) -> Plan:
    """The plan of a peg whose origin is led through places in the part's frame, its axes the part's."""
    world_from_peg = belief.mean.expand(len(places), 7).clone()
    world_from_peg[:, :3] = poses.transform(belief.mean, torch.from_numpy(np.stack(places)))
    return Plan(
        name,
        np.concatenate([[0.0], np.cumsum([span for _, _, span in knots])]),
        world_from_peg.numpy(),
        tuple(manner for _, manner, _ in knots),
        touching.force,
        np.array(touching.stiffness),
        np.array(touching.damping),
    )

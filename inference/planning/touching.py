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
from bcppl.geometry.parts import Part
from bcppl.inference.planning.metrology import DAMPING, STIFFNESS, half_stroke
from bcppl.robot.plan import Manner, Plan

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


# By unit, what numbers of it say and how large they may be: beyond it they are in millimetres.
# At stiffness and damping the plan looks.
_BOUNDS = {
    "m": {"safe": 1.0, "depth": 0.5, "press": 0.05, "length": 1.0, "shortest": 0.5, "longest": 0.5},
    "m/s": {"free": 5.0, "guarded": 1.0, "sliding": 1.0},
    "N": {"force": math.inf},
    "s": {"dwell": math.inf},
    "standard deviations": {"sure": math.inf},
}
_PLACES = 1_000_000
_STILL = 0.15  # s before anything moves, in which the wrench is tared
_QUICKEST = 0.05  # s that a motion takes at least
_ALIKE = 2e-5  # m: vertices of a peg so near to its farthest one are as far
_UPRIGHT = 0.5  # a normal whose z is less is a side's
_OVER = 0.006  # m above the part, beyond what the belief is unsure of, between two touches
_SHORTER = 0.6  # of the dwell, where there are two
_UP = np.array([0.0, 0.0, 1.0])


def spots_of(part: Part, count: int, seed: int = 0) -> list[Spot]:
    """Places drawn evenly by area over a part's surface, inner walls and bottom included.

    Raises:
        InputError: the count is no whole number from 1 to a million, or the part has an empty mesh.
    """
    count = whole_number("{} places of a surface were asked for", count, most=_PLACES)
    seed = seed_number(seed)
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
    stroke = _Stroke.of(belief, part, peg, spot, chosen)
    led: list[_Knot] = []
    if np.linalg.norm(way) > 0.0:
        led.append(_Knot(stroke.pressed + way, "held", chosen.sliding))
    knots = [
        *stroke.down(chosen),
        *led,
        _Knot(stroke.clear + way, "free", chosen.free),
        _Knot(stroke.above + way, "free", chosen.free),
    ]
    return _plan(belief, name, stroke.above, knots, chosen)


def pair(
    belief: Belief,
    part: Part,
    peg: Part,
    first: Spot,
    second: Spot,
    touching: Touching | None = None,
    name: str = "pair",
) -> Plan:
    """Two touches in one plan, of two faces of the part; between them the peg is lifted over the part.

    Args:
        belief: over world_from_part.
        part: its z axis points out of its top.
        peg: what is held.
        first: where it touches first.
        second: where then.
        touching: speeds and forces.
        name: of the plan.

    Raises:
        InputError: a number of `touching` is not positive.
    """
    chosen = _checked(Touching() if touching is None else touching)
    chosen = chosen._replace(dwell=_SHORTER * chosen.dwell)
    one, other = (_Stroke.of(belief, part, peg, spot, chosen) for spot in (first, second))
    over = min(one.above[2], other.above[2]) - chosen.safe + _OVER
    knots = [
        *one.down(chosen),
        _Knot(one.clear, "free", chosen.free),
        _Knot(np.array([*one.clear[:2], max(one.clear[2], over)]), "free", chosen.free),
        _Knot(np.array([*other.clear[:2], max(other.clear[2], over)]), "free", chosen.free),
        *other.down(chosen),
        _Knot(other.clear, "free", chosen.free),
        _Knot(other.above, "free", chosen.free),
    ]
    return _plan(belief, name, one.above, knots, chosen)


class _Knot(NamedTuple):
    """Where (3,) the peg's origin is led in the part's frame, how, and how fast (m/s)."""

    place: Array
    manner: Manner
    speed: float


class _Stroke(NamedTuple):
    """A guarded stroke onto a spot: where (3,) the peg's origin is, in the part's frame.

    Attributes:
        above: it begins and ends there, high enough above the part.
        clear, stop: between which the stroke lies.
        pressed: to where the command goes on.
    """

    above: Array
    clear: Array
    stop: Array
    pressed: Array

    @classmethod
    def of(cls, belief: Belief, part: Part, peg: Part, spot: Spot, touching: Touching) -> _Stroke:
        """For a belief over where the surface is."""
        normal, met = spot.normal, _met(belief, part, peg, spot, touching)
        half = half_stroke(belief, spot.place, normal, touching)
        lift = half_stroke(belief, np.array([0.0, 0.0, _top(part)]), _UP, touching) + touching.safe
        clear = met + half * normal
        height = _top(part) + lift - float(peg.vertices[:, 2].min())
        return cls(
            np.array([*clear[:2], max(clear[2], height)]),
            clear,
            met - half * normal,
            met - (half + touching.press) * normal,
        )

    def down(self, touching: Touching) -> list[_Knot]:
        """To the surface, and pressed on."""
        return [
            _Knot(self.clear, "free", touching.free),
            _Knot(self.stop, "guarded", touching.guarded),
            _Knot(self.pressed, "held", touching.guarded),
            _Knot(self.pressed, "held", touching.guarded),
        ]


def middles_of_strokes(plan: Plan) -> list[tuple[Array, Array]]:
    """Where a plan is thought to meet surfaces.

    Returns:
        For each of its guarded motions, the peg's pose (7,) in the middle of it, and its direction (3,) in
        the world.
    """
    found = []
    for k, manner in enumerate(plan.manners):
        way = plan.world_from_peg[k + 1, :3] - plan.world_from_peg[k, :3]
        length = float(np.linalg.norm(way))
        if manner == "guarded" and length > 0.0:
            middle = plan.world_from_peg[k].copy()
            middle[:3] += 0.5 * way
            found.append((middle, way / length))
    return found


def _checked(touching: Touching) -> Touching:
    for unit, bounds in _BOUNDS.items():
        for name, most in bounds.items():
            number_within(f"a touch has {name} {{}} {unit}", getattr(touching, name), above=0.0, most=most)
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


def _plan(belief: Belief, name: str, start: Array, knots: Sequence[_Knot], touching: Touching) -> Plan:
    """The plan of a peg whose origin is led from a place through knots, its axes the part's."""
    places = np.stack([start, start, *(knot.place for knot in knots)])
    ways = np.linalg.norm(np.diff(places[1:], axis=0), axis=1)
    spans = [_STILL]
    for way, knot in zip(ways, knots, strict=True):
        stays = way == 0.0 and knot.manner == "held"
        spans.append(touching.dwell if stays else max(float(way) / knot.speed, _QUICKEST))
    world_from_peg = belief.mean.expand(len(places), 7).clone()
    world_from_peg[:, :3] = poses.transform(belief.mean, torch.from_numpy(places))
    return Plan(
        name,
        np.concatenate([[0.0], np.cumsum(spans)]),
        world_from_peg.numpy(),
        ("free", *(knot.manner for knot in knots)),
        touching.force,
        np.array(touching.stiffness),
        np.array(touching.damping),
    )

"""A fixed rule for where to touch: metrology's 3-2-1.

Three points on the top fix a part's height and tilt, two on one side its place across and its yaw, one on the
next side what is left. A peg that is pressed on and slides touches all the points on its way.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import shapely
import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.geometry.parts import Part
from bcppl.inference.planning.faces import Side, Spots, section, sides, spots_on_top
from bcppl.robot.plan import Manner, Plan

Array = npt.NDArray[np.float64]


class Pace(NamedTuple):
    """How a plan is carried out.

    Attributes:
        first: seconds; when the first contact is expected.
        last: seconds; when the plan ends.
        guarded, free, sliding: m/s, at most. Faster is made only as far as the plan would not end in time.
        slowest: m/s; with time to spare slides become slower, down to this.
        force: newtons at which a guarded motion stops.
        press: metres that a command goes on towards a surface once it was met: an impact may have stopped it.
        depth: metres below the top at which sides are touched, where the part is high enough.
        sure: a stroke begins and ends so many standard deviations of where the belief says the surface is.
        shortest, longest: metres between which a stroke's half lies.
    """

    first: float = 3.0
    last: float = 6.0
    guarded: float = 0.06
    free: float = 0.25
    sliding: float = 0.09
    slowest: float = 0.02
    force: float = 4.0
    press: float = 0.003
    depth: float = 0.012
    sure: float = 3.0
    shortest: float = 0.003
    longest: float = 0.012


class Reach(Protocol):
    """What says how long a stroke is: the fields of `Pace` of the same names."""

    @property
    def sure(self) -> float:
        """Standard deviations."""

    @property
    def shortest(self) -> float:
        """Metres."""

    @property
    def longest(self) -> float:
        """Metres."""


STIFFNESS = (2500.0, 2500.0, 2500.0, 150.0, 150.0, 150.0)
DAMPING = (120.0, 120.0, 120.0, 2.5, 2.5, 2.5)
_ABOVE = 0.06  # m above the top at which a plan begins
_AWAY = 0.002  # m from the part on ways around it


class _Knot(NamedTuple):
    place: Array  # (3,) of the tip's centre in the part's frame
    manner: Manner  # of the motion to it
    speed: float


def three_two_one(belief: Belief, part: Part, peg: Part, pace: Pace | None = None) -> Plan:
    """Three touches on the part's top, two on one side and two on the next, joined by slides.

    The plan is laid out around the belief's mean; the peg keeps the part's orientation there. Strokes towards
    a face are as long as the belief is unsure of where that face is.

    Args:
        belief: over world_from_part.
        part: its z axis points out of its top.
        peg: what is held, its frame at the wrench sensor and its tip at its lowest z.
        pace: speeds and times.

    Raises:
        InputError: the part's top has no room for the peg.
    """
    pace = Pace() if pace is None else pace
    top = float(part.vertices[:, 2].max())
    height = top - min(pace.depth, 0.5 * float(part.extent[2]))
    across = float(np.linalg.norm(peg.vertices[:, :2], axis=1).max())
    lateral = half_stroke(belief, np.array([0.0, 0.0, top]), np.array([1.0, 0.0, 0.0]), pace)
    spots = spots_on_top(part, peg, lateral)
    last = spots.places[2]
    first, second = _pair(sides(part, height), last, across)
    one = _OnSide.of(belief, first, peg, height, pace)
    other = _OnSide.of(belief, second, peg, height, pace)
    begin, end = one.slide(last, other.middle)
    here, there = other.slide(end, end)
    lift = half_stroke(belief, np.array([*begin, top]), np.array([0.0, 0.0, 1.0]), pace)
    knots = [
        *_on_top(belief, spots, top, pace),
        _Knot(np.array([*begin, top + lift]) + one.clear, "free", pace.free),
        *one.touch(begin),
        _Knot(one.at(end) + one.stop - one.press, "held", pace.sliding),
        _Knot(one.at(end) + one.clear, "free", pace.free),
        *_around(section(part, height), one.at(end) + one.clear, other, here, one, across, top + lift),
        *other.touch(here),
        _Knot(other.at(there) + other.stop - other.press, "held", pace.sliding),
    ]
    return _timed(belief, knots, peg, pace)


class _OnSide(NamedTuple):
    """How a side is touched, in the part's frame: metres.

    Attributes:
        face: the side.
        height: z of the tip.
        clear, stop, press: (3,) where a stroke begins and ends beside the face, and what presses on.
        inset: of the ends of a slide from the face's.
        pace: speeds.
    """

    face: Side
    height: float
    clear: Array
    stop: Array
    press: Array
    inset: float
    pace: Pace

    @classmethod
    def of(cls, belief: Belief, face: Side, peg: Part, height: float, pace: Pace) -> _OnSide:
        """For a belief over where the face is."""
        normal = np.array([*face.normal, 0.0])
        reach = float((peg.vertices[:, :2] @ -face.normal).max())  # of the peg towards the face
        middle = 0.5 * (face.start + face.stop)
        stroke = half_stroke(belief, np.array([*middle, height]), normal, pace)
        tangent = np.array([-normal[1], normal[0], 0.0])
        inset = min(face.length / 3.0, half_stroke(belief, np.array([*middle, height]), tangent, pace))
        return cls(
            face,
            height,
            (reach + stroke) * normal,
            (reach - stroke) * normal,
            pace.press * normal,
            inset,
            pace,
        )

    @property
    def middle(self) -> Array:
        """(2,)."""
        return 0.5 * (self.face.start + self.face.stop)

    def slide(self, before: Array, after: Array) -> tuple[Array, Array]:
        """Where a slide begins and ends, (2,) each, so that the ways from and to other places are short."""
        along = (self.face.stop - self.face.start) / max(self.face.length, 1e-9)
        a, b = self.face.start + self.inset * along, self.face.stop - self.inset * along
        forth = np.linalg.norm(a - before) + np.linalg.norm(b - after)
        back = np.linalg.norm(b - before) + np.linalg.norm(a - after)
        return (a, b) if forth <= back else (b, a)

    def at(self, place: Array) -> Array:
        """(3,)."""
        return np.array([*place, self.height])

    def touch(self, place: Array) -> list[_Knot]:
        """Beside the face, to it, and on."""
        here = self.at(place)
        return [
            _Knot(here + self.clear, "free", self.pace.free),
            _Knot(here + self.stop, "guarded", self.pace.guarded),
            _Knot(here + self.stop - self.press, "held", self.pace.guarded),
        ]


def _around(
    outline: shapely.Polygon,
    start: Array,
    other: _OnSide,
    place: Array,
    one: _OnSide,
    across: float,
    above: float,
) -> list[_Knot]:
    """The way from beside one side to beside a place of the other that does not touch the part."""
    body = outline.convex_hull.buffer(across + _AWAY)
    goal = other.at(place) + other.clear
    corner = start + ((goal - start) @ _unit(other.clear)) * _unit(other.clear)
    for ways in ([], [corner]):
        places = [start, *ways, goal]
        line = shapely.LineString([place[:2] for place in places])
        if not body.intersects(line):
            return [_Knot(place, "free", one.pace.free) for place in ways]
    up = [np.array([*start[:2], above]), np.array([*goal[:2], above])]
    return [_Knot(place, "free", one.pace.free) for place in up]


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def half_stroke(belief: Belief, place: Array, normal: Array, pace: Reach) -> float:
    """Half a stroke (m) towards a surface, as long as a belief is unsure of where the surface is.

    Args:
        belief: over world_from_part.
        place: (3,) on the surface, in the part's frame.
        normal: (3,) of the surface there, in the part's frame.
        pace: how many standard deviations that is, and its limits.
    """
    there = poses.transform(belief.world_from_part, torch.as_tensor(place)[None])[:, 0]
    direction = poses.rotation_matrix(belief.mean) @ torch.as_tensor(normal)
    along = there @ direction
    middle = belief.weights @ along
    spread = float(torch.sqrt(belief.weights @ (along - middle) ** 2))
    return float(np.clip(pace.sure * spread, pace.shortest, pace.longest))


def _pair(faces: list[Side], near: Array, across: float) -> tuple[Side, Side]:
    """A long side, the one nearest to where the peg comes from, and one that stands across it."""
    longest = [face for face in faces if face.length > 0.8 * faces[0].length]

    def away(face: Side) -> float:
        return float(np.linalg.norm(0.5 * (face.start + face.stop) + across * face.normal - near))

    first = min(longest, key=away)
    upright = [face for face in faces if abs(float(face.normal @ first.normal)) < 0.5]
    second = min(upright or faces, key=lambda face: (-round(face.length, 3), away(face)))
    return first, second


def _on_top(belief: Belief, spots: Spots, top: float, pace: Pace) -> list[_Knot]:
    a, b, c = (np.array([*spot, top]) for spot in spots.places)
    stroke = half_stroke(belief, a, np.array([0.0, 0.0, 1.0]), pace)
    up, down = np.array([0.0, 0.0, stroke]), np.array([0.0, 0.0, -stroke])
    on = down - np.array([0.0, 0.0, pace.press])

    def touch(spot: Array) -> list[_Knot]:
        return [
            _Knot(spot + up, "free", pace.free),
            _Knot(spot + down, "guarded", pace.guarded),
            _Knot(spot + on, "held", pace.guarded),
        ]

    to_last = [_Knot(b + up, "free", pace.free), *touch(c)]
    return [
        _Knot(a + np.array([0.0, 0.0, _ABOVE]), "free", pace.free),
        *touch(a),
        _Knot(b + on, "held", pace.sliding),
        *(to_last if spots.lifted else [_Knot(c + on, "held", pace.sliding)]),
        _Knot(c + up, "free", pace.free),
    ]


def _timed(belief: Belief, knots: list[_Knot], peg: Part, pace: Pace) -> Plan:
    """The plan of knots in the part's frame, faster where it would not end in time."""
    places = np.stack([knot.place for knot in knots])
    ways = np.linalg.norm(np.diff(places, axis=0), axis=1)
    needed = np.maximum(ways / np.array([knot.speed for knot in knots[1:]]), 0.04)
    touched = next(k for k, knot in enumerate(knots) if knot.manner == "guarded")
    # Half of the first stroke is over at the first contact; what comes after must fit in what is left.
    after = np.concatenate([[0.5 * needed[touched - 1]], needed[touched:]])
    left = pace.last - pace.first
    faster = np.array([0.5 if knot.manner == "guarded" else 1.0 for knot in knots[1:]])
    if after.sum() > left:
        guarded = np.concatenate([[True], faster[touched:] < 1.0])
        slow = after[guarded].sum()
        if slow < 0.6 * left:  # guarded strokes keep their speed where that leaves enough for the rest
            shrink = np.where(guarded, 1.0, (left - slow) / after[~guarded].sum())
        else:
            shrink = np.full(len(after), left / after.sum())
        needed[touched - 1 :] *= shrink
    begin = pace.first - needed[: touched - 1].sum() - 0.5 * needed[touched - 1]
    spare = pace.last - (begin + needed.sum())
    slides = np.array([knot.manner == "held" for knot in knots[1:]]) & (ways > 1.01 * pace.press)
    if spare > 0.0 and slides.any():  # where there is time to spare, slides are slower and tell more
        slower = needed * (1.0 + spare / needed[slides].sum())
        needed = np.where(slides, np.maximum(needed, np.minimum(slower, ways / pace.slowest)), needed)
    times = begin + np.concatenate([[0.0], np.cumsum(needed)])
    times = np.concatenate([[0.0], times])
    places = np.concatenate([places[:1], places])
    manners: tuple[Manner, ...] = ("free", *(knot.manner for knot in knots[1:]))
    if times[-1] < pace.last - 1e-6:
        times, places = np.append(times, pace.last), np.concatenate([places, places[-1:]])
        manners = (*manners, "held")
    tip = -float(peg.vertices[:, 2].min())
    world_from_peg = belief.mean.expand(len(places), 7).clone()
    sensor = torch.from_numpy(places + np.array([0.0, 0.0, tip]))
    world_from_peg[:, :3] = poses.transform(belief.mean, sensor)
    return Plan(
        "3-2-1",
        times,
        world_from_peg.numpy(),
        manners,
        pace.force,
        np.array(STIFFNESS),
        np.array(DAMPING),
    )

"""Plans and views of each kind, laid out around a belief: the places are drawn from the part's surface."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.gap import PegGap
from bcppl.geometry.holes import Hole, hole_of
from bcppl.geometry.parts import Part
from bcppl.inference.planning.insertion import Attempt, insertion_plan
from bcppl.inference.planning.touching import (
    Spot,
    Touching,
    face_of,
    middles_of_strokes,
    pair,
    slide,
    spots_of,
    touch,
)
from bcppl.robot.plan import Plan
from bcppl.sensors.depth import DepthSensor, View

Array = npt.NDArray[np.float64]

# A search and an attempt that take two to three seconds.
SHORT = Attempt(above=0.01, landing=0.03, longest=1.5, widest=0.006, press=0.004)
_SHARES = (1.0, -1.0, 0.6, -0.6)  # of a slide's length that are tried, either way
_ON = 0.0003  # m: a peg so near to the part slides on it
_NEAR = 20  # places from among which the second touch of a pair is chosen
_DOWNWARD = -0.5  # z of a normal that looks down
_LOOKED_AT = 9  # places of a slide


@dataclass(frozen=True, eq=False)
class Setup:
    """What candidates are planned from.

    Attributes:
        belief: over world_from_part.
        part: its z axis points out of its top.
        peg: what is held; None for views alone.
        gap: of part and peg, if it is at hand.
        hole: the one that is searched for, if it is at hand; None to have `hole_of` find it.
        touching: how touches and slides are made.
        attempt: how searches and attempts are made.
        camera: views are taken with one like it, from other places.
        seed: of the places.
    """

    belief: Belief
    part: Part
    peg: Part | None = None
    gap: PegGap | None = None
    hole: Hole | None = None
    touching: Touching = field(default_factory=Touching)
    attempt: Attempt = SHORT
    camera: Camera | None = None
    seed: int = 0

    @property
    def held(self) -> Part:
        """The peg.

        Raises:
            InputError: there is none.
        """
        if self.peg is None:
            raise InputError(
                "there is no peg to touch the part with; add the peg to the recording, or ask for views."
            )
        return self.peg

    @property
    def measured(self) -> PegGap:
        """The gap of part and peg.

        Raises:
            InputError: there is no peg.
        """
        return PegGap(self.part, self.held) if self.gap is None else self.gap


def _touches(setup: Setup, most: int) -> Iterator[Plan | View]:
    for spot in spots_of(setup.part, most, setup.seed):
        name = f"touch #: {face_of(spot.normal)}"
        yield touch(setup.belief, setup.part, setup.held, spot, setup.touching, name)


def _slides(setup: Setup, most: int) -> Iterator[Plan | View]:
    """Slides along a face that they do not leave, at the belief's mean."""
    generator = np.random.default_rng([setup.seed, 1])
    for spot in spots_of(setup.part, most, int(generator.integers(2**31))):
        along = _tangent(spot, generator)
        landed = touch(setup.belief, setup.part, setup.held, spot, setup.touching)
        met, _ = middles_of_strokes(landed)[0]
        length = next(
            (
                share * setup.touching.length
                for share in _SHARES
                if _stays_on(setup, met, share * setup.touching.length * along)
            ),
            0.0,
        )
        name = f"slide #: {face_of(spot.normal)}"
        if length != 0.0:
            yield slide(setup.belief, setup.part, setup.held, spot, length * along, setup.touching, name)


def _pairs(setup: Setup, most: int) -> Iterator[Plan | View]:
    """Two touches of faces that stand across one another, near the edge or corner that they share."""
    generator = np.random.default_rng([setup.seed, 4])
    firsts = spots_of(setup.part, most, int(generator.integers(2**31)))
    for first in firsts:
        others = spots_of(setup.part, _NEAR, int(generator.integers(2**31)))
        across = [o for o in others if abs(float(o.normal @ first.normal)) < 0.5 and o.normal[2] > _DOWNWARD]
        if across:
            second = min(across, key=lambda o: float(np.linalg.norm(o.place - first.place)))
            name = f"pair #: {face_of(first.normal)}, {face_of(second.normal)}"
            yield pair(setup.belief, setup.part, setup.held, first, second, setup.touching, name)


def _tangent(spot: Spot, generator: np.random.Generator) -> Array:
    """A direction (3,) along a surface, in the part's frame: any on the top, level on a side."""
    level = np.cross(spot.normal, [0.0, 0.0, 1.0])
    if np.linalg.norm(level) > 0.5:
        return np.asarray(level / np.linalg.norm(level) * generator.choice([-1.0, 1.0]))
    angle = generator.uniform(0.0, 2.0 * math.pi)
    way = np.array([math.cos(angle), math.sin(angle), 0.0])
    way -= (way @ spot.normal) * spot.normal
    return np.asarray(way / np.linalg.norm(way))


def _stays_on(setup: Setup, world_from_peg: Array, way: Array) -> bool:
    """Whether a peg that is led along (3,) in the part's frame stays on its surface, at the mean."""
    mean = setup.belief.mean
    turned = poses.rotation_matrix(mean).numpy() @ way
    path = np.repeat(world_from_peg[None], _LOOKED_AT, axis=0)
    path[:, :3] += np.linspace(0.0, 1.0, _LOOKED_AT)[:, None] * turned
    return bool((setup.measured(mean[None], torch.from_numpy(path)).distance.abs() < _ON).all())


def _aims(setup: Setup, most: int) -> Iterator[Belief]:
    """The belief, then the same shifted so that its mean is at particles drawn by weight."""
    yield setup.belief
    generator = np.random.default_rng([setup.seed, 2])
    weights = setup.belief.weights.numpy()
    for k in generator.choice(len(weights), size=max(most - 1, 0), p=weights / weights.sum()):
        aim = poses.compose(setup.belief.world_from_part[k], poses.inverse(setup.belief.mean))
        yield replace(setup.belief, world_from_part=poses.compose(aim, setup.belief.world_from_part))


def _searches(setup: Setup, most: int) -> Iterator[Plan | View]:
    hole = hole_of(setup.part) if setup.hole is None else setup.hole
    for aimed in _aims(setup, most):
        plan = insertion_plan(aimed, setup.part, setup.held, hole, setup.attempt)
        yield _leaving(replace(plan.search, name="search #: spiral over the hole"))


def _attempts(setup: Setup, most: int) -> Iterator[Plan | View]:
    """Straight down the hole's axis, until something is felt: in the hole nothing is."""
    hole = hole_of(setup.part) if setup.hole is None else setup.hole
    for aimed in _aims(setup, most):
        plan = insertion_plan(aimed, setup.part, setup.held, hole, setup.attempt)
        down = -poses.rotation_matrix(torch.from_numpy(plan.world_from_hole))[:, 2].numpy()
        first, start = plan.search.world_from_peg[0], plan.search.world_from_peg[2]
        stop = start.copy()
        lands = float((start[:3] - plan.push.world_from_peg[0, :3]) @ -down)
        deep = min(plan.deep_enough, plan.chamfer + 0.004)
        stop[:3] += (lands + deep) * down
        pressed = stop.copy()
        pressed[:3] += setup.touching.press * down
        spans = [
            0.15,
            float(np.linalg.norm(start[:3] - first[:3])) / setup.touching.free + 0.05,
            (lands + deep) / setup.touching.guarded,
            0.1,
            setup.touching.dwell,
        ]
        yield _leaving(
            Plan(
                "attempt #: straight into the hole",
                np.concatenate([[0.0], np.cumsum(spans)]),
                np.stack([first, first, start, stop, pressed, pressed]),
                ("free", "free", "guarded", "held", "held"),
                setup.touching.force,
                np.array(setup.touching.stiffness),
                np.array(setup.touching.damping),
            )
        )


def _leaving(plan: Plan) -> Plan:
    """A plan that ends where it began, lifted off by the way it came."""
    back = plan.world_from_peg[:1]
    length = float(np.linalg.norm(plan.world_from_peg[-1, :3] - back[0, :3]))
    return replace(
        plan,
        times=np.append(plan.times, plan.times[-1] + max(length / 0.1, 0.1)),
        world_from_peg=np.concatenate([plan.world_from_peg, back]),
        manners=(*plan.manners, "free"),
    )


def _views(setup: Setup, most: int) -> Iterator[Plan | View]:
    like = None if setup.camera is None else View(setup.camera)
    yield from DepthSensor().around(setup.belief.mean.numpy(), setup.part, like, most, setup.seed)


SOURCES: Mapping[str, Callable[[Setup, int], Iterator[Plan | View]]] = {
    "touch": _touches,
    "slide": _slides,
    "pair": _pairs,
    "search": _searches,
    "attempt": _attempts,
    "view": _views,
}

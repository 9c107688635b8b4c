"""Generators of candidates of each kind, planned for a belief at points drawn from the part's surface."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.gap import PegGap
from bcppl.geometry.holes import Hole, hole_of
from bcppl.geometry.parts import Part
from bcppl.inference.planning.insertion import InsertionParameters, insertion_plan
from bcppl.inference.planning.metrology_parameters import ROCKED
from bcppl.inference.planning.motions import expected_contacts
from bcppl.inference.planning.touching import (
    UPRIGHT,
    SurfacePoint,
    TouchParameters,
    face_name,
    pair,
    slide,
    surface_points,
    touch,
)
from bcppl.robot.plan import InsertionPlan, Plan
from bcppl.sensors import sensor_named, sensors
from bcppl.sensors.candidates import Candidate
from bcppl.sensors.protocol import AroundPart

# Searches and attempts that take two to three seconds.
SHORT = InsertionParameters(
    approach_height=0.01, landing_speed=0.03, search_time=1.5, maximum_radius=0.006, press_depth=0.004
)
_SHARES = (1.0, -1.0, 0.6, -0.6)  # of a slide's length, in the order in which they are tried
_CONTACT = 0.0003  # m: a peg so near to the part slides on it
_NEAR = 20  # points from among which the second touch of a pair is chosen
_DOWNWARD = -0.5  # z of a normal of the underside
_POSES = 9  # at which a slide is checked
_REST = 0.15  # s before any motion, for the tare
_BACK = 0.1  # m/s at most, of a way back
# By which a leaning peg is turned: as in a probe that rocks (`metrology.ROCKED`).
_LEAN, _TURN = ROCKED.lean, ROCKED.turn


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """The problem that candidates are planned for: the arguments of `plan_candidates`.

    `like` has by kind of sensor an action that its candidates resemble.
    """

    belief: Belief
    part: Part
    peg: Part | None = None
    gap: PegGap | None = None
    hole: Hole | None = None
    touch_parameters: TouchParameters = field(default_factory=TouchParameters)
    insertion_parameters: InsertionParameters = SHORT
    like: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0

    @property
    def held_peg(self) -> Part:
        """The peg; InputError where there is none."""
        if self.peg is None:
            raise InputError(
                "there is no peg to touch the part with; add the peg to the recording, or ask for views."
            )
        return self.peg

    @property
    def peg_gap(self) -> PegGap:
        """The gap of part and peg."""
        return PegGap(self.part, self.held_peg) if self.gap is None else self.gap

    def generator(self, stream: int) -> np.random.Generator:
        """A generator of random numbers for one kind of candidates."""
        return np.random.default_rng([self.seed, stream])


def _touches(problem: PlanningProblem, most: int) -> Iterator[Plan]:
    for point in surface_points(problem.part, most, problem.seed):
        name = f"touch #: {face_name(point.normal)}"
        yield touch(problem.belief, problem.part, problem.held_peg, point, problem.touch_parameters, name)


def _leaning(problem: PlanningProblem, most: int) -> Iterator[Plan]:
    """Touches whose peg is turned about two axes: they tell where it sits in the hand from where the part is.

    All touches of a peg that keeps its axes are moved alike by either.
    """
    generator = problem.generator(5)
    for point in surface_points(problem.part, most, int(generator.integers(2**31))):
        name, heading = f"lean #: {face_name(point.normal)}", generator.uniform(-math.pi, math.pi)
        if abs(point.normal[2]) < UPRIGHT:  # away from a side, which the tip is to meet
            heading = math.atan2(point.normal[1], point.normal[0]) + heading / 3.0
        # Where the peg's upper end leans to; the axis is across it.
        lean = _LEAN * np.array([-math.sin(heading), math.cos(heading), 0.0])
        lean[2] = generator.choice([-_TURN, _TURN])
        given = problem.belief, problem.part, problem.held_peg, point, problem.touch_parameters
        yield touch(*given, name, lean)


def _slides(problem: PlanningProblem, most: int) -> Iterator[Plan]:
    """Slides along a face that they do not leave, at the belief's mean."""
    generator, parameters = problem.generator(1), problem.touch_parameters
    given = problem.belief, problem.part, problem.held_peg
    for point in surface_points(problem.part, most, int(generator.integers(2**31))):
        along = _tangent(point, generator)
        contact, _ = expected_contacts(touch(*given, point, parameters))[0]
        name = f"slide #: {face_name(point.normal)}"
        for share in _SHARES:
            displacement = share * parameters.slide_length * along
            if _stays_on(problem, contact, displacement):
                yield slide(*given, point, displacement, parameters, name)
                break


def _pairs(problem: PlanningProblem, most: int) -> Iterator[Plan]:
    """Two touches of faces across one another, near the edge or corner that they share."""
    generator = problem.generator(4)
    given = problem.belief, problem.part, problem.held_peg
    for first in surface_points(problem.part, most, int(generator.integers(2**31))):
        others = surface_points(problem.part, _NEAR, int(generator.integers(2**31)))
        across = [o for o in others if abs(float(o.normal @ first.normal)) < 0.5 and o.normal[2] > _DOWNWARD]
        if across:
            second = min(across, key=lambda o: float(np.linalg.norm(o.position - first.position)))
            name = f"pair #: {face_name(first.normal)}, {face_name(second.normal)}"
            yield pair(*given, first, second, problem.touch_parameters, name)


def _tangent(point: SurfacePoint, generator: np.random.Generator) -> Array:
    """A direction (3,) along a surface, in the part's frame: any on the top, horizontal on a side."""
    level = np.cross(point.normal, [0.0, 0.0, 1.0])
    if np.linalg.norm(level) > 0.5:
        return np.asarray(level / np.linalg.norm(level) * generator.choice([-1.0, 1.0]))
    angle = generator.uniform(0.0, 2.0 * math.pi)
    direction = np.array([math.cos(angle), math.sin(angle), 0.0])
    direction -= (direction @ point.normal) * point.normal
    return np.asarray(direction / np.linalg.norm(direction))


def _stays_on(problem: PlanningProblem, world_from_peg: Array, displacement: Array) -> bool:
    """Whether a peg that moves by (3,) in the part's frame stays in contact, at the belief's mean."""
    mean = problem.belief.mean
    turned = poses.rotation_matrix(mean).numpy() @ displacement
    path = np.repeat(world_from_peg[None], _POSES, axis=0)
    path[:, :3] += np.linspace(0.0, 1.0, _POSES)[:, None] * turned
    return bool((problem.peg_gap(mean[None], torch.from_numpy(path)).distance.abs() < _CONTACT).all())


def _insertions(problem: PlanningProblem, most: int) -> Iterator[InsertionPlan]:
    """Insertions at the belief's heaviest mode, then at particles drawn by weight, as uncertain."""
    belief, generator = problem.belief, problem.generator(2)
    hole = hole_of(problem.part, peg=problem.held_peg) if problem.hole is None else problem.hole
    middle = poses.inverse(belief.modes()[0].mean)
    weights = belief.weights.numpy()
    drawn = generator.choice(len(weights), size=max(most - 1, 0), p=weights / weights.sum())
    for k in (None, *drawn):
        shifted = belief
        if k is not None:
            shift = poses.compose(belief.world_from_part[k], middle)
            shifted = belief.moved(poses.compose(shift, belief.world_from_part))
        yield insertion_plan(shifted, problem.part, problem.held_peg, hole, problem.insertion_parameters)


def _searches(problem: PlanningProblem, most: int) -> Iterator[Plan]:
    for plan in _insertions(problem, most):
        search = replace(plan.search, name="search #: spiral over the hole")
        yield _and_back(search, problem.insertion_parameters.free_speed)


def _attempts(problem: PlanningProblem, most: int) -> Iterator[Plan]:
    """Guarded motions straight down the hole's axis, which no contact stops where the hole is."""
    parameters = problem.touch_parameters
    for plan in _insertions(problem, most):
        down = -poses.rotation_matrix(torch.from_numpy(plan.world_from_hole))[:, 2].numpy()
        first, start = plan.search.world_from_peg[0], plan.search.world_from_peg[2]
        stop = start.copy()
        height = float((start[:3] - plan.push.world_from_peg[0, :3]) @ -down)
        depth = min(plan.deep_enough, plan.chamfer + 0.004)
        stop[:3] += (height + depth) * down
        pressed = stop.copy()
        pressed[:3] += parameters.press_depth * down
        spans = [
            _REST,
            float(np.linalg.norm(start[:3] - first[:3])) / parameters.free_speed + 0.05,
            (height + depth) / parameters.guarded_speed,
            max(0.1, parameters.press_depth / parameters.guarded_speed),
            parameters.dwell,
        ]
        yield _and_back(
            Plan(
                "attempt #: straight into the hole",
                np.concatenate([[0.0], np.cumsum(spans)]),
                np.stack([first, first, start, stop, pressed, pressed]),
                ("free", "free", "guarded", "held", "held"),
                parameters.contact_force,
                np.array(parameters.stiffness),
                np.array(parameters.damping),
            ),
            parameters.free_speed,
        )


def _and_back(plan: Plan, speed: float) -> Plan:
    """The plan with a free motion back to where it begins, at a speed (m/s) of `_BACK` at most."""
    back = plan.world_from_peg[:1]
    length = float(np.linalg.norm(plan.world_from_peg[-1, :3] - back[0, :3]))
    return replace(
        plan,
        times=np.append(plan.times, plan.times[-1] + max(length / min(speed, _BACK), 0.1)),
        world_from_peg=np.concatenate([plan.world_from_peg, back]),
        manners=(*plan.manners, "free"),
    )


MOTIONS: Mapping[str, Callable[[PlanningProblem, int], Iterator[Plan]]] = {
    "touch": _touches,
    "lean": _leaning,
    "slide": _slides,
    "pair": _pairs,
    "search": _searches,
    "attempt": _attempts,
}


def candidate_kinds() -> tuple[str, ...]:
    """The kinds of candidates: the planned motions, and the sensors with candidates of their own."""
    return (*MOTIONS, *(sensor.kind for sensor in sensors() if isinstance(sensor, AroundPart)))


def generate(kind: str, problem: PlanningProblem, most: int) -> Iterator[Candidate]:
    """Candidates of a kind, at most so many, with `#` in their names for a number."""
    if kind in MOTIONS:
        return MOTIONS[kind](problem, most)
    sensor = sensor_named(kind)
    assert isinstance(sensor, AroundPart)
    like, mean = problem.like.get(kind), problem.belief.mean.numpy()
    return sensor.around(mean, problem.part, like, most, problem.seed)

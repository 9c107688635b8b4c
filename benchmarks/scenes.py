"""One scene of the accuracy bench from its two images to the end of its probe, and the belief's errors.

From the belief after vision `three_two_one` plans a probe, which is carried out; its touches are assimilated
by a run that is resumed from vision's last step. The belief at the end is, to the bit, that of a run over the
whole recording.
"""

from __future__ import annotations

import math
import multiprocessing
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.beliefs.distances import average_distance, average_nearest_distance
from bcppl.beliefs.regions import (
    average_point_distance,
    pose_deviation,
    rotation_deviation,
    translation_deviation,
)
from bcppl.cli.predictive_checks import MARK, PredictiveChecks
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.filters.smc import Step
from bcppl.inference.planning.metrology import three_two_one
from bcppl.models import look_and_touch
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.sensors.measurements import Recording
from bcppl.sweeps import Failure, as_they_end, one_line

# Where a bench is perfect the model is given that: the peg is where it is measured.
model = look_and_touch.model.with_settings(profile="perfect")
PARTICLES = 75
TIMES = {"3 s": 3.0, "4 s": 4.0, "5 s": 5.0, "6 s": 6.0}
VISION, END = "vision", "6 s"
MOMENTS = (VISION, *TIMES)
MASSES = (0.5, 0.9)
REGIONS = ("translation", "rotation", "pose", "ADD-radius")

Value = TypeVar("Value")
Task = TypeVar("Task")


class Moment(NamedTuple):
    """How far off a belief is: millimetres and degrees.

    Attributes:
        weighted_add: ADD averaged over the particles by weight.
        add, add_s: of the posterior mean.
        along, across: of the hole's centre, along the hole's true axis and across it.
        rotation, tilt, yaw: the whole angle; of the hole's axis; about it.
    """

    weighted_add: float
    add: float
    add_s: float
    along: float
    across: float
    rotation: float
    tilt: float
    yaw: float


MISSED = Moment(*[math.inf] * len(Moment._fields))


class Curve(NamedTuple):
    """Weighted ADD (mm) after the prior and each measurement, when (s, NaN for views), and their kinds."""

    times: list[float]
    adds: list[float]
    kinds: list[str]


@dataclass
class Probed:
    """What came of one scene.

    Attributes:
        seed: of the scene.
        part, clearance: which; millimetres.
        missed: in one line why the scene was not brought to its end; empty where it was.
        moments: by name of the moment, how far off the belief was.
        holds: by name of the moment, and by region and mass, whether it held the truth.
        curve: ADD over time.
        seconds: wall time of "vision", "planning" and "touch".
        waits: by kind, "view" or "window", the wall time of each measurement.
        efforts: by simulator, wall time (s) and what it made (images or gaps).
        tempered: how many measurements were tempered.
        warned: whether a run would have warned of a measurement (`bcppl.cli.predictive_checks`).
        memory: most that the process ever held, GB.
        inference_seed: of inference; the scene's unless given.
    """

    seed: int
    part: str = "-"
    clearance: float = math.nan
    missed: str = ""
    moments: dict[str, Moment] = field(default_factory=dict)
    holds: dict[str, dict[tuple[str, float], bool]] = field(default_factory=dict)
    curve: Curve = field(default_factory=lambda: Curve([], [], []))
    seconds: dict[str, float] = field(default_factory=dict)
    waits: dict[str, list[float]] = field(default_factory=dict)
    efforts: dict[str, tuple[float, int]] = field(default_factory=dict)
    tempered: int = 0
    warned: bool = False
    memory: float = math.nan
    inference_seed: int | None = None

    @property
    def name(self) -> str:
        """The scene in words."""
        seeds = f"{self.seed}" if self.inference_seed is None else f"{self.seed}/{self.inference_seed}"
        return f"{seeds}: {self.part}, {self.clearance:g} mm"

    @property
    def wall(self) -> float:
        """Seconds from the images to the last belief, without the world's; NaN where it was not reached."""
        return math.nan if self.missed else sum(self.seconds.values())

    def at(self, moment: str) -> Moment:
        """How far off; infinitely where the scene did not get there."""
        return self.moments.get(moment, MISSED)

    def held(self, moment: str, region: str, mass: float) -> bool:
        """Whether a region held the truth; it did not where the scene did not get there."""
        return self.holds.get(moment, {}).get((region, mass), False)


def moment_of(belief: Belief, scene: BenchScene) -> Moment:
    """How far off a belief is in a scene."""
    points, mean, truth = scene.part.surface_points(), belief.mean, scene.truth
    return Moment(
        1e3 * belief.weighted_add(points, truth),
        1e3 * float(average_distance(mean, points, truth)),
        1e3 * float(average_nearest_distance(mean, points, truth)),
        *hole_error(mean, torch.as_tensor(truth), torch.as_tensor(scene.kind.part_from_hole)),
    )


def hole_error(
    mean: Tensor, truth: Tensor, part_from_hole: Tensor
) -> tuple[float, float, float, float, float]:
    """How far a pose (7,) puts a hole from where the true one does: along, across, rotation, tilt, yaw.

    Millimetres in the true hole's frame, and degrees: of the whole rotation, of the hole's axis, and about it
    once that is turned back (swing and twist).
    """
    off = poses.compose(
        poses.inverse(poses.compose(truth, part_from_hole)), poses.compose(mean, part_from_hole)
    )
    x, y, z = (1e3 * off[:3]).tolist()
    w, i, j, k = off[3:].tolist()
    angles = (
        2.0 * math.atan2(math.hypot(i, j, k), abs(w)),
        2.0 * math.atan2(math.hypot(i, j), math.hypot(w, k)),
        2.0 * math.atan2(abs(k), abs(w)),
    )
    rotation, tilt, yaw = (math.degrees(angle) for angle in angles)
    return abs(z), math.hypot(x, y), rotation, tilt, yaw


def regions_of(belief: Belief, scene: BenchScene) -> dict[tuple[str, float], bool]:
    """By region and mass, whether a belief's credible regions hold the truth."""
    points = scene.part.surface_points()
    measures = translation_deviation, rotation_deviation, pose_deviation, average_point_distance(points)
    return {
        (name, mass): bool(belief.credible_region(mass, measure).contains(scene.truth))
        for name, measure in zip(REGIONS, measures, strict=True)
        for mass in MASSES
    }


def default_run(
    recording: Recording, particles: int, seed: int, scene: Any = None, start: Step | None = None
) -> Iterator[Step]:
    """The default inference, from the beginning or resumed from a step."""
    return infer(model, recording, particles=particles, seed=seed, scene=scene, start=start)


def probed(
    seed: int,
    particles: int = PARTICLES,
    bench: BenchParameters | None = None,
    inference_seed: int | None = None,
) -> Probed:
    """One scene, whatever happens: an exception makes it a miss, and what was reached before it is kept."""
    return followed(seed, particles, bench, inference_seed)[0]


def probed_from(seeds: tuple[int, int | None], particles: int = PARTICLES) -> Probed:
    """As `probed`, of a scene's seed and one of inference, which is the scene's where it is None."""
    return probed(seeds[0], particles, inference_seed=seeds[1])


def followed(
    seed: int,
    particles: int = PARTICLES,
    bench: BenchParameters | None = None,
    inference_seed: int | None = None,
) -> tuple[Probed, list[Step], Recording | None]:
    """As `probed`, with all steps and the recording of the probe, None where it was not reached."""
    found, steps, recording = Probed(seed, inference_seed=inference_seed), list[Step](), None
    chosen = seed if inference_seed is None else inference_seed
    try:
        scene = bench_scene(seed, bench)
        found.part, found.clearance = scene.kind.name, round(1e3 * scene.clearance, 6)
        look = scene.look()
        with timed(found.seconds, "vision"):
            for step in waited(default_run(look, particles, chosen), found.waits):
                steps.append(step)
        with timed(found.seconds, "planning"):
            plan = three_two_one(steps[-1].belief, scene.part, scene.peg)
        recording = scene.probe(plan)
        with timed(found.seconds, "touch"):
            for step in waited(default_run(recording, particles, chosen, start=steps[-1]), found.waits):
                steps.append(step)
    except Exception as error:
        found.missed = one_line(error)
    try:
        if steps:
            judge(found, steps, scene)
    except Exception as error:
        found.missed = found.missed or one_line(error)
    return found, steps, recording


def waited(steps: Iterator[Step], waits: dict[str, list[float]]) -> Iterator[Step]:
    """The steps; adds to `waits` how long each took, by kind."""
    begun = time.perf_counter()
    for step in steps:
        waits.setdefault(step.info.label.split()[0], []).append(time.perf_counter() - begun)
        yield step
        begun = time.perf_counter()


def judge(found: Probed, steps: Sequence[Step], scene: BenchScene) -> None:
    """Puts down how far off the beliefs of a run were, prior first, and what they cost."""
    points = scene.part.surface_points()
    for step in steps:
        found.curve.times.append(step.info.time)
        found.curve.adds.append(1e3 * step.belief.weighted_add(points, scene.truth))
        found.curve.kinds.append(step.info.label.split()[0])
        for name, effort in step.info.effort.items():
            seconds, items = found.efforts.get(name, (0.0, 0))
            found.efforts[name] = seconds + effort.seconds, items + effort.items
    found.tempered = sum(len(step.info.exponents) > 1 for step in steps)
    for name, step in moments_among(steps, complete=not found.missed).items():
        found.moments[name] = moment_of(step.belief, scene)
        if name in (VISION, END):
            found.holds[name] = regions_of(step.belief, scene)
    checks = PredictiveChecks()
    marked = [checks.cell(step).endswith(MARK) for step in steps]
    found.warned = any(marked) or bool(checks.warnings(steps[-1], model.pose))
    found.memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (
        1e6 if sys.platform != "darwin" else 1e9
    )


def moments_among(steps: Sequence[Step], complete: bool = True) -> dict[str, Step]:
    """After the last view, and the last step at or before each of the times that a run got to."""
    views = [step for step in steps if step.info.label.startswith("view")]
    windows = [step for step in steps if not math.isnan(step.info.time)]
    found = {VISION: views[-1]} if len(views) == 2 else {}
    for name, moment in TIMES.items():
        past = [step for step in windows if step.info.time <= moment + 1e-6]
        # A stamp or two: a window ends with its last stamp, just before its time is over.
        if past and (complete or windows[-1].info.time >= moment - 0.02):
            found[name] = past[-1]
    return found


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Adds the wall time of a block to a table, also where it raises."""
    begun = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - begun


def every(
    function: Callable[[Task], Value], tasks: Sequence[Task], jobs: int, lost: Callable[[Task, str], Value]
) -> Iterator[Value]:
    """The results as they come; a process that dies takes no other scene with it.

    Args:
        function: of a task, such as a scene's seed.
        tasks: all of them.
        jobs: how many at a time; with one everything stays in this process, with all its threads.
        lost: the result of a task whose process died, and why.
    """
    for task, result in as_they_end(function, tasks, jobs):
        yield lost(task, result.reason) if isinstance(result, Failure) else result


def apart(function: Callable[..., Value], *arguments: Any) -> Value:
    """A function's result in a process of its own with all its threads, so that its memory is its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def quantile(values: Sequence[float] | Array, level: float) -> float:
    """Of values some of which may be infinite, as misses are."""
    ordered = np.sort(np.asarray(values, dtype=float))
    if not len(ordered):
        return math.nan
    place = level * (len(ordered) - 1)
    low, high = ordered[math.floor(place)], ordered[math.ceil(place)]
    return float(low if low == high else low + (place - math.floor(place)) * (high - low))


def by(found: Sequence[Probed], key: Callable[[Probed], Any]) -> Mapping[Any, list[Probed]]:
    """Scenes in groups, in order of their keys."""
    keys = sorted({key(one) for one in found})
    return {k: [one for one in found if key(one) == k] for k in keys}

"""The belief, and an insertion by it, on a bench with the errors of a real one, each alone and all together.

A scene is seen, touched by a fixed probe that rocks (`ROCKED`), and explained under the profile of a bench.
Two poses are asked for: the part's in the world, as it was before any touch, and the part's as seen from the
held peg with its tip at the hole, which is what an insertion needs. Beside each error stands the least that
could be expected (a Bayesian Cramer-Rao bound): touches linear about the true pose, the model's priors of
what the bench shares, and the spread that images left, without any search. `--profile perfect` is the model
without shared errors. With `--inference-seeds` the recording of a scene is explained with several seeds. With
`--file` results are written as they are done, and a later call adds the missing ones.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from report import Row, finish, options, show
from scenes import PARTICLES, default_run, quantile
from scipy.stats import binomtest
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief, average_distance
from bcppl.beliefs.regions import rotation_deviation, translation_deviation
from bcppl.cli.predictive_checks import PredictiveChecks
from bcppl.distributions.episodes.rows import COLUMNS
from bcppl.inference.planning.insertion import insertion_plan
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.metrology_parameters import ROCKED
from bcppl.models.look_and_touch import model
from bcppl.models.worlds.bench.errors import FAULTS, BenchErrors
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.sensors.likelihoods.bench_profiles import PROFILES
from bcppl.sensors.measurements import Recording
from bcppl.sensors.probe import ProbeWindow
from bcppl.sweeps import one_line, swept

NAMES = ("none", *FAULTS, "real")
MASSES = (0.5, 0.9)
WITHIN = {0.5: (37.0, 63.0), 0.9: (82.0, 97.0)}  # %, the 99 % binomial interval of 100 scenes
LEAST = 80.0  # %, of 90 % regions where errors are twice as large as the profile takes them to be
# mm of the relative ADD: median, 90 %.
GOALS: dict[str, tuple[float, float | None]] = {"real": (0.3, None), "none": (0.15, 0.6)}
OTHERS = (0.2, 0.6)
TIGHT = 0.0001  # m, the clearance of which the benchmark has a goal of its own
DRAWS = 400  # displacements by which a bound's mean distance is estimated


class Task(NamedTuple):
    """One scene with errors, the profile that explains it, and a seed of inference if not the scene's."""

    seed: int
    fault: str
    scale: float
    profile: str
    inference: int | None = None


class Pose(NamedTuple):
    """How far off a belief about a pose is.

    Attributes:
        add: of its mean over the part's points, mm.
        bound: the least mean of that, mm.
        translation, rotation: mm and degrees.
        holds: by mass, whether the regions of translation and of rotation hold the truth.
    """

    add: float
    bound: float
    translation: float
    rotation: float
    holds: tuple[tuple[bool, bool], ...]


MISSED = Pose(math.inf, math.nan, math.inf, math.inf, ((False, False), (False, False)))


class Outcome(NamedTuple):
    """What came of a task.

    Attributes:
        world, relative: of the two poses.
        inserted: whether one attempt ended in the hole; `peak` is its largest force, N.
        warnings: of the belief.
        seconds: of vision and touch.
        missed: why it did not get there; empty where it did.
    """

    world: Pose
    relative: Pose
    inserted: bool
    peak: float
    warnings: list[str]
    seconds: float
    missed: str = ""


def outcome(task: Task) -> Outcome:
    """The outcome of a task, whatever happens."""
    try:
        return followed(task)
    except Exception as error:  # one scene that fails is one result, not the end of the benchmark
        return Outcome(MISSED, MISSED, False, math.nan, [], math.nan, one_line(error))


def followed(task: Task) -> Outcome:
    """One scene from its images to an attempt of insertion."""
    scene = bench_scene(task.seed, BenchParameters(errors=BenchErrors.only(task.fault, task.scale)))
    begun = time.perf_counter()
    *_, seen = default_run(scene.look(), PARTICLES, task.seed)
    seconds = time.perf_counter() - begun
    recording = scene.probe(three_two_one(seen.belief, scene.part, scene.peg, ROCKED))
    seed = task.seed if task.inference is None else task.inference
    if seed != task.seed:
        *_, seen = default_run(scene.look(), PARTICLES, seed)
    begun = time.perf_counter()
    prepared = model.prepare(recording, profile=task.profile)
    steps = list(default_run(recording, PARTICLES, seed, scene=prepared, start=seen))
    seconds += time.perf_counter() - begun
    belief = steps[-1].belief
    plan = insertion_plan(belief, scene.part, scene.peg)
    world_from_peg = torch.from_numpy(plan.push.world_from_peg[0])
    bound = bounds(scene, recording, task.profile, seen.belief, world_from_peg)
    checks = PredictiveChecks()
    for step in [seen, *steps]:
        checks.cell(step)
    warnings = checks.warnings(steps[-1], model.pose)
    apparent = torch.from_numpy(scene.apparent(world_from_peg.numpy()))
    world = judged(belief, torch.from_numpy(scene.truth), scene, bound[0])
    relative = judged(belief.relative(world_from_peg), apparent, scene, bound[1])
    result = scene.insert(plan)
    return Outcome(world, relative, bool(result.inserted), float(result.peak_force), warnings, seconds)


def judged(belief: Belief, truth: Tensor, scene: BenchScene, bound: float) -> Pose:
    """How far off a belief is from a true pose (7,)."""
    off = poses.local(truth, belief.mean)
    points = scene.part.surface_points()
    return Pose(
        1e3 * float(average_distance(belief.mean, points, truth)),
        bound,
        1e3 * float(off[:3].norm()),
        math.degrees(float(off[3:].norm())),
        tuple(
            (
                bool(belief.credible_region(mass, translation_deviation).contains(truth)),
                bool(belief.credible_region(mass, rotation_deviation).contains(truth)),
            )
            for mass in MASSES
        ),
    )


def bounds(
    scene: BenchScene, recording: Recording, profile: str, seen: Belief, world_from_peg: Tensor
) -> tuple[float, float]:
    """The least mean ADD, mm, of the pose in the world and of that as seen from the peg at a pose (7,)."""
    prepared = model.prepare(recording, profile=profile)
    truth = torch.from_numpy(scene.truth)
    touched = [
        value for address, value in prepared.observed(recording.measurements).items() if "touch" in address
    ]
    window = next(m.action for m in reversed(recording.measurements) if isinstance(m.action, ProbeWindow))
    site = prepared.likelihoods["window"].site(window, truth[None])
    covariance = site.joint_covariance(touched[-1])[0]
    # The images' belief is an observation of the pose, the first six coordinates.
    gain = torch.linalg.solve(covariance[:6, :6] + seen.covariance, covariance[:6]).T
    covariance = covariance - gain @ covariance[:6]
    points = torch.from_numpy(scene.part.surface_points())
    at = poses.transform(truth, points)
    row = torch.zeros(1, COLUMNS, dtype=torch.float64)
    row[0, :7] = world_from_peg
    of_part = displacements(truth, at, along_world=True)
    of_peg = displacements(world_from_peg, at) @ site.bench.effect(row).twist[0]
    of_world = torch.cat([of_part, torch.zeros_like(of_peg)], dim=-1)
    return least(of_world, covariance), least(torch.cat([of_part, -of_peg], dim=-1), covariance)


def displacements(pose: Tensor, points: Tensor, *, along_world: bool = False) -> Tensor:
    """How points (K, 3) of the world move (K, 3, 6) with a body at a pose (7,), by a unit of its twist.

    The twist is along and about the body's axes; or, as of `poses.retract`, along the world's.
    """
    axes = poses.rotation_matrix(pose)
    arm = points - pose[:3]
    turned = torch.linalg.cross(axes.T.expand(len(points), 3, 3), arm[:, None].expand(-1, 3, 3), dim=-1)
    shifted = torch.eye(3, dtype=torch.float64) if along_world else axes
    return torch.cat([shifted.expand(len(points), 3, 3), turned.transpose(-1, -2)], dim=-1)


def least(of_points: Tensor, covariance: Tensor) -> float:
    """The mean, mm, of the points' mean displacement, by normal parameters with a covariance."""
    values, axes = torch.linalg.eigh(covariance)
    standard = torch.randn(
        DRAWS, len(values), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    drawn = standard @ (axes * values.clamp(min=0.0).sqrt()).T
    return 1e3 * float(torch.einsum("kij,dj->dki", of_points, drawn).norm(dim=-1).mean())


def coverage(several: Sequence[Pose], region: int, mass: int) -> float:
    """The share, %, of poses whose region of a mass holds the truth: both by their places in `Pose.holds`."""
    return 100.0 * float(np.mean([pose.holds[mass][region] for pose in several]))


def line(name: str, several: Sequence[Pose]) -> list[Any]:
    """A group's line of the table of one of the two poses."""
    return [
        name,
        len(several),
        *[quantile([pose.add for pose in several], level) for level in (0.5, 0.9, 1.0)],
        float(np.nanmedian([pose.bound for pose in several])),
        float(np.nanmedian([pose.add / pose.bound for pose in several])),
        float(np.median([pose.translation for pose in several])),
        float(np.median([pose.rotation for pose in several])),
        *[f"{coverage(several, r, 0):.0f} / {coverage(several, r, 1):.0f}" for r in range(2)],
    ]


def rows_of(name: str, task: Task, several: Sequence[Outcome], clearances: Sequence[float]) -> list[Row]:
    """The figures of a group and their goals, given the clearance (m) of each scene."""
    rows: list[Row] = []
    median, ninth = GOALS.get(task.fault, OTHERS)
    tight = [one for one, clearance in zip(several, clearances, strict=True) if clearance <= TIGHT]
    for which in ("world", "relative"):
        there: list[Pose] = [getattr(one, which) for one in several]
        for r, region in enumerate(("translation", "rotation")):
            for k, mass in enumerate(MASSES):
                share = coverage(there, r, k)
                label = f"{name}: {100 * mass:.0f} % region of the {which} {region} holds the truth"
                low, high = WITHIN[mass] if task.scale <= 1.0 else (LEAST if mass == 0.9 else 0.0, 100.0)
                rows += [
                    Row(label, share, "%", low, "min"),
                    Row(f"{label}, at most", share, "%", high, "max"),
                ]
        adds = [pose.add for pose in there]
        goals = (median, ninth) if which == "relative" and task.scale <= 1.0 else (None, None)
        rows.append(Row(f"{name}: {which} ADD, median", quantile(adds, 0.5), "mm", goals[0]))
        rows.append(Row(f"{name}: {which} ADD, 90 %", quantile(adds, 0.9), "mm", goals[1]))
        ratio = float(np.nanmedian([pose.add / pose.bound for pose in there]))
        goal = 1.3 if which == "world" and task.scale <= 1.0 else None
        rows.append(Row(f"{name}: {which} ADD over its bound, median", ratio, "", goal))
    for which, goal, among in (("inserted", 95.0, several), (f"inserted at {1e3 * TIGHT:g} mm", 90.0, tight)):
        if among:
            count = sum(one.inserted for one in among)
            interval = binomtest(count, len(among)).proportion_ci(0.95)
            asked = goal if task.fault == "real" else None
            rows += [
                Row(f"{name}: {which}", 100.0 * count / len(among), "%", asked, "min"),
                Row(f"{name}: {which}, lower end", 100.0 * interval.low, "%", None, "min"),
                Row(f"{name}: {which}, upper end", 100.0 * interval.high, "%", None, "min"),
            ]
    rows += [
        Row(f"{name}: largest force, median", quantile([one.peak for one in several], 0.5), "N"),
        Row(f"{name}: with a warning", 100.0 * float(np.mean([bool(o.warnings) for o in several])), "%"),
        Row(f"{name}: vision and touch, median", quantile([one.seconds for one in several], 0.5), "s"),
    ]
    return rows


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--fault", nargs="+", choices=NAMES, default=list(NAMES), help="errors by name")
    parser.add_argument("--scale", nargs="+", type=float, default=[1.0], help="of their sizes")
    parser.add_argument("--scenes", type=int, default=100, help="of each")
    parser.add_argument("--profile", nargs="+", choices=PROFILES, default=["ur5e"])
    parser.add_argument(
        "--inference-seeds",
        type=int,
        default=1,
        metavar="K",
        help="explain every recording with K seeds: its scene's own, then 1 to K - 1",
    )
    parser.add_argument("--jobs", type=int, default=1, help="scenes at a time, of one thread each")
    parser.add_argument("--file", type=Path, help="where the outcome of each scene is kept")
    arguments = parser.parse_args()
    count = 1 if arguments.quick else arguments.scenes
    groups = [(f, s, p) for f in arguments.fault for s in arguments.scale for p in arguments.profile]
    seeds = range(arguments.seed, arguments.seed + count)
    inferences = [None, *range(1, arguments.inference_seeds)]
    tasks = [Task(seed, *group, other) for seed in seeds for group in groups for other in inferences]
    outcomes: dict[Task, Outcome] = {}
    for task, (world, relative, *others) in swept(outcome, tasks, file=arguments.file, jobs=arguments.jobs):
        one = outcomes[task] = Outcome(Pose(*world), Pose(*relative), *others)
        print(*task, summary(one), flush=True)
    lines, rows = [], []
    clearances = [bench_scene(seed).clearance for seed in seeds for _ in inferences]
    for group in groups:
        name = f"{group[0]} x {group[1]:g}, {group[2]}"
        several = [outcomes[Task(seed, *group, other)] for seed in seeds for other in inferences]
        lines.append(line(f"world, {name}", [one.world for one in several]))
        lines.append(line(f"relative, {name}", [one.relative for one in several]))
        rows += rows_of(name, Task(0, *group), several, clearances)
    columns = ["", "runs", "ADD mm", "90 %", "worst", "bound", "ratio", "translation", "rotation"]
    show("50 and 90 % regions that hold the truth, %", [*columns, "translation", "rotation"], lines)
    finish(rows, arguments.json)


def summary(one: Outcome) -> str:
    """An outcome in one line."""
    if one.missed:
        return one.missed
    both = [f"{pose.add:.2f} ({pose.bound:.2f})" for pose in (one.world, one.relative)]
    ended = "in" if one.inserted else "NOT in"
    return f"world {both[0]}, relative {both[1]} mm, {ended}, {' | '.join(one.warnings)[:100]}"


if __name__ == "__main__":
    main()

"""How accurate and how honest the belief is when something happens that the model does not have.

A scene of the foreign world is seen and pressed at seven places with a mechanism of `foreign.mechanisms`, and
explained under the profile of a bench. Two poses are asked for: the part's in the world, as it was before any
touch, and the part's as seen from the held peg where an insertion would start after all touches. Deviations
are in standard deviations of the belief, by its covariance. With `--file` results are written as they are
done, and a later call adds the missing ones.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from foreign.mechanisms import MECHANISMS, made
from foreign.world import scene_of
from report import Row, finish, options, show
from scenes import PARTICLES, default_run, quantile
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.beliefs.regions import rotation_deviation, translation_deviation
from bcppl.cli.predictive_checks import PredictiveChecks
from bcppl.models.look_and_touch import model
from bcppl.sensors.likelihoods.bench_profiles import PROFILES
from bcppl.sweeps import one_line, swept

MASSES = (0.5, 0.9)
REGIONS = {"translation": translation_deviation, "rotation": rotation_deviation}
AXES = {"translation": slice(0, 3), "rotation": slice(3, 6)}
UNITS = {"translation": "mm", "rotation": "deg"}
POSES = ("world", "relative")


class Task(NamedTuple):
    """One scene with a mechanism, and the profile that explains it."""

    seed: int
    mechanism: str
    profile: str


class Pose(NamedTuple):
    """How far off a belief about a pose is; all are of translation, then of rotation.

    Attributes:
        errors: of its mean, mm and degrees.
        deviations: of its mean, in standard deviations along the error: of three coordinates.
        holds: by mass, whether the region holds the truth.
    """

    errors: tuple[float, float]
    deviations: tuple[float, float]
    holds: tuple[tuple[bool, bool], tuple[bool, bool]]


MISSED = Pose((math.inf, math.inf), (math.inf, math.inf), ((False, False), (False, False)))


class Outcome(NamedTuple):
    """What came of a task.

    Attributes:
        world, relative: of the two poses.
        warnings: of the belief and of its making.
        seconds: of vision and touch.
        missed: why it did not get there; empty where it did.
    """

    world: Pose
    relative: Pose
    warnings: list[str]
    seconds: float
    missed: str = ""


def outcome(task: Task) -> Outcome:
    """The outcome of a task, whatever happens."""
    try:
        return followed(task)
    except Exception as error:  # one scene that fails is one result, not the end of the benchmark
        return Outcome(MISSED, MISSED, [], math.nan, one_line(error))


def followed(task: Task) -> Outcome:
    """One scene from its images to the belief after the last press."""
    true = made(scene_of(task.seed), task.mechanism)
    begun = time.perf_counter()
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always", RuntimeWarning)
        prepared = model.prepare(true.recording, profile=task.profile)
        steps = list(default_run(true.recording, PARTICLES, task.seed, scene=prepared))
    seconds = time.perf_counter() - begun
    belief, checks = steps[-1].belief, PredictiveChecks()
    for step in steps:
        checks.cell(step)
    reasons = checks.warnings(steps[-1], model.pose)
    reasons += [str(one.message) for one in given if issubclass(one.category, RuntimeWarning)]
    world = judged(belief, torch.from_numpy(true.recording.truth))
    relative = judged(belief.relative(true.world_from_peg), torch.from_numpy(true.apparent))
    return Outcome(world, relative, reasons, seconds)


def judged(belief: Belief, truth: Tensor) -> Pose:
    """How far off a belief is from a true pose (7,)."""
    off, covariance = poses.local(belief.mean, truth), belief.covariance
    errors, deviations = [], []
    for axes in AXES.values():
        precision = torch.linalg.pinv(covariance[axes, axes], rcond=1e-10, hermitian=True)
        errors.append(float(off[axes].norm()))
        deviations.append(float((off[axes] @ precision @ off[axes]).sqrt()))
    holds = [
        tuple(bool(belief.credible_region(mass, region).contains(truth)) for mass in MASSES)
        for region in REGIONS.values()
    ]
    return Pose((1e3 * errors[0], math.degrees(errors[1])), tuple(deviations), tuple(holds))


def coverage(several: Sequence[Pose], region: int, mass: int) -> float:
    """The share, %, of poses whose region of a mass holds the truth: both by their places in `Pose.holds`."""
    return 100.0 * float(np.mean([pose.holds[region][mass] for pose in several]))


def line(name: str, several: Sequence[Outcome], which: str) -> list[Any]:
    """A group's line of the table of one of the two poses."""
    there: list[Pose] = [getattr(one, which) for one in several]
    return [
        f"{which}, {name}",
        len(several),
        *[f"{coverage(there, r, 0):.0f} / {coverage(there, r, 1):.0f}" for r in range(2)],
        *[quantile([pose.errors[r] for pose in there], 0.5) for r in range(2)],
        *[max(pose.deviations[r] for pose in there) for r in range(2)],
        sum(bool(one.warnings) for one in several),
        quantile([one.seconds for one in several if not one.missed], 0.5),
    ]


def rows_of(name: str, several: Sequence[Outcome]) -> list[Row]:
    """The figures of a group."""
    rows: list[Row] = []
    for which in POSES:
        there: list[Pose] = [getattr(one, which) for one in several]
        for r, (region, unit) in enumerate(UNITS.items()):
            for k, mass in enumerate(MASSES):
                label = f"{name}: {100 * mass:.0f} % region of the {which} {region} holds the truth"
                rows.append(Row(label, coverage(there, r, k), "%"))
            error = quantile([pose.errors[r] for pose in there], 0.5)
            worst = max(pose.deviations[r] for pose in there)
            rows.append(Row(f"{name}: {which} {region}, median error", error, unit))
            rows.append(Row(f"{name}: {which} {region}, worst deviation", worst, "standard deviations"))
    seconds = quantile([one.seconds for one in several if not one.missed], 0.5)
    warned = 100.0 * float(np.mean([bool(one.warnings) for one in several]))
    rows.append(Row(f"{name}: with a warning", warned, "%"))
    rows.append(Row(f"{name}: vision and touch, median", seconds, "s"))
    return [row._replace(value=math.nan) if math.isinf(row.value) else row for row in rows]


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument(
        "--mechanism", nargs="+", choices=MECHANISMS, default=list(MECHANISMS), help="by name"
    )
    parser.add_argument("--scenes", type=int, default=20, help="of each")
    parser.add_argument("--profile", choices=PROFILES, default="ur5e")
    parser.add_argument("--jobs", type=int, default=1, help="scenes at a time, of one thread each")
    parser.add_argument("--file", type=Path, help="where the outcome of each scene is kept")
    arguments = parser.parse_args()
    count = 1 if arguments.quick else arguments.scenes
    seeds = range(arguments.seed, arguments.seed + count)
    tasks = [Task(seed, name, arguments.profile) for seed in seeds for name in arguments.mechanism]
    outcomes: dict[str, list[Outcome]] = {name: [] for name in arguments.mechanism}
    for task, (world, relative, *others) in swept(outcome, tasks, file=arguments.file, jobs=arguments.jobs):
        one = Outcome(Pose(*world), Pose(*relative), *others)
        outcomes[task.mechanism].append(one)
        print(*task, summary(one), flush=True)
    lines = [line(name, several, which) for name, several in outcomes.items() for which in POSES]
    columns = [
        "50 / 90 % hold, translation",
        "rotation",
        "median mm",
        "deg",
        "worst deviation",
        "of rotation",
    ]
    show("beliefs with something unmodelled", ["", "runs", *columns, "warned", "s"], lines)
    finish([row for name, several in outcomes.items() for row in rows_of(name, several)], arguments.json)


def summary(one: Outcome) -> str:
    """An outcome in one line."""
    if one.missed:
        return one.missed
    both = [
        f"{which} {pose.errors[0]:.2f} mm {pose.errors[1]:.2f} deg ({pose.deviations[0]:.1f}, "
        f"{pose.deviations[1]:.1f} deviations)"
        for which, pose in (("world", one.world), ("relative", one.relative))
    ]
    return f"{', '.join(both)}, {one.seconds:.0f} s, {' | '.join(one.warnings)[:100]}"


if __name__ == "__main__":
    main()

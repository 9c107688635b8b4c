"""One insertion attempt in each scene: by vision alone, after the fixed probe, and after chosen ones.

Chosen probes are those from which bcppl expects most, one after another, as many as 6 s hold.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from report import Row, cores, finish, options, show
from rich.console import Console
from scenes import PARTICLES, default_run, every, model
from scipy.stats import binomtest

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.contact.physics import PegPhysics
from bcppl.geometry.gap import PegGap
from bcppl.inference.design.loop import probing_loop
from bcppl.inference.design.rules import by_linearised_gain
from bcppl.inference.filters.smc import Step
from bcppl.inference.planning.candidate_layout import MIXED, plan_candidates
from bcppl.inference.planning.insertion import insertion_plan
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.success import success_probability
from bcppl.models.worlds.bench.arm import BenchArm
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.sensors.candidates import Candidate
from bcppl.sweeps import one_line

CLEARANCES = BenchParameters().clearances
VISION, FIXED, CHOSEN = "vision", "3-2-1 probe", "chosen probes"
KNOWN = (VISION, FIXED, CHOSEN)
SECONDS, PROBES = 6.0, 6  # that probes may last altogether, and their number
OUTER_SAMPLES = 25
CONFIDENCE = 0.95
OVERALL, TIGHTEST = 0.97, 0.94  # shares that are to succeed
CHANCES = 12  # particles by which the chance of an attempt is predicted


class Task(NamedTuple):
    """One scene at one clearance (m), what is known, and whether the chance of attempts is predicted."""

    seed: int
    clearance: float
    known: tuple[str, ...]
    predict: bool


class Outcome(NamedTuple):
    """One attempt: what it came to, and how far off the belief's mean was.

    Attributes:
        seed, clearance, name, known: the scene and what was known; metres.
        inserted, found: whether it ended in the hole; whether the search found it.
        depth, across, tilt: metres and radians; of the tip, and of the mean across the hole and of its axis.
        peak, press: N; the largest force at a sample, and at two in a row.
        time: s.
        chance: predicted; NaN unless asked for.
        failed: what went wrong before the attempt, in words; it counts as not inserted.
    """

    seed: int
    clearance: float
    name: str
    known: str
    inserted: bool = False
    found: bool = False
    depth: float = math.nan
    across: float = math.nan
    tilt: float = math.nan
    peak: float = math.nan
    press: float = math.nan
    time: float = math.nan
    chance: float = math.nan
    failed: str = ""


def attempts(task: Task) -> list[Outcome]:
    """The scene's attempts, one for each of what is known."""
    scene = bench_scene(task.seed, clearance=task.clearance)
    outcomes: list[Outcome] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        look = scene.look()
        seen = None
        for known in task.known:
            try:
                if seen is None:
                    *_, seen = default_run(look, PARTICLES, task.seed)
                arm = BenchArm(scene)
                if known == FIXED:
                    recording = scene.probe(three_two_one(seen.belief, scene.part, scene.peg))
                    *_, last = default_run(recording, PARTICLES, task.seed, start=seen)
                else:
                    last = seen if known == VISION else _probed(scene, arm, seen)
                outcomes.append(_attempt(scene, arm, last.belief, known, task.predict))
            except Exception as error:  # one scene must not take the others with it
                outcomes.append(Outcome(task.seed, task.clearance, scene.name, known, failed=one_line(error)))
    return outcomes


def _probed(scene: BenchScene, arm: BenchArm, seen: Step) -> Step:
    """Where chosen probes lead to."""
    gap, last = PegGap(scene.part, scene.peg), seen

    def asked(belief: Belief, number: int) -> Sequence[Candidate]:
        return plan_candidates(belief, scene.part, scene.peg, MIXED, gap=gap, seed=number)

    rank = by_linearised_gain(model.pose, outer_samples=OUTER_SAMPLES, seed=scene.seed)
    for made in probing_loop(
        model, scene.look(), arm, asked, rank, start=seen, probes=PROBES, seconds=SECONDS
    ):
        last = made.step
    return last


def _attempt(scene: BenchScene, arm: BenchArm, belief: Belief, known: str, predict: bool) -> Outcome:
    plan = insertion_plan(belief, scene.part, scene.peg)
    result = arm.insert(plan)
    chance = math.nan
    if predict:
        physics = PegPhysics(scene.part, scene.peg)
        chance = success_probability(belief, plan, physics, particles=CHANCES, seed=scene.seed).success
    hole = torch.from_numpy(scene.kind.part_from_hole)
    world_from_hole = poses.compose(torch.from_numpy(scene.truth), hole)
    off = poses.compose(poses.inverse(world_from_hole), poses.compose(belief.mean, hole))
    tilt = math.acos(min(1.0, float(poses.rotation_matrix(off)[2, 2])))
    return Outcome(
        seed=scene.seed,
        clearance=scene.clearance,
        name=scene.name,
        known=known,
        inserted=result.inserted,
        found=math.isfinite(result.found_at),
        depth=result.depth,
        across=float(off[:2].norm()),
        tilt=tilt,
        peak=result.peak_force,
        press=result.sustained_force,
        time=result.time,
        chance=chance,
    )


def lost(task: Task, why: str) -> list[Outcome]:
    """A scene whose process died."""
    return [Outcome(task.seed, task.clearance, "-", known, failed=why) for known in task.known]


def as_they_come(tasks: Sequence[Task], jobs: int) -> Iterator[Outcome]:
    """Every attempt, reported; an interrupted run keeps what is there."""
    console = Console(stderr=True, highlight=False)
    try:
        for k, made in enumerate(every(attempts, tasks, jobs, lost)):
            summary = "; ".join(f"{o.known} {'in' if o.inserted else o.failed or 'not in'}" for o in made)
            scene = f"{made[0].seed}, {1e3 * made[0].clearance:g} mm"
            console.print(f"{k + 1} of {len(tasks)}, scene {scene}: {summary}", soft_wrap=True, markup=False)
            yield from made
    except KeyboardInterrupt:
        console.print("stopped: what follows is of the scenes so far.")


def rate(outcomes: Sequence[Outcome]) -> tuple[float, float, float]:
    """The share that succeeded and its exact interval (Clopper and Pearson)."""
    test = binomtest(sum(o.inserted for o in outcomes), len(outcomes))
    interval = test.proportion_ci(CONFIDENCE)
    return float(test.statistic), float(interval.low), float(interval.high)


def _line(label: str, outcomes: Sequence[Outcome]) -> list[str | float]:
    share, low, high = rate(outcomes)

    def at(values: Sequence[float], quantile: float) -> float:
        finite = [value for value in values if math.isfinite(value)]
        return float(np.quantile(finite, quantile)) if finite else math.nan

    across, tilt = [1e3 * o.across for o in outcomes], [math.degrees(o.tilt) for o in outcomes]
    return [
        label,
        len(outcomes),
        f"{100 * share:.1f} ({100 * low:.0f} to {100 * high:.0f})",
        100.0 * sum(o.found for o in outcomes) / len(outcomes),
        at(across, 0.5),
        at(across, 0.9),
        at(tilt, 0.5),
        at([o.press for o in outcomes], 0.5),
        at([o.press for o in outcomes], 0.9),
        at([o.peak for o in outcomes], 0.5),
        at([o.peak for o in outcomes], 1.0),
        at([o.time for o in outcomes], 0.5),
        float(np.nanmean([o.chance for o in outcomes])) * 100.0
        if any(math.isfinite(o.chance) for o in outcomes)
        else math.nan,
    ]


COLUMNS = (
    "",
    "attempts",
    f"in, % ({100 * CONFIDENCE:.0f} % interval)",
    "found %",
    "across mm",
    "90 %",
    "tilt deg",
    "press N",
    "90 %",
    "peak N",
    "most",
    "s",
    "predicted %",
)


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, default=100, help="at each clearance")
    parser.add_argument("--jobs", type=int, default=cores(), help="scenes at a time")
    parser.add_argument("--known", nargs="+", choices=KNOWN, default=list(KNOWN))
    all_mm = [round(1e3 * clearance, 3) for clearance in CLEARANCES]
    parser.add_argument("--clearances", nargs="+", type=float, choices=all_mm, default=all_mm, help="in mm")
    parser.add_argument("--predict", action="store_true", help="compute the chance of each attempt as well")
    arguments = parser.parse_args()
    count = 2 if arguments.quick else arguments.scenes
    seeds = range(arguments.seed, arguments.seed + count)
    known = tuple(arguments.known)
    clearances = [m for m, mm in zip(CLEARANCES, all_mm, strict=True) if mm in arguments.clearances]
    # Clearances in turn: a run that is stopped has as many scenes of each.
    tasks = [Task(seed, clearance, known, arguments.predict) for seed in seeds for clearance in clearances]
    outcomes = sorted(as_they_come(tasks, arguments.jobs), key=lambda o: (o.clearance, o.seed))
    lines, rows = [], []
    for what in known:
        mine = [o for o in outcomes if o.known == what]
        for clearance in (*clearances, None):
            some = [o for o in mine if clearance in (None, o.clearance)]
            if not some:
                continue
            where = "all" if clearance is None else f"{1e3 * clearance:g} mm"
            lines.append(_line(f"{what}, {where}", some))
            share, low, high = rate(some)
            goal = None
            if what != VISION:
                goal = TIGHTEST if clearance == min(CLEARANCES) else None
                if clearance is None and len(clearances) == len(CLEARANCES):
                    goal = OVERALL
            rows += [
                Row(f"inserted, {what}, {where}", share, "share", goal, "min"),
                Row(f"inserted, {what}, {where}, lower end", low, "share", None, "min"),
                Row(f"inserted, {what}, {where}, upper end", high, "share", None, "min"),
                Row(f"force held for two samples, {what}, {where}, median", float(lines[-1][7]), "N"),
                Row(f"peak force, {what}, {where}, median", float(lines[-1][9]), "N"),
            ]
    show(f"one attempt each, scenes {seeds[0]} to {seeds[-1]} at each clearance", COLUMNS, lines)
    missed = [o for o in outcomes if not o.inserted and o.known != VISION]
    for o in missed:
        why = o.failed or f"depth {1e3 * o.depth:.1f} mm, {'found' if o.found else 'hole not found'}"
        print(
            f"not in, {o.known}: scene {o.seed}, {o.name}: {why}; off by {1e3 * o.across:.2f} mm, "
            f"{math.degrees(o.tilt):.2f} degrees"
        )
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

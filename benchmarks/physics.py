"""How well contact physics finds a hole: `peg_in_hole` on the accuracy bench, and what its parts give.

A scene is two depth views, then a 6 s probe planned from the belief after vision, as of `accuracy.py`; the
world's friction and stiffness differ from those that inference assumes. Without options: all scenes by the
model as it is, beside the number of the paper (BayesContact: 0.8 mm with 75 particles). `--ways` compares it
with others on the same recordings: less evidence or more of it, other proposals, other physics. `--noise`
gives the measured pose of the peg more noise, and compares geometry alone (`look_and_touch`), physics without
that pose, and both; `--double` does so where a peg touches in two places at once (`double_contacts.py`). With
`--file` results are written as they are done, and a later call adds the missing ones.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import curves
from double_contacts import PLANS, USUAL, recorded_scene
from report import Row, finish, options, show
from scenes import MASSES, PARTICLES, REGIONS, Curve, Probed, quantile, regions_of

from bcppl.inference import bayes_contact, guided_smc, tempered_smc
from bcppl.models import look_and_touch, peg_in_hole
from bcppl.sensors.likelihoods.simulated_probe import CONTACT, ProbeSettings
from bcppl.sweeps import one_line, swept
from bcppl.traces import Model

SCENES, COMPARED = 100, 25
GOALS = (0.8, 0.4)  # mm, of the median at the end
NINTH, HELD, SECONDS = 2.0, 80.0, 15.0  # mm of 90 % of the scenes; % of 90 % regions; s of a scene
NOISE = 0.00005  # m, of the peg's measured position
FRICTION = (0.25, 0.6)
DEFAULT, GEOMETRY, WITHOUT_POSE = "default", "geometry alone", "no pose"
WRENCH = "and the wrench"

Settings = dict[str, Any]
Infer = Callable[..., Any]


class Way(NamedTuple):
    """How a recording is explained: settings of `peg_in_hole`, and the inference program."""

    settings: Settings
    infer: Infer = guided_smc.infer


def with_step(seconds: float) -> Way:
    """Physics with another time step."""
    return Way({"contact": replace(CONTACT, time_step=seconds)})


WAYS = {
    DEFAULT: Way({}),
    "no wrench": Way({"evidence": ("gaps",)}),
    "pose by physics": Way({"evidence": ("contacts", "pose")}),
    WITHOUT_POSE: Way({"evidence": ("contacts", "wrench"), "friction": FRICTION}),
    WRENCH: Way({"evidence": ("gaps", "contacts", "wrench"), "friction": FRICTION}),
    "locations in time": Way({"evidence": ("gaps", "contacts in time")}),
    "no screening": Way({}, partial(guided_smc.infer, screen=False)),
    "no proposals": Way({}, tempered_smc.infer),
    "the paper's filter": Way({}, bayes_contact.infer),
    "steps of 2 ms": with_step(0.002),
    "steps of 1 ms": with_step(0.001),
}


class Task(NamedTuple):
    """A scene, the noise (m) of the peg's measured position, a way of `WAYS` or geometry alone, and a probe.

    The probe is one of `PLANS`, or "3-2-1".
    """

    seed: int
    noise: float
    way: str
    probe: str = USUAL


class Outcome(NamedTuple):
    """What came of a task.

    Attributes:
        vision, end: ADD averaged over the particles by weight, mm.
        holds: whether the regions of `REGIONS` hold the truth, of each by `MASSES`.
        seconds: of inference, and `simulated` those of the rollouts' own clocks.
        times, adds, kinds: of `Curve`.
        missed: why it did not get there; empty where it did.
    """

    vision: float
    end: float
    holds: list[list[bool]]
    seconds: float
    simulated: float
    times: list[float]
    adds: list[float]
    kinds: list[str]
    missed: str = ""


MISSED = Outcome(math.inf, math.inf, [[False] * len(MASSES)] * len(REGIONS), math.nan, math.nan, [], [], [])


def model_of(way: str, noise: float) -> Model:
    """The model of a way where the peg's position is measured with a noise, which is stated to it."""
    if way == GEOMETRY:
        return look_and_touch.model.with_settings(profile="perfect", gap_noise=max(noise, 0.00006))
    settings, own = {"gap_noise": max(noise, 0.00006), **WAYS[way].settings}, ProbeSettings()
    if noise > NOISE:
        # The error of physics is common to stamps that noise is not common to.
        every = own.pose_every // 5
        wider = {
            name: math.hypot(math.sqrt(own.pose_every / every) * getattr(own, name), noise)
            for name in ("normal_scale", "free_scale", "translation_scale")
        }
        settings = {"pose_every": every, **wider, **settings}
    return peg_in_hole.model.with_settings(**settings)


def outcome(task: Task) -> Outcome:
    """The outcome of a task, whatever happens."""
    try:
        return followed(task)
    except Exception as error:  # one scene that fails is one result, not the end of the benchmark
        return MISSED._replace(missed=one_line(error))


def followed(task: Task) -> Outcome:
    """One recording explained in one way."""
    scene, recording = recorded_scene(task.seed, task.noise, task.probe)
    model, infer = model_of(task.way, task.noise), WAYS.get(task.way, WAYS[DEFAULT]).infer
    prepared, curve, vision = model.prepare(recording), Curve([], [], []), math.inf
    begun = time.perf_counter()
    steps = list(infer(model, recording, particles=PARTICLES, seed=task.seed, scene=prepared))
    seconds = time.perf_counter() - begun
    for step in steps:
        curve.times.append(step.info.time)
        curve.adds.append(1e3 * step.belief.weighted_add(scene.part.surface_points(), scene.truth))
        curve.kinds.append(step.info.label.split()[0])
        vision = curve.adds[-1] if curve.kinds[-1] == "view" else vision
    held = regions_of(steps[-1].belief, scene)
    physics = prepared.likelihoods["window"].efforts.get("physics")
    simulated = 0.0 if physics is None else physics.amount
    holds = [[held[region, mass] for mass in MASSES] for region in REGIONS]
    return Outcome(vision, curve.adds[-1], holds, seconds, simulated, *curve)


def line(name: str, several: Sequence[Outcome]) -> list[Any]:
    """A group's line of the table."""
    ends = [one.end for one in several]
    return [
        name,
        len(several),
        sum(bool(one.missed) for one in several),
        quantile([one.vision for one in several], 0.5),
        *[quantile(ends, level) for level in (0.5, 0.9, 0.99, 1.0)],
        *[f"{held(several, r, 0):.0f} / {held(several, r, 1):.0f}" for r in range(len(REGIONS))],
        quantile([one.seconds for one in several], 0.5),
        quantile([one.seconds for one in several], 1.0),
        quantile([one.simulated for one in several], 0.5),
    ]


def held(several: Sequence[Outcome], region: int, mass: int) -> float:
    """The share, %, of outcomes whose region of a mass holds the truth."""
    return 100.0 * sum(one.holds[region][mass] for one in several) / len(several)


def rows_of(name: str, several: Sequence[Outcome], jobs: int, *, asked: bool) -> list[Row]:
    """The figures of a group, with the goals where they are asked of it."""
    ends = [one.end for one in several]
    rows = [
        Row(f"{name}: weighted ADD, median, goal {goal:g} mm", quantile(ends, 0.5), "mm", goal)
        for goal in (GOALS if asked else ())
    ]
    if not asked:
        rows.append(Row(f"{name}: weighted ADD, median", quantile(ends, 0.5), "mm"))
    rows.append(Row(f"{name}: weighted ADD, 90 %", quantile(ends, 0.9), "mm", NINTH if asked else None))
    for r, region in enumerate(REGIONS):
        label = f"{name}: {region}, 90 % region holds the truth"
        rows.append(Row(label, held(several, r, 1), "%", HELD if asked else None, "min"))
    goal = SECONDS if asked and jobs == 1 else None
    rows.append(Row(f"{name}: wall", quantile([one.seconds for one in several], 0.5), "s", goal))
    return rows


def figure(outcomes: dict[Task, Outcome], file: Path) -> None:
    """ADD over time of all scenes by the model as it is, like the paper's figure 3, beside its number."""
    found = [
        Probed(task.seed, curve=Curve(one.times, one.adds, one.kinds), missed=one.missed)
        for task, one in outcomes.items()
        if task.way == DEFAULT
    ]
    curves.of_all(found, (curves.REPORTED,), f"BayesContact: {curves.REPORTED} mm", file)


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, help=f"how many; {SCENES}, {COMPARED} with --ways or --noise")
    ways = [GEOMETRY, *WAYS]
    parser.add_argument("--ways", nargs="*", choices=ways, help="compare these; all if none is named")
    parser.add_argument("--noise", nargs="*", type=float, help="of the peg's position, mm; 0.05, 0.3 and 1")
    parser.add_argument("--double", action="store_true", help="two contacts at once, by geometry and physics")
    parser.add_argument("--jobs", type=int, default=1, help="scenes at a time, of one thread each")
    parser.add_argument("--file", type=Path, help="where the outcome of each scene is kept")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="ADD over time of all scenes")
    arguments = parser.parse_args()
    compared = arguments.ways is not None or arguments.noise is not None or arguments.double
    probes = list(PLANS) if arguments.double else [USUAL]
    count = arguments.scenes or (1 if arguments.quick else COMPARED if compared else SCENES)
    if arguments.noise is not None:
        noises, ways = (
            [1e-3 * n for n in arguments.noise or (0.05, 0.3, 1.0)],
            [GEOMETRY, WITHOUT_POSE, DEFAULT],
        )
    else:
        noises, ways = [NOISE], list(WAYS) if arguments.ways == [] else arguments.ways or [DEFAULT]
    if arguments.double:
        ways = arguments.ways or [GEOMETRY, DEFAULT, WRENCH]
    seeds = range(arguments.seed, arguments.seed + count)
    groups = [(noise, way, probe) for probe in probes for noise in noises for way in ways]
    tasks = [Task(seed, *group) for seed in seeds for group in groups]
    outcomes: dict[Task, Outcome] = {}
    for task, values in swept(outcome, tasks, file=arguments.file, jobs=arguments.jobs):
        one = outcomes[task] = Outcome(*values)
        print(*task, one.missed or f"{one.end:.3f} mm in {one.seconds:.1f} s", flush=True)
    lines, rows = [], []
    for noise, way, probe in groups:
        name = f"{way}, {probe}, noise {1e3 * noise:g} mm"
        several = [outcomes[Task(seed, noise, way, probe)] for seed in seeds]
        lines.append(line(name, several))
        rows += rows_of(name, several, arguments.jobs, asked=way == DEFAULT and not compared)
    columns = ["", "scenes", "missed", "vision mm", "end mm", "90 %", "99 %", "worst", *REGIONS]
    show(
        f"weighted ADD, {PARTICLES} particles; 50 and 90 % regions that hold the truth, %",
        [*columns, "s", "worst", "simulated s"],
        lines,
    )
    if arguments.figure:
        figure(outcomes, arguments.figure)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

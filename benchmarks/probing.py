"""Three short probes in each scene of the bench after vision, chosen from 32 candidates in five ways.

By expected information; the same as if touches shared no errors; at random; by a fixed script (the top, a
side, the side across it); and by largest variance (the touch that goes to where the belief is least sure of
the surface). All begin from the same belief and the same candidates; after each probe new candidates are
planned from the new belief. With `--profile ur5e`, say, the bench has all errors of a real one, and the pose
is the one as seen from the held peg, inserted: the first way knows of these errors.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from report import Row, cores, finish, options, show
from rich.console import Console
from scenes import PARTICLES, every, model, quantile

from bcppl.beliefs import Belief
from bcppl.contact.touch import Touch
from bcppl.geometry.gap import PegGap
from bcppl.geometry.parts import with_tip_at
from bcppl.inference.design import mixture_entropy
from bcppl.inference.design.loop import Round, probing_loop
from bcppl.inference.design.rules import (
    AcquisitionRule,
    at_random,
    by_linearised_gain,
    by_surface_variance,
    in_given_order,
)
from bcppl.inference.filters.default import infer
from bcppl.inference.filters.smc import Step
from bcppl.inference.planning.candidate_layout import MIXED, plan_candidates
from bcppl.inference.planning.faces import points_on_top, sides
from bcppl.inference.planning.touching import SurfacePoint, touch
from bcppl.models import look_and_touch
from bcppl.models.worlds.bench.arm import BenchArm
from bcppl.models.worlds.bench.errors import BenchErrors
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.sensors.candidates import Candidate, name_of
from bcppl.sensors.likelihoods.bench_profiles import PROFILES
from bcppl.sweeps import one_line
from bcppl.traces import Model

SCENES, PROBES = 50, 3
WAYS = ("chosen", "as if perfect", "random", "script", "variance")
FEWER = 2  # probes by which the chosen are to be as good as three random ones
SHARE = 0.6  # of the random probes' error that three chosen ones are to end at
FELT = 1.5  # N
SIDE, ROOM = 0.012, 0.004  # m below the top at which the script touches sides; from the top's edge


@dataclass
class Course:
    """What one way of choosing came to in a scene.

    Attributes:
        adds: weighted ADD (mm) after vision and each probe; infinite from where it failed.
        entropies: nats, likewise.
        names: of the probes.
        met: of each whether something was felt.
        ranking: s for planning and ranking candidates, of each probe.
        failed: in one line why it did not come to its end; empty where it did.
    """

    adds: list[float] = field(default_factory=list)
    entropies: list[float] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    met: list[bool] = field(default_factory=list)
    ranking: list[float] = field(default_factory=list)
    failed: str = ""

    def at(self, probes: int, entropy: bool = False) -> float:
        """ADD (mm) or entropy (nats) after so many probes; infinite where it did not get there."""
        values = self.entropies if entropy else self.adds
        return values[probes] if probes < len(values) else math.inf


@dataclass
class Compared:
    """What came of a scene: a course for each way, all failed where vision did."""

    seed: int
    name: str = "-"
    courses: dict[str, Course] = field(default_factory=dict)


def scripted(scene: BenchScene) -> Callable[[Belief, int], list[Candidate]]:
    """The fixed script: where it touches depends on the part alone."""
    part, peg = scene.part, scene.peg
    top = float(part.vertices[:, 2].max())
    height = top - min(SIDE, 0.5 * float(part.extent[2]))
    faces = sides(part, height)
    across = next((f for f in faces if abs(float(f.normal @ faces[0].normal)) < 0.5), faces[-1])
    spots = [
        SurfacePoint(np.array([*points_on_top(part, peg, ROOM).positions[0], top]), np.array([0.0, 0.0, 1.0]))
    ]
    for face in (faces[0], across):
        place = np.array([*(0.5 * (face.start + face.stop)), height])
        spots.append(SurfacePoint(place, np.array([*face.normal, 0.0])))

    def asked(belief: Belief, number: int) -> list[Candidate]:
        return [touch(belief, part, peg, spots[number % len(spots)], name=f"script {number + 1}")]

    return asked


def planned(scene: BenchScene) -> Callable[[Belief, int], Sequence[Candidate]]:
    """32 candidates around a belief, others for each probe."""
    gap = PegGap(scene.part, scene.peg)

    def asked(belief: Belief, number: int) -> Sequence[Candidate]:
        return plan_candidates(belief, scene.part, scene.peg, MIXED, gap=gap, seed=number)

    return asked


def way_of(name: str, scene: BenchScene, outer_samples: int | None) -> tuple[Any, AcquisitionRule]:
    """What may be done, and how it is chosen."""
    if name == "script":
        return scripted(scene), lambda population, found, known: in_given_order(found)
    if name == "random":
        return planned(scene), at_random(scene.seed)
    if name == "variance":
        return planned(scene), by_surface_variance(scene.peg, model.pose)
    settings = {"peg": None} if name == "as if perfect" else {}
    return planned(scene), by_linearised_gain(
        model.pose, outer_samples=outer_samples, seed=scene.seed, **settings
    )


def compared(
    seed: int,
    particles: int = PARTICLES,
    ways: Sequence[str] = WAYS,
    outer_samples: int | None = None,
    profile: str = "perfect",
) -> Compared:
    """One scene by each way, whatever happens."""
    found = Compared(seed, courses={way: Course() for way in ways})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            errors = BenchErrors() if profile == "perfect" else BenchErrors.only("real")
            parameters = BenchParameters(errors=errors)
            scene = bench_scene(seed, parameters)
            under = look_and_touch.model.with_settings(profile=profile)
            found.name = scene.name
            look = scene.look()
            *_, seen = infer(under, look, particles=particles, seed=seed)
        except Exception as error:
            for course in found.courses.values():
                course.failed = one_line(error)
            return found
        for way, course in found.courses.items():
            try:
                scene = bench_scene(seed, parameters)  # its arm remembers what it has executed
                follow(course, under, scene, seen, *way_of(way, scene, outer_samples))
            except Exception as error:
                course.failed = one_line(error)
    return found


def follow(
    course: Course, under: Model, scene: BenchScene, seen: Step, asked: Any, rank: AcquisitionRule
) -> None:
    """The loop from vision on, put down as it goes."""
    judge(course, scene, seen)
    begun = [time.perf_counter()]

    def timed(*given: Any) -> Any:
        ranking = rank(*given)
        course.ranking.append(time.perf_counter() - begun[0])
        return ranking

    def planned_anew(belief: Belief, number: int) -> Any:
        begun[0] = time.perf_counter()
        return asked(belief, number)

    look = scene.look()
    for each in probing_loop(under, look, BenchArm(scene), planned_anew, timed, start=seen, probes=PROBES):
        judge(course, scene, each.step)
        course.names.append(name_of(each.chosen))
        course.met.append(touched(each))


def judge(course: Course, scene: BenchScene, step: Step) -> None:
    """Puts down how far off a belief is and how unsure."""
    inserted = with_tip_at(scene.peg, torch.from_numpy(scene.truth), torch.from_numpy(scene.truth)[:3])
    apparent = torch.from_numpy(scene.apparent(inserted.numpy()))
    add = step.belief.relative(inserted).weighted_add(scene.part.surface_points(), apparent)
    course.adds.append(1e3 * add)
    weights = torch.softmax(step.population.log_weights, 0)
    course.entropies.append(float(mixture_entropy(model.pose)(step.population)(weights[None])[0]))


def touched(each: Round) -> bool:
    """Whether anything was felt in the last probe."""
    since = each.recording.measurements[each.before.taken :]
    felt = [m.observation.wrench[:, :3] for m in since if isinstance(m.observation, Touch)]
    if not felt:
        return False
    force = np.concatenate(felt)
    return bool((np.linalg.norm(force - force[:10].mean(axis=0), axis=1) > FELT).sum() > 5)


def lost(seed: int, why: str, ways: Sequence[str] = WAYS) -> Compared:
    """A scene whose process died."""
    return Compared(seed, courses={way: Course(failed=why) for way in ways})


def line_of(one: Compared) -> str:
    """A scene in one line."""
    shown = []
    for way, course in one.courses.items():
        adds = " ".join(f"{add:.2f}" for add in course.adds)
        shown.append(f"{way} {adds}{' FAILED ' * bool(course.failed)}{course.failed}")
    return f"{one.seed}: {one.name}: {'; '.join(shown)}"


def all_scenes(seeds: Sequence[int], jobs: int, function: Any, lose: Any) -> Iterator[Compared]:
    """Every scene as it comes, reported; an interrupted run keeps what is there."""
    console = Console(stderr=True, highlight=False)
    try:
        for k, one in enumerate(every(function, seeds, jobs, lose)):
            console.print(f"{k + 1} of {len(seeds)}, scene {line_of(one)}", soft_wrap=True, markup=False)
            yield one
    except KeyboardInterrupt:
        console.print("stopped: what follows is of the scenes so far.")


def tables(found: Sequence[Compared], ways: Sequence[str]) -> None:
    """Medians and 90th percentiles after each probe, and what the probes were."""
    after = ["vision", *(f"{k} probe{'s' * (k > 1)}" for k in range(1, PROBES + 1))]
    for title, entropy, level in (
        ("weighted ADD (mm), median", False, 0.5),
        ("weighted ADD (mm), 90th percentile", False, 0.9),
        ("entropy (nats), median", True, 0.5),
    ):
        lines = [
            [way, *(quantile(at(found, way, k, entropy), level) for k in range(PROBES + 1))] for way in ways
        ]
        show(f"{title}, {len(found)} scenes", ["", *after], lines)
    lines = []
    for way in ways:
        courses = [one.courses[way] for one in found]
        names = [name for course in courses for name in course.names]
        met = [hit for course in courses for hit in course.met]
        kinds = [
            f"{100 * sum(name.startswith(kind) for name in names) / max(len(names), 1):.0f}"
            for kind in ("touch", "slide")
        ]
        top = f"{100 * sum('top' in name for name in names) / max(len(names), 1):.0f}"
        spent = [seconds for course in courses for seconds in course.ranking]
        failed = sum(bool(course.failed) for course in courses)
        share = f"{100 * sum(met) / max(len(met), 1):.0f}"
        lines.append([way, failed, share, *kinds, top, quantile(spent, 0.5)])
    show("probes", ["", "failed", "met, %", "touches, %", "slides, %", "on top, %", "ranked in, s"], lines)


def at(found: Sequence[Compared], way: str, probes: int, entropy: bool = False) -> list[float]:
    """ADD (mm) or entropy (nats) of every scene after so many probes."""
    return [one.courses[way].at(probes, entropy) for one in found]


def rows(found: Sequence[Compared], ways: Sequence[str]) -> list[Row]:
    """The medians, and the two goals."""
    found_rows = [
        Row(f"{what} after {k} probes, {way}, median", quantile(at(found, way, k, entropy), 0.5), unit)
        for entropy, what, unit in ((False, "weighted ADD", "mm"), (True, "entropy", "nats"))
        for way in ways
        for k in range(PROBES + 1)
    ]
    if {"chosen", "random"} <= set(ways):
        end = quantile(at(found, "random", PROBES), 0.5)
        for probes, goal in ((FEWER, 1.0), (PROBES, SHARE)):
            ratio = quantile(at(found, "chosen", probes), 0.5) / end
            name = f"median ADD of {probes} chosen probes over that of {PROBES} random ones"
            found_rows.append(Row(name, ratio, "ratio", goal))
    return found_rows


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, default=SCENES)
    parser.add_argument("--jobs", type=int, default=cores(), help="scenes at a time")
    parser.add_argument("--particles", type=int, default=PARTICLES)
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--profile", choices=PROFILES, default="perfect", help="of the bench")
    parser.add_argument("--outer-samples", type=int, help="true values; all by default")
    arguments = parser.parse_args()
    count = 2 if arguments.quick else arguments.scenes
    seeds = range(arguments.seed, arguments.seed + count)
    ways = arguments.ways
    function = partial(
        compared,
        particles=arguments.particles,
        ways=ways,
        outer_samples=arguments.outer_samples,
        profile=arguments.profile,
    )
    found = list(all_scenes(seeds, arguments.jobs, function, partial(lost, ways=ways)))
    found.sort(key=lambda one: one.seed)
    tables(found, ways)
    finish(rows(found, ways), arguments.json)


if __name__ == "__main__":
    main()

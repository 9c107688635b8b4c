"""How accurate and how honest the default inference is in a world that it was not made with.

Every scene of `foreign.world` is touched in two manners, by a contact softer and one stiffer than nominal,
and read at two rates: eight recordings of the same two views. `--cuts` reads each probe at other rates and
cuts it into other windows, of which the belief should not depend; `--faults` shows which faults are reported.
`--check` prints the gap between peg and part at the true pose, from which a wrong recording would show. With
`--file` results are written as they are done, and a later call adds those that are missing.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from foreign import check
from foreign.faults import FAULTS, recut, resampled
from foreign.world import CONTACTS, MANNERS, RATES, kept, scene_of
from report import Row, finish, options, show
from scenes import model

import bcppl
from bcppl.beliefs import Belief, rotation_deviation, translation_deviation
from bcppl.cli.predictive_checks import MARK, PredictiveChecks
from bcppl.sensors.measurements import Recording
from bcppl.sweeps import in_order, swept

SCENES, QUICK = 50, 1
PARTICLES = 75
MASSES = (0.5, 0.9)
REGIONS = {"translation": translation_deviation, "rotation": rotation_deviation}
HELD = tuple(itertools.product(REGIONS, MASSES))
GOALS = {"taps": 0.5, "presses": 0.2}  # mm, of the median ADD
FAR = 2.0  # mm: a belief this far off is wrong where its 90 % region of the translation misses the truth
CUTS = tuple(itertools.product((500, 100, 50), (0.5, 6.0, 0.1, 0.01)))  # Hz, and s of a window
QUANTILES = {"median": 0.5, "90 %": 0.9, "99 %": 0.99, "worst": 1.0}


class Case(NamedTuple):
    """One recording, what is changed in it (a fault or a cut; nothing where empty), and inference's seed."""

    seed: int
    manner: str
    contact: str
    rate: int
    change: str = ""
    inference: int = 0


class Result(NamedTuple):
    """What the default inference makes of a recording.

    Attributes:
        case: which recording.
        add: mm, weighted, at the end; inf after an error.
        spread: mm, the same from the mean pose instead of the truth.
        mean: (7,) the mean pose.
        vision: mm, weighted, after the views.
        held: by region and mass, whether it holds the truth at the end.
        seen: the same after the views.
        distance: squared Mahalanobis distance of the truth at the end, six degrees of freedom.
        warned: whether a measurement was marked or a warning given.
        seconds: wall time.
        error: in one line; empty where there was none.
    """

    case: Case
    add: float
    spread: float
    mean: tuple[float, ...]
    vision: float
    held: tuple[bool, ...]
    seen: tuple[bool, ...]
    distance: float
    warned: bool
    seconds: float
    error: str = ""

    @property
    def silent(self) -> bool:
        """Whether the belief is wrong, sure, and without a warning."""
        return self.add > FAR and not self.warned and not self.held[HELD.index(("translation", 0.9))]


def inferred(asked: Sequence[Any], folder: Path | None) -> Result:
    """The result of one recording, a case after the number of particles."""
    particles, case = asked[0], Case(*asked[1:])
    recording = changed(kept(*case[:4], folder), case.change)
    points, begun = recording.part.surface_points(), time.perf_counter()
    try:
        with warnings.catch_warnings(record=True) as given:
            warnings.simplefilter("always", RuntimeWarning)
            run = bcppl.infer(model, recording, particles=particles, seed=case.inference)
            steps = list(run)
    except Exception as error:  # one scene that fails is one result, not the end of the benchmark
        nothing = (False,) * len(HELD)
        message = f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]
        lost = (math.nan,) * 7
        return Result(
            case, math.inf, math.nan, lost, math.inf, nothing, nothing, math.inf, True, math.nan, message
        )
    seconds = time.perf_counter() - begun
    checks = PredictiveChecks()
    marked = [checks.cell(step).endswith(MARK) for step in steps]
    warned = any(marked) or bool(checks.warnings(steps[-1], model.pose))
    warned |= any(issubclass(warning.category, RuntimeWarning) for warning in given)
    views = [step for step in steps if step.info.label.startswith("view")]
    seen, end = views[-1].belief, steps[-1].belief
    add, vision = (1e3 * belief.weighted_add(points, recording.truth) for belief in (end, seen))
    spread, mean = 1e3 * end.weighted_add(points, end.mean), tuple(end.mean.tolist())
    off = bcppl.poses.local(end.mean, bcppl.poses.as_pose(recording.truth)).numpy()
    distance = float(off @ np.linalg.pinv(end.covariance.numpy(), rcond=1e-12, hermitian=True) @ off)
    holds = [_holds(belief, recording.truth) for belief in (end, seen)]
    return Result(case, add, spread, mean, vision, *holds, distance, warned, seconds)


def changed(recording: Recording, change: str) -> Recording:
    """The recording with a fault, or read and cut otherwise ("100 Hz, 0.5 s")."""
    if change in FAULTS:
        return FAULTS[change](recording)
    if change:
        hertz, seconds = (float(word.split()[0]) for word in change.split(","))
        return recut(resampled(recording, hertz), seconds)
    return recording


def _holds(belief: Belief, truth: Any) -> tuple[bool, ...]:
    return tuple(bool(belief.credible_region(m, REGIONS[name]).contains(truth)) for name, m in HELD)


def line(name: str, several: Sequence[Result], vision: bool = False) -> list[Any]:
    """A group's line of the table."""
    adds = [one.vision if vision else one.add for one in several]
    held = np.array([one.seen if vision else one.held for one in several])
    return [
        name,
        len(several),
        *[quantile(adds, level) for level in QUANTILES.values()],
        sum(add > FAR for add in adds),
        *[f"{100 * share:.0f}" for share in held.mean(axis=0)],
        "" if vision else quantile([one.distance for one in several], 0.5),
        "" if vision else sum(one.warned for one in several),
        "" if vision else sum(one.silent for one in several),
        "" if vision else float(np.nanmedian([one.seconds for one in several])),
    ]


def quantile(values: Sequence[float], level: float) -> float:
    """The smallest value that has at least a share `level` of the values at or below it."""
    return float(np.sort(values)[max(0, math.ceil(level * len(values)) - 1)])


def groups(results: Sequence[Result]) -> dict[str, list[Result]]:
    """Results by manner, contact and rate, then by manner; those of changed recordings by the change."""
    grouped: dict[str, list[Result]] = {}
    for one in results:
        case = one.case
        name = case.change or f"{case.contact}, {case.rate} Hz"
        grouped.setdefault(f"{case.manner}, {name}", []).append(one)
    for one in results:
        if not one.case.change:
            grouped.setdefault(f"{one.case.manner}, all", []).append(one)
    return grouped


def apart(results: Sequence[Result]) -> None:
    """How far each cut's mean pose is from that of the first cut, beside the spreads of both."""
    first = {one.case._replace(change=""): one for one in reversed(results)}
    lines: list[list[Any]] = []
    for name, several in groups(results).items():
        pairs = [(one, first[one.case._replace(change="")]) for one in several]
        far = [1e3 * _between(one, other) for one, other in pairs]
        spread = [math.hypot(one.spread, other.spread) for one, other in pairs]
        ratio = np.array(far) / spread
        times = [one.seconds / other.seconds for one, other in pairs]
        line = [np.median(far), np.max(far), np.median(spread), np.median(ratio), np.max(ratio)]
        lines.append([name, *map(float, line), float(np.median(times))])
    columns = ["", "apart mm", "worst", "spread mm", "apart / spread", "worst", "time"]
    show("each cut beside the first: means apart (ADD), and ratios of times", columns, lines)


def _between(one: Result, other: Result) -> float:
    points = torch.from_numpy(scene_of(one.case.seed).foreign.part.surface_points())
    places = [bcppl.poses.transform(bcppl.poses.as_pose(r.mean), points) for r in (one, other)]
    return float((places[0] - places[1]).norm(dim=-1).mean())


def rows_of(results: Sequence[Result]) -> list[Row]:
    """What is reported, with goals for the medians."""
    rows: list[Row] = []
    for name, several in groups(results).items():
        adds = [one.add for one in several]
        goal = None if several[0].case.change else GOALS[several[0].case.manner]
        for level, share in QUANTILES.items():
            value = quantile(adds, share)
            rows.append(Row(f"{name}: ADD, {level}", value, "mm", goal if level == "median" else None))
        for k, (region, mass) in enumerate(HELD):
            share = 100 * float(np.mean([one.held[k] for one in several]))
            rows.append(Row(f"{name}: {100 * mass:.0f} % region of the {region} holds the truth", share, "%"))
        silent = sum(one.silent for one in several)
        goal = 0.0 if not several[0].case.change else None
        rows.append(Row(f"{name}: over {FAR:g} mm off and sure, without a warning", silent, "runs", goal))
        rows.append(Row(f"{name}: with a warning", sum(one.warned for one in several), "runs"))
    return [row._replace(value=math.nan) if math.isinf(row.value) else row for row in rows]


def checked(case: Case, folder: Path | None) -> check.Gaps:
    """The gaps of one recording."""
    return check.gaps_of(kept(*case[:4], folder))


def asked() -> argparse.Namespace:
    """The command line's options."""
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, help=f"how many; {SCENES}, with --quick {QUICK}")
    parser.add_argument("--particles", type=int, default=PARTICLES)
    parser.add_argument("--jobs", type=int, default=1, help="recordings at a time, of one thread each")
    parser.add_argument("--seeds", type=int, default=1, help="seeds of inference for each recording")
    parser.add_argument("--manners", nargs="+", choices=MANNERS, default=list(MANNERS))
    parser.add_argument("--contacts", nargs="+", choices=CONTACTS, default=list(CONTACTS))
    parser.add_argument("--rates", nargs="+", type=int, choices=RATES, default=list(RATES))
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="recordings are kept in it, and read from it"
    )
    parser.add_argument("--file", type=Path, help="where the result of each recording is kept")
    parser.add_argument("--faults", action="store_true", help="good recordings beside faulty ones")
    parser.add_argument("--cuts", action="store_true", help="the same probes in other windows and rates")
    parser.add_argument("--check", action="store_true", help="the gaps at the true poses, and no inference")
    return parser.parse_args()


def main() -> None:
    given = asked()
    count = given.scenes if given.scenes is not None else QUICK if given.quick else SCENES
    seeds = range(given.seed, given.seed + count)
    rates = [max(RATES)] if given.cuts else given.rates
    kinds = list(itertools.product(given.manners, given.contacts, rates))
    if given.check:
        lines = []
        for kind in kinds:
            cases = [Case(seed, *kind) for seed in seeds]
            several = list(in_order(partial(checked, folder=given.keep), cases, given.jobs))
            lines.append([f"{kind[0]}, {kind[1]}, {kind[2]} Hz", *check.summary(several)])
        show("gap between peg and part at the true pose", ["", *check.COLUMNS], lines)
        return
    # Kinds of one scene one after another: an interrupted run has all kinds of the scenes that it got to.
    changes = [f"{hertz} Hz, {seconds:g} s" for hertz, seconds in CUTS] if given.cuts else [""]
    changes += list(FAULTS) if given.faults else []
    cases = [
        Case(seed, *kind, change, k)
        for seed in seeds
        for kind in kinds
        for change in changes
        for k in range(given.seeds)
    ]
    results: list[Result] = []
    work = partial(inferred, folder=given.keep)
    cells = [[given.particles, *case] for case in cases]
    for (_, *case), (_, *values) in swept(work, cells, file=given.file, jobs=given.jobs):
        one = Result(Case(*case), *values)
        results.append(one)
        end = one.error or f"{one.add:.3f} mm, vision {one.vision:.2f} mm, {one.distance:.1f} squared"
        print(*one.case, end, "warned" if one.warned else "", f"{one.seconds:.1f} s", flush=True)
    regions = [f"{name} {100 * mass:.0f} %" for name, mass in HELD]
    lines = [line(name, several) for name, several in groups(results).items()]
    if not (given.cuts or given.faults):
        lines.append(line("vision alone", results, vision=True))
    columns = ["", "runs", *[f"ADD {q}" for q in QUANTILES], f"> {FAR:g} mm", *regions, "squared distance"]
    show("mm, and % of regions that hold the truth", [*columns, "warned", "silent", "s"], lines)
    if given.cuts:
        apart(results)
    finish(rows_of(results), given.json)


if __name__ == "__main__":
    main()

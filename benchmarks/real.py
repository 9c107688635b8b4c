"""bcppl on real data: pushes of an aluminium triangle, one depth image of clutter, five of an arm.

Pushes: what is known of the finger is learnt on one log and tested on the other, both ways. Beside the
belief's mean stands robust least squares on the same contacts, started at the truth with the same offset:
where the finger really touches and how far inside the part. In a second line it has the registration too,
as bcppl does; in a third no more than how far the recorded tip lies inside on average. On some of
the draws CHSEL (Zhong, Fazeli and Berenson, "CHSEL: Producing Diverse Plausible Pose Estimates from
Contact and Free Space Data", RSS 2023) is given the same contacts and the same offset. Then: how often
credible regions hold the truth, over disjoint groups of pushes.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import arm
import clutter
import numpy as np
import torch
from peer import ask
from report import Row, finish, options, show
from scipy.stats import binomtest, bootstrap
from touches import (
    LOGS,
    OTHER,
    PARTICLES,
    Errors,
    contacts,
    coverage,
    errors,
    explained,
    fitted,
    learnt,
    pushes,
    tracked,
)

from bcppl import poses
from bcppl.arrays import Array
from bcppl.distributions.poses import prior_from_guess
from bcppl.sweeps import in_order

COUNTS = (5, 10, 20)
JUDGED = 10  # pushes, where the goals are
FEW = 20  # draws where the number of pushes is another
SHARED = 20  # draws that CHSEL is given too
STARTS = 30  # poses that CHSEL starts from and gives back
MASSES = (0.5, 0.9)
CONFIDENCE = 0.99  # of the intervals of a share
MEASURES = ("yaw", "position")  # CHSEL's measures of diversity: the first is its default


class Answer(NamedTuple):
    """One way's answer to a draw: its errors, its stated standard deviations (mm, degrees), its seconds."""

    errors: Errors
    spread: float
    yaw_spread: float
    seconds: float


Answers = dict[str, dict[int, Answer]]  # by way and number of pushes
BCPPL, GIVEN = "bcppl", "least squares, given the same offset"
ALL, MEAN = "least squares, given the registration too", "least squares, given the mean offset only"


def answers(asked: tuple[str, int, tuple[int, ...]]) -> Answers:
    """Of bcppl and least squares to one draw of a log, after each of the counts."""
    log, seed, counts = asked
    recording = pushes(log, max(COUNTS), seed)
    settings = learnt(OTHER[log])
    found: Answers = {BCPPL: {}, GIVEN: {}, ALL: {}, MEAN: {}}
    shorter = {count: recording_of(log, seed, count) for count in counts}
    recording.measurements[max(counts) :] = []
    for done, (step, seconds) in enumerate(explained(recording, seed, asdict(settings))):
        if done in counts:
            spread = step.belief.spread
            wide = 1e3 * float(spread[:2].norm()), math.degrees(float(spread[5]))
            found[BCPPL][done] = Answer(errors(step.belief.mean, recording), *wide, seconds)
    mean = learnt(OTHER[log], calibrated=False)
    for name, known, registered in ((GIVEN, settings, False), (ALL, settings, True), (MEAN, mean, False)):
        for count, one in shorter.items():
            begun = time.perf_counter()
            pose = fitted(one, known, registered)
            seconds = time.perf_counter() - begun
            found[name][count] = Answer(errors(pose, one), math.nan, math.nan, seconds)
    return found


def recording_of(log: str, seed: int, count: int) -> Any:
    """The first pushes of a draw; every count is cut from the longest."""
    recording = pushes(log, max(COUNTS), seed)
    recording.measurements[count:] = []
    return recording


def chsel(draws: Sequence[tuple[str, int]], measure: str) -> tuple[list[Answer], list[Answer]] | None:
    """CHSEL's answers to draws (log, seed), and the same given the registration.

    An answer is the pose of least cost; its spread is how far the poses lie apart that come back.
    """
    recordings = [recording_of(log, seed, JUDGED) for log, seed in draws]
    calibrated = [learnt(OTHER[log]) for log, _ in draws]
    starts = []
    for k, recording in enumerate(recordings):
        torch.manual_seed(k)
        drawn = prior_from_guess(recording.guess).expand([STARTS]).sample()
        matrix = torch.eye(4, dtype=torch.float64).repeat(STARTS, 1, 1)
        matrix[:, :3, :3], matrix[:, :3, 3] = poses.rotation_matrix(drawn), drawn[:, :3]
        starts.append(matrix)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "contacts.npz"
        np.savez(
            file,
            vertices=recordings[0].part.vertices,
            faces=recordings[0].part.faces,
            contacts=torch.stack(
                [contacts(*pair) for pair in zip(recordings, calibrated, strict=True)]
            ).numpy(),
            signed_distance=np.array([-settings.offset for settings in calibrated]),
            starts=torch.stack(starts).numpy(),
        )
        threads = torch.get_num_threads()
        printed = ask("chsel", "chsel_contacts.py", file, "--measure", measure, "--threads", threads)
    if printed is None:
        return None
    found: tuple[list[Answer], list[Answer]] = [], []
    for recording, settings, one in zip(recordings, calibrated, printed, strict=True):
        matrix = torch.tensor(one["world_from_part"], dtype=torch.float64)
        world_from_part = poses.from_rotation_matrix(matrix[:, :3, 3], matrix[:, :3, :3])
        best = world_from_part[int(np.argmin(one["cost"]))]
        around = poses.local(best, world_from_part).std(dim=0, correction=0)
        wide = 1e3 * float(around[:2].norm()), math.degrees(float(around[5]))
        for kind, pose in zip(found, (best, tracked(best, recording, settings)), strict=True):
            kind.append(Answer(errors(pose, recording), *wide, one["seconds"]))
    return found


def columns_of(answers: Sequence[Answer]) -> dict[str, Array]:
    """Position, yaw, ADD, stated spreads and seconds of several answers, each (D,)."""
    columns = {name: [getattr(a.errors, name) for a in answers] for name in Errors._fields}
    columns |= {name: [getattr(a, name) for a in answers] for name in ("spread", "yaw_spread", "seconds")}
    return {name: np.array(column) for name, column in columns.items()}


def truth_of(answers: Sequence[Answer]) -> tuple[float, float]:
    """Stated spread over actual error of position and yaw, both as root mean squares: 1 where it is true."""
    at = columns_of(answers)

    def size(name: str) -> float:
        return float(np.sqrt(np.mean(at[name] ** 2)))

    return size("spread") / size("position"), size("yaw_spread") / size("yaw")


def line(name: str, count: int, answers: Sequence[Answer]) -> list[Any]:
    at = columns_of(answers)
    numbers = [f(at[name]) for name in Errors._fields for f in (np.median, lambda x: np.quantile(x, 0.9))]
    return [name, count, len(answers), *numbers, *truth_of(answers), float(np.median(at["seconds"]))]


LINE = ["K", "draws", "position mm", "90 %", "yaw deg", "90 %", "ADD mm", "90 %"]
LINE = ["", *LINE, "spread/error", "of yaw", "s"]


def ratios(name: str, ours: Sequence[Answer], theirs: Sequence[Answer], goal: float | None) -> list[Row]:
    """Our median and 90th percentile of each error over theirs; the 95 % bootstrap's interval in the name."""
    rows = []
    for error in Errors._fields:
        pair = columns_of(ours)[error], columns_of(theirs)[error]
        for what, level in (("median", 0.5), ("90 %", 0.9)):

            def ratio(a: Array, b: Array, axis: int = -1, level: float = level) -> Array:
                return np.asarray(np.quantile(a, level, axis=axis) / np.quantile(b, level, axis=axis))

            value = float(ratio(*pair))
            drawn = bootstrap(pair, ratio, paired=True, method="percentile", rng=0).confidence_interval
            title = f"{name}: {error}, {what} ({drawn.low:.2f} to {drawn.high:.2f})"
            rows.append(Row(title, value, "ratio", goal))
    return rows


def of_pushes(draws: int, seed: int, jobs: int, beside: bool) -> list[Row]:
    """Errors of bcppl and of least squares at every number of pushes, of CHSEL at ten."""
    seeds = range(seed, seed + draws)
    asked = [(log, s, COUNTS if s < seed + FEW else (JUDGED,)) for log in OTHER for s in seeds]
    results = list(in_order(answers, asked, jobs))

    def of(way: str, count: int, log: str | None = None) -> list[Answer]:
        return [
            result[way][count]
            for result, (of_log, _, counts) in zip(results, asked, strict=True)
            if count in counts and log in (None, of_log)
        ]

    rows, lines = [], []
    for count in COUNTS:
        for way in (BCPPL, GIVEN, ALL, MEAN):
            for log in OTHER:
                lines.append(line(f"{way}, log {log}", count, of(way, count, log)))
            lines.append(line(f"{way}, both", count, of(way, count)))
            at = columns_of(of(way, count))
            for error, unit in zip(Errors._fields, ("mm", "deg", "mm"), strict=True):
                name = f"{way}, {count} pushes: {error}"
                rows.append(Row(f"{name}, median", float(np.median(at[error])), unit))
                rows.append(Row(f"{name}, 90 %", float(np.quantile(at[error], 0.9)), unit))
            rows.append(Row(f"{way}, {count} pushes: wall, median", float(np.median(at["seconds"])), "s"))
        for way in (GIVEN, ALL, MEAN):
            goal = 1.0 if count == JUDGED and way != ALL else None
            rows += ratios(f"{count} pushes, to {way}", of(BCPPL, count), of(way, count), goal)
    title = f"real pushes: {PARTICLES} particles, {jobs} at a time; medians and 90th percentiles"
    show(title, LINE, lines)
    if beside:
        shared = [(log, s) for s in seeds for log in OTHER][:SHARED]
        of_draw = {one[:2]: result[BCPPL][JUDGED] for one, result in zip(asked, results, strict=True)}
        rows += against_chsel(shared, [of_draw[draw] for draw in shared])
    return rows


def against_chsel(draws: Sequence[tuple[str, int]], ours: Sequence[Answer]) -> list[Row]:
    rows, lines = [], [line(BCPPL, JUDGED, ours)]
    for measure in MEASURES:
        both = chsel(draws, measure)
        if both is None:
            return []
        theirs, registered = both
        name = f"CHSEL, {measure} measure"
        lines.append(line(name, JUDGED, theirs))
        lines.append(line(f"{name}, given the registration too", JUDGED, registered))
        rows += ratios(f"to {name}", ours, theirs, 1.0)
        rows += ratios(f"to {name}, given the registration too", ours, registered, None)
        seconds = [float(np.median(columns_of(a)["seconds"])) for a in (ours, theirs)]
        rows.append(Row(f"to {name}: wall, median", seconds[0] / seconds[1], "ratio", 1.0))
        # How many times too wide or too narrow, whichever it is.
        for k, what in enumerate(("position", "yaw")):
            off = [math.exp(abs(math.log(max(truth_of(a)[k], 1e-9)))) for a in (ours, theirs)]
            rows.append(Row(f"to {name}: spread of {what} off by a factor", off[0], "times", off[1]))
    show(f"beside CHSEL: the same {len(draws)} draws and contacts", LINE, lines)
    return rows


def calibration(jobs: int, seed: int = 0, divisions: int = 4, count: int = JUDGED) -> list[Row]:
    """How often credible regions hold the truth, over disjoint groups of pushes of both logs.

    Every division splits all pushes into random groups. Its groups are disjoint; those of several
    divisions are not, so they make the share steadier and the interval no narrower: that is of as many
    independent groups as one division has.
    """
    asked = [(log, count, s) for s in range(seed, seed + divisions) for log in OTHER]
    groups = [
        (log, group)
        for (log, *_), one in zip(asked, list(in_order(coverage, asked, jobs)), strict=True)
        for group in one
    ]
    rows, lines = [], []
    for log in (*OTHER, None):
        of_log = [group for name, group in groups if log in (None, name)]
        independent = len(of_log) // divisions
        for k, (region, mass, _) in enumerate(of_log[0]):
            share = float(np.mean([group[k].holds for group in of_log]))
            test = binomtest(round(share * independent), independent, mass)
            interval = test.proportion_ci(CONFIDENCE)
            name = f"{region}, {100 * mass:.0f} % region"
            lines.append(
                [
                    f"{name}, {log or 'both logs'}",
                    independent,
                    100 * share,
                    100 * interval.low,
                    100 * interval.high,
                ]
            )
            if log is None:
                rows.append(Row(f"{name}: holds the truth", 100 * share, "% of groups", direction="min"))
                rows.append(
                    Row(f"{name}: p of its mass", float(test.pvalue), "probability", 1 - CONFIDENCE, "min")
                )
    show(
        f"regions after {count} real pushes, {100 * CONFIDENCE:.0f} % interval",
        ["", "groups", "holds %", "from %", "to %"],
        lines,
    )
    return rows


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--only", choices=["pushes", "lmo", "xarm"], help="one of the three")
    parser.add_argument("--draws", type=int, default=FEW, help="of each log, at ten pushes")
    parser.add_argument("--no-chsel", action="store_true", help="leave CHSEL out")
    parser.add_argument(
        "--jobs", type=int, default=1, help="runs at a time; with more than one, times mean little"
    )
    arguments = parser.parse_args()
    rows: list[Row] = []
    if arguments.only in (None, "pushes"):
        if LOGS.is_dir():
            draws = 2 if arguments.quick else arguments.draws
            rows += of_pushes(draws, arguments.seed, arguments.jobs, not arguments.no_chsel)
            rows += calibration(arguments.jobs, arguments.seed, 1 if arguments.quick else 4)
        else:
            print(f"skipped: the push logs are not at {LOGS}.")
    seeds = range(arguments.seed, arguments.seed + (1 if arguments.quick else 5))
    if arguments.only in (None, "lmo"):
        if clutter.SCENE.is_dir():
            rows += clutter.rows_of(seeds, arguments.jobs, {})
        else:
            print(f"skipped: the scene is not at {clutter.SCENE}.")
    if arguments.only in (None, "xarm"):
        if arm.XARM.is_dir():
            rows += [row for masked in (False, True) for row in arm.seen(seeds, {}, masked)]
        else:
            print(f"skipped: the xArm's frames are not at {arm.XARM}.")
    if rows:
        finish(rows, arguments.json)


if __name__ == "__main__":
    main()

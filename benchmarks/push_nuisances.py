"""Which errors real pushes support, by evidence, and whether the stated spread is as large as the error.

Three sessions of fifty pushes each, the finger learnt on another one. A session's pushes are put by chance
into disjoint groups of ten, and each group is explained with and without each of the model's errors: the sum
of the differences in log evidence over groups is for or against it. Groups of a session share one error of
the registration, so they are not independent. The spread over the error is the root mean square of the
stated standard deviations over that of the errors of the means.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from report import Row, cores, finish, options, show
from touches import LOGS, SESSIONS, errors, explained, groups, learnt

from bcppl.sensors.likelihoods.point_finger import FingerSettings
from bcppl.sweeps import swept

LEARNT = "as learnt"
# The settings of the model in place of those that are learnt.
VARIANTS: Mapping[str, Callable[[FingerSettings], FingerSettings]] = {
    LEARNT: lambda finger: finger,
    "no error shared by a session": lambda finger: replace(finger, drift=(0.0, 0.0)),
    "twice the error shared by a session": lambda finger: replace(
        finger, drift=(2.0 * finger.drift[0], 2.0 * finger.drift[1])
    ),
    "every session scatters alike": lambda finger: replace(finger, varying=0.0),
    "no calibration of the finger": lambda finger: replace(finger, finger=(0.0, 0.0, 0.0)),
    "no registration": lambda finger: replace(finger, registration=(0.0, 0.0, 0.0)),
    "no outliers": lambda finger: replace(finger, outlier=1e-9),
    "half the spread of onsets": lambda finger: replace(finger, spread=0.5 * finger.spread),
    "twice the spread of onsets": lambda finger: replace(finger, spread=2.0 * finger.spread),
    "hardly any friction": lambda finger: replace(finger, friction=1e-3),
}


class Result(NamedTuple):
    """The belief after a group of pushes: log evidence, errors (mm, degrees), and their stated deviations."""

    log_evidence: float
    position: float
    yaw: float
    spread: float
    turn: float


def run(asked: tuple[str, str, int, int, int]) -> list[float]:
    """The result of one group of a log with one variant: (variant, log, pushes, group, seed)."""
    variant, log, count, group, seed = asked
    settings = asdict(VARIANTS[variant](learnt(SESSIONS[log])))
    recording = groups(log, count, 0)[group]
    *_, (step, _) = explained(recording, seed, settings)
    off = errors(step.belief.mean, recording)
    variance = step.belief.covariance.diagonal()
    wide, turn = math.sqrt(float(variance[:2].sum())), math.sqrt(float(variance[5]))
    result = Result(step.population.log_evidence, off.position, off.yaw, 1e3 * wide, math.degrees(turn))
    return list(result)


def ratio(deviations: list[float], off: list[float]) -> float:
    """The root mean square of stated deviations over that of errors."""
    return float(np.sqrt(np.mean(np.square(deviations)) / np.mean(np.square(off))))


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--pushes", type=int, default=10, help="in a group")
    parser.add_argument("--seeds", type=int, default=4, help="of inference")
    parser.add_argument("--file", type=Path, help="where results are kept")
    parser.add_argument("--jobs", type=int, default=cores(), help="processes, of one thread each if several")
    arguments = parser.parse_args()
    if not LOGS.is_dir():
        print(f"skipped: the push logs are not at {LOGS}.")
        return
    torch.set_num_threads(1)
    count, most = arguments.pushes, 2 if arguments.quick else 50 // arguments.pushes
    seeds = range(arguments.seed, arguments.seed + (1 if arguments.quick else arguments.seeds))
    asked = [(v, log, count, g, s) for v in VARIANTS for log in SESSIONS for g in range(most) for s in seeds]
    done = swept(run, asked, file=arguments.file, jobs=arguments.jobs)
    results = {one: Result(*values) for one, values in done}

    rows, lines = list[Row](), list[list[Any]]()
    for log in SESSIONS:
        for variant in VARIANTS:
            of = [[results[variant, log, count, g, s] for g in range(most)] for s in seeds]
            base = [[results[LEARNT, log, count, g, s] for g in range(most)] for s in seeds]
            gains = [
                sum(b.log_evidence - o.log_evidence for b, o in zip(bs, os, strict=True))
                for bs, os in zip(base, of, strict=True)
            ]
            error = float(np.std(gains, ddof=1)) / math.sqrt(len(gains)) if len(gains) > 1 else math.nan
            every = [one for each_seed in of for one in each_seed]
            shares = [
                ratio([one.spread for one in every], [one.position for one in every]),
                ratio([one.turn for one in every], [one.yaw for one in every]),
            ]
            median = float(np.median([one.position for one in every]))
            gain = float(np.mean(gains))
            lines.append(
                [log, variant, "" if variant == LEARNT else f"{gain:+.1f} ± {error:.1f}", median, *shares]
            )
            if variant == LEARNT:
                for name, share in zip(("position", "yaw"), shares, strict=True):
                    rows.append(Row(f"{log}: spread over error, {name}", share, "1", 0.7, "min"))
                    rows.append(Row(f"{log}: spread over error, {name}, at most", share, "1", 1.4))
            else:
                rows.append(Row(f"{log}: log evidence for the model, against {variant}", gain, "nats"))
    columns = ["session", "model", "nats for the learnt", "position mm", "spread/error", "of the yaw"]
    show(f"{most} groups of {count} real pushes a session, {len(seeds)} seeds", columns, lines)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

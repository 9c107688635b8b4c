"""How far the worst runs on real pushes end from the truth: draws of pushes by inference seeds, three logs.

The truth is known. A run that ends far off is worst where nothing names it: so warnings of the predictive
checks, and whether credible regions hold the truth, are counted with the errors. With --file runs are written
as they are done, and a later call adds those that are missing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from report import Row, cores, finish, options, show
from touches import LOGS, SESSIONS, errors, held, learnt, pushes

from bcppl.cli.predictive_checks import PredictiveChecks
from bcppl.inference import infer
from bcppl.models.point_probe import model
from bcppl.sweeps import swept

PUSHES = 20  # drawn, of which the first are assimilated
COUNTS = (3, 5, 10)
WRONG = 5.0  # mm: farther than this from the truth is another mode, not noise


class Run(NamedTuple):
    """A run after some pushes.

    Attributes:
        log, draw, seed, count: which pushes, the seed of inference, and how many pushes.
        position: error of the mean in the plane, mm.
        spread: standard deviation of the belief in the plane, mm.
        holds: whether the 90 % region of the translation holds the truth.
        warned: whether a predictive check warns.
        gap: log-likelihood of the truth minus that of the best particle.
        seconds: processor time so far, without the check.
    """

    log: str
    draw: int
    seed: int
    count: int
    position: float
    spread: float
    holds: bool
    warned: bool
    gap: float
    seconds: float


def run(asked: tuple[str, int, int]) -> list[Run]:
    """One run of a draw of a log with an inference seed, after each of the counts."""
    log, draw, seed = asked
    recording = pushes(log, PUSHES, draw)
    recording = replace(recording, measurements=recording.measurements[: max(COUNTS)])
    scene = model.prepare(recording, **asdict(learnt(SESSIONS[log])))
    checks, results, spent = PredictiveChecks(), [], 0.0
    begun = time.process_time()
    for done, step in enumerate(infer(model, recording, seed=seed, scene=scene)):
        spent += time.process_time() - begun
        checks.cell(step)
        if done in COUNTS:
            off = errors(step.belief.mean, recording).position
            wide = 1e3 * math.sqrt(float(step.belief.covariance.diagonal()[:2].sum()))
            within = {one.region: one.holds for one in held(step.belief, recording, [0.9])}["translation"]
            warned = bool(checks.warnings(step, model.pose))
            results.append(Run(log, draw, seed, done, off, wide, within, warned, step.info.truth_gap, spent))
        begun = time.process_time()
    return results


def summary(runs: Sequence[Run]) -> list[float | int]:
    """One line of the table."""
    position = np.array([one.position for one in runs])
    silent = [one for one in runs if one.position > WRONG and not (one.warned or one.holds)]
    quantiles = [float(np.quantile(position, q)) for q in (0.5, 0.9, 0.99, 1.0)]
    shares = [100.0 * float(np.mean([getattr(one, name) for one in runs])) for name in ("holds", "warned")]
    # A mean that is near by chance is not good where the belief is wide.
    good = [one.warned for one in runs if one.position <= WRONG and one.spread <= 0.5 * WRONG]
    return [
        *quantiles,
        int((position > WRONG).sum()),
        len(silent),
        *shares,
        100.0 * float(np.mean(good)) if good else math.nan,
        float(np.median([one.seconds for one in runs])),
    ]


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--draws", type=int, default=40, help="of every log")
    parser.add_argument("--seeds", type=int, default=4, help="of inference, on every draw")
    parser.add_argument("--logs", nargs="+", choices=list(SESSIONS), default=list(SESSIONS))
    parser.add_argument("--file", type=Path, help="where runs are kept")
    parser.add_argument("--jobs", type=int, default=cores(), help="processes, of one thread each if several")
    arguments = parser.parse_args()
    if not LOGS.is_dir():
        print(f"skipped: the push logs are not at {LOGS}.")
        return
    draws, seeds = (2, 1) if arguments.quick else (arguments.draws, arguments.seeds)
    asked = [
        (log, draw, seed)
        for draw in range(arguments.seed, arguments.seed + draws)
        for log in arguments.logs
        for seed in range(seeds)
    ]
    torch.set_num_threads(1)
    done = swept(run, asked, file=arguments.file, jobs=arguments.jobs)
    results = [Run(*one) for _, runs in done for one in runs]

    rows: list[Row] = []
    lines: list[list[float | int | str]] = []
    for count in COUNTS:
        for log in [*arguments.logs, "all"]:
            runs = [one for one in results if one.count == count and log in (one.log, "all")]
            numbers = summary(runs)
            lines.append([log, count, len(runs), *numbers])
            if log != "all":
                continue
            name = f"{count} pushes"
            rows += [
                Row(f"{name}: position, median", numbers[0], "mm"),
                Row(f"{name}: position, 99 %", numbers[2], "mm"),
                Row(f"{name}: position, worst", numbers[3], "mm", WRONG if count == max(COUNTS) else None),
                Row(f"{name}: off by more than {WRONG:g} mm and silent", numbers[5], f"of {len(runs)}", 0.0),
                Row(f"{name}: warned though sure and within {WRONG:g} mm", numbers[8], "%", 3.0),
            ]
    columns = ["log", "K", "runs", "median mm", "90 %", "99 %", "worst", f"> {WRONG:g} mm", "silent"]
    columns += ["holds %", "warned %", "good warned %", "s"]
    show(f"real pushes: {draws} draws of each log, {seeds} seeds", columns, lines)
    for one in results:
        if one.position > WRONG and (one.count == max(COUNTS) or not (one.warned or one.holds)):
            print(one)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

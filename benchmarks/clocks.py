"""How late a wrench's clock is, estimated from a log: how far off, and whether the stated spread is true.

Logs of the bench's touches whose encoders run ahead while the peg rests on the part (an arm whose structure
yields), and that do not; and logs of touching arms that are made by their own equations of motion: arms that
yield as springs or follow their command whatever they meet, and stop by a threshold of force or by time, with
friction, bounces, sliding, filters, a heavy tool, seldom or jittering poses.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from joblib import Parallel, delayed
from report import Row, cores, finish, options, show

from bcppl.recordings.importers.bench import clocks
from bcppl.recordings.importers.bench.clocks import lateness
from bcppl.recordings.importers.bench.log import imported

sys.path.insert(0, str(Path(__file__).parents[1]))  # the logs are those that the tests are made of
from tests.recordings.importers.bench_logs import Log, truth, write
from tests.recordings.importers.touching_arms import TouchingArm, touching

WITHIN = 0.05  # s: lateness is drawn from -50 to 50 ms
BENDS = {"the structure yields by 20 um/N": 2e-5, "the structure does not yield": 0.0}
ARMS = "other touching arms"
GOAL = 2.0  # ms, where the motion shows it
HONEST = 3.5  # stated spreads


class Found(NamedTuple):
    """Of one log: how late the force is, the estimate and its stated spread, in ms; NaN unless known."""

    late: float
    estimate: float
    spread: float


def of(late: float, estimate: clocks.Lateness | None) -> Found:
    """An estimate beside the truth, s."""
    if estimate is None:
        return Found(1e3 * late, np.nan, np.nan)
    return Found(1e3 * late, 1e3 * estimate.late, 1e3 * estimate.spread)


def of_bench(bends: float, seed: int) -> Found:
    """A log of the bench, through its files and the import."""
    rng = np.random.default_rng(seed)
    late = float(rng.uniform(-WITHIN, WITHIN))
    log = Log(late=late, bends=bends, noise=(0.1, 0.005, float(rng.choice([2e-5, 5e-5]))), seed=seed)
    estimates: list[clocks.Lateness | None] = []

    def kept(*given: Any) -> clocks.Lateness | None:
        estimates.append(lateness(*given))
        return estimates[-1]

    with tempfile.TemporaryDirectory() as folder, patch.object(clocks, "lateness", kept):
        imported(write(Path(folder), truth(seed, 1.0), log))
    return of(late, estimates[0])


def of_arm(seed: int) -> Found:
    """A log of an arm that is drawn at random, nearly half of them with one peculiarity."""
    rng = np.random.default_rng(seed)

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    yields = rng.random() < 0.5
    arm = {
        "seed": seed,
        "late": float(rng.uniform(-WITHIN, WITHIN)),
        "touches": int(rng.integers(4, 9)),
        "stiffness": between(1e3, 5e3) if yields else None,
        "mass": between(3.0, 8.0),
        "damping": float(rng.uniform(0.5, 1.0)),
        "contact": between(1e4, 4e5),
        "oblique": float(rng.uniform(0.0, 0.3)),
        "speed": between(0.003, 0.03),
        "threshold": 1000.0 if yields else float(rng.uniform(3.0, 10.0)),
        "latency": float(rng.uniform(0.0, 0.03)),
        "braking": between(0.15, 2.0),
        "press": float(rng.uniform(0.15, 0.5)),
        "rest": float(rng.choice([0.0, 0.2])),
        "dissipation": between(0.3, 10.0),
        "force_noise": float(rng.uniform(0.05, 0.3)),
        "pose_noise": between(1e-5, 5e-5),
    }
    peculiar = (
        {},
        {"friction": 0.4, "oblique": 0.7},
        {"dissipation": 3.0},
        {"slowed": 0.8},
        {"sliding": 0.01},
        {"force_filter": (1, float(rng.uniform(15.0, 100.0)))},
        {"pose_filter": (2, float(rng.uniform(15.0, 50.0)))},
        {"tool": 0.8},
        {"pose_rate": 125.0},
        {"jitter": 0.002},
    )
    if rng.random() < 0.5:
        arm |= peculiar[rng.integers(len(peculiar))]
    force, position, late = touching(TouchingArm(**arm))  # type: ignore[arg-type]
    return of(late, lateness(force, position, within=0.1))


def judged(name: str, found: Sequence[Found]) -> list[Row]:
    """A table of the logs of one kind, and its rows."""
    known = np.array([one for one in found if not np.isnan(one.spread)]).reshape(-1, 3)
    off, spread = np.abs(known[:, 0] - known[:, 1]), known[:, 2]
    show(
        f"{name}: {len(known)} of {len(found)} logs show it",
        ["of the lateness", "median", "90 %", "99 %", "worst"],
        [
            [what, *(np.quantile(values, [0.5, 0.9, 0.99, 1.0]) if len(values) else [np.nan] * 4)]
            for what, values in (
                ("error, ms", off),
                ("stated spread, ms", spread),
                ("error over the stated spread", off / spread),
            )
        ],
    )
    goal = GOAL if name == next(iter(BENDS)) else None
    return [
        Row(f"{name}: largest error where it is known", off.max(initial=0.0), "ms", goal),
        Row(f"{name}: known", len(known) / len(found), "share"),
        Row(f"{name}: largest error over the stated spread", (off / spread).max(initial=0.0), "", HONEST),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Estimate, show and finish."""
    parser = options(__doc__)
    parser.add_argument("--logs", type=int, default=100, help="of each kind")
    parser.add_argument("--jobs", type=int, default=cores(), help="logs at a time")
    given = parser.parse_args(arguments)
    seeds = range(given.seed, given.seed + (3 if given.quick else given.logs))

    kinds = {name: partial(of_bench, bends) for name, bends in BENDS.items()} | {ARMS: of_arm}
    rows = []
    for name, made in kinds.items():
        rows += judged(name, list(Parallel(given.jobs)(delayed(made)(seed) for seed in seeds)))
    finish(rows, given.json)


if __name__ == "__main__":
    main()

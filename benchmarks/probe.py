"""How well and how fast a simulated 6 s probe finds a hole: two depth views, then twelve touch windows."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from report import Row, finish, options, show

from bcppl.inference.filters.guided_smc import infer
from bcppl.models.peg_in_hole import model
from bcppl.models.worlds.peg_in_hole import simulate_recording
from bcppl.sweeps import in_order

PARTICLES = 75


class Result(NamedTuple):
    """One run: weighted ADD (mm) at three times, the belief at the end, and what it cost (s).

    `simulated` counts seconds of the rollouts' own clocks, `wall` is from the prior to the last belief.
    """

    prior: float
    vision: float
    end: float
    truth_gap: float
    effective: float
    distinct: int
    wall: float
    rendering: float
    physics: float
    simulated: float


COLUMNS = (
    "prior mm",
    "vision mm",
    "end mm",
    "truth gap",
    "ESS",
    "distinct",
    "wall s",
    "rendering s",
    "physics s",
    "simulated s",
)


def run(seed: int) -> Result:
    """Makes the recording of a seed and finds the hole in it."""
    recording = simulate_recording(seed)
    points, kinds = recording.part.surface_points(), [m.kind for m in recording.measurements]
    views = kinds.count("view")
    begun = time.perf_counter()
    scene = model.prepare(recording)
    steps = list(infer(model, recording, particles=PARTICLES, seed=seed, scene=scene))
    wall = time.perf_counter() - begun
    prior, vision, end = (1e3 * steps[k].belief.weighted_add(points, recording.truth) for k in (0, views, -1))
    last, efforts = steps[-1].info, [step.info.effort for step in steps[1:]]
    return Result(
        prior,
        vision,
        end,
        last.truth_gap,
        last.effective_sample_size,
        last.distinct,
        wall,
        sum(e["rendering"].seconds for e in efforts),
        sum(e["physics"].seconds for e in efforts),
        sum(e["physics"].amount for e in efforts),
    )


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument(
        "--jobs", type=int, default=1, help="runs at a time; with more than one, times mean nothing"
    )
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + (2 if arguments.quick else 20))
    results = list(in_order(run, seeds, arguments.jobs))
    columns = {
        name: np.array(column, dtype=float)
        for name, column in zip(Result._fields, zip(*results, strict=True), strict=True)
    }

    def line(name: str, numbers: Sequence[float]) -> list[str | float]:
        return [name, *numbers]

    lines = [line(f"seed {seed}", result) for seed, result in zip(seeds, results, strict=True)]
    lines.append(line("median", [float(np.median(column)) for column in columns.values()]))
    lines.append(line("90 %", [float(np.quantile(column, 0.9)) for column in columns.values()]))
    show(
        f"simulated probe: ADD weighted by particles, {PARTICLES} particles, {arguments.jobs} at a time",
        ["", *COLUMNS],
        lines,
    )

    def median(name: str) -> float:
        return float(np.median(columns[name]))

    alone = arguments.jobs == 1
    finish(
        [
            Row("weighted ADD of the prior, median", median("prior"), "mm"),
            Row("weighted ADD after vision, median", median("vision"), "mm"),
            Row("weighted ADD at the end, median", median("end"), "mm", 3.0),
            Row("weighted ADD at the end, 90 %", float(np.quantile(columns["end"], 0.9)), "mm"),
            Row("truth gap at the end, median", median("truth_gap"), "nats", -5.0, "min"),
            Row("truth gap at the end, worst", float(columns["truth_gap"].min()), "nats", -5.0, "min"),
            Row("ESS at the end, median", median("effective"), "particles", direction="min"),
            Row("distinct at the end, fewest", float(columns["distinct"].min()), "particles", 60.0, "min"),
            Row("wall, median", median("wall"), "s", 20.0 if alone else None),
            Row("rendering, median", median("rendering"), "s"),
            Row("physics, median", median("physics"), "s"),
            Row("simulated, median", median("simulated"), "s"),
        ],
        arguments.json,
    )


if __name__ == "__main__":
    main()

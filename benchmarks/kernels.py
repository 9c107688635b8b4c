"""How well kernels move particles: exact problems beside other packages, and a real image.

1. Two problems whose evidence is known, every kernel in tempered SMC: error of log Z and effective draws.
2. The same problems beside `particles` and BlackJAX, at the same number of likelihood calls.
3. A real depth image (a frame of LM-O), every kernel that can move a pose.

"Effective" counts independent draws that would estimate the posterior mean as well as one run does, from the
scatter of several runs, so copies of a particle count once.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from beside import TIMED, beside, timed
from evidence import PROBLEMS, Method, Outcome, effective, run
from kernel_table import POSES, VECTORS
from report import DATA, Row, finish, options, show

from bcppl import poses
from bcppl.inference import smc, tempered
from bcppl.inference.kernels import Kernel
from bcppl.models import part_in_view
from bcppl.recordings.importers.bop import command
from bcppl.sweeps import in_order

SCENE = DATA / "lmo_scene2_frame3"
OBJECT = 5
PARTICLES = 75
COUNTS = (75, 1000, 10_000)
# Moves that align a part to depth read likelihoods of independent pixels.
IN_VIEW = replace(
    part_in_view.model, prepare=partial(part_in_view.prepare, clutter=False, shift=0.0), proposals=()
)


class Posed(NamedTuple):
    """One run over a recording: the belief in brief and what it cost.

    `mean` (7,) and `spread` (6,) are the posterior's in metres and radians.
    """

    log_evidence: float
    distinct: int
    images: int
    seconds: float
    mean: list[float]
    spread: list[float]


def scatter(results: list[Posed]) -> float:
    """Effective draws of a run, from the scatter of the posterior means of several (two or more)."""
    means = torch.tensor([one.mean for one in results], dtype=torch.float64)
    middle = means[0]
    for _ in range(5):
        middle = poses.retract(middle, poses.local(middle, means).mean(0))
    off = poses.local(middle, means)
    within_runs = torch.tensor([one.spread for one in results], dtype=torch.float64).square().mean(0)
    deviations = off / (within_runs + off.square().mean(0)).sqrt()
    moved = within_runs > 0.0
    # The runs' own mean was taken away, which makes their scatter look smaller.
    return effective((deviations[:, moved] * (len(results) / (len(results) - 1)) ** 0.5).tolist())


def tables(seeds: range) -> list[Row]:
    """Every kernel on the two exact problems."""
    rows: list[Row] = []
    for name, problem in PROBLEMS.items():
        lines: list[list[Any]] = []
        for title, (make, sweeps) in VECTORS.items():
            outcomes = [run(problem, Method(make("x"), sweeps), 1000, seed) for seed in seeds]
            columns = Outcome(*map(np.array, zip(*outcomes, strict=True)))  # type: ignore[arg-type]
            seconds, calls = float(np.median(columns.seconds)), float(np.mean(columns.calls))
            draws = effective([outcome.deviation for outcome in outcomes])
            squared = float(np.mean(np.square(columns.error)))
            lines.append(
                [
                    title,
                    f"{np.mean(columns.error):+.3f}",
                    f"{np.std(columns.error):.3f}",
                    draws,
                    draws / seconds,
                    1e3 * draws / calls,
                    int(calls),
                    f"{squared * calls:.0f}",
                    float(np.median(columns.distinct)),
                    seconds,
                ]
            )
            rows += [
                Row(f"{name}, {title}: log Z error, mean", float(np.mean(columns.error)), "nats"),
                Row(f"{name}, {title}: log Z error, sd", float(np.std(columns.error)), "nats"),
                Row(f"{name}, {title}: effective per second", draws / seconds, "1/s", direction="min"),
                Row(f"{name}, {title}: likelihood calls, mean", calls, "calls"),
                Row(f"{name}, {title}: squared error times calls", squared * calls, "nats^2"),
                Row(
                    f"{name}, {title}: distinct, median",
                    float(np.median(columns.distinct)),
                    "particles",
                    direction="min",
                ),
            ]
        show(
            f"{name}: every kernel, 1000 particles, {len(seeds)} runs",
            [
                "kernel",
                "log Z error",
                "sd",
                "effective",
                "per s",
                "per 1000 calls",
                "calls",
                "error^2 x calls",
                "distinct",
                "s",
            ],
            lines,
        )
    return rows


def look(asked: tuple[str, int, int]) -> Posed:
    """One run of a kernel over the real depth image."""
    name, recording_seed, seed = asked
    recording = command(SCENE, object_id=OBJECT, seed=recording_seed)
    make, sweeps = POSES[name]
    return posed(IN_VIEW, recording, make("part"), sweeps, 0.6, seed)


def posed(model: Any, recording: Any, kernel: Kernel, sweeps: int, share: float, seed: int) -> Posed:
    """One run of tempered SMC over a recording."""
    scene = model.prepare(recording)
    step = tempered(kernel, sweeps=sweeps, share=share)
    begun = time.perf_counter()
    steps = smc(model, recording, step=step, particles=PARTICLES, seed=seed, scene=scene)
    *_, last = steps
    seconds = time.perf_counter() - begun
    return Posed(
        last.info.log_evidence,
        last.belief.distinct,
        scene.efforts["rendering"].items,
        seconds,
        last.belief.mean.tolist(),
        last.belief.spread.tolist(),
    )


def images(seed: int, runs: int, jobs: int) -> list[Row]:
    """Every kernel on one real depth image."""
    if not SCENE.is_dir():
        print(f"the real image is left out: the scene is not at {SCENE}.")
        return []
    results = list(in_order(look, [(name, seed, seed + k) for name in POSES for k in range(runs)], jobs))
    rows: list[Row] = []
    lines: list[list[Any]] = []
    for k, name in enumerate(POSES):
        mine = results[k * runs : (k + 1) * runs]
        evidences = [one.log_evidence for one in mine]
        seconds, draws = float(np.median([one.seconds for one in mine])), scatter(mine)
        rendered = float(np.mean([one.images for one in mine]))
        kept = float(np.median([one.distinct for one in mine]))
        lines.append(
            [
                name,
                float(np.mean(evidences)),
                float(np.std(evidences)),
                draws,
                draws / seconds,
                int(rendered),
                kept,
                seconds,
            ]
        )
        rows += [
            Row(f"real image, {name}: log Z, mean", float(np.mean(evidences)), "nats", direction="min"),
            Row(f"real image, {name}: log Z, sd", float(np.std(evidences)), "nats"),
            Row(f"real image, {name}: effective per second", draws / seconds, "1/s", direction="min"),
            Row(f"real image, {name}: distinct, median", kept, "particles", direction="min"),
            Row(f"real image, {name}: images rendered, mean", rendered, "images"),
        ]
    show(
        f"real image: object {OBJECT} of an LM-O frame, {PARTICLES} particles, {runs} runs, {jobs} at a time",
        ["kernel", "log Z", "sd", "effective", "per s", "images", "distinct", "s"],
        lines,
    )
    return rows


PARTS = ("kernels", "peers", "image")


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="only these")
    parser.add_argument("--runs", type=int, help="beside other packages; 100 unless given")
    parser.add_argument("--counts", type=int, nargs="+", metavar="N", help="of the other packages' particles")
    parser.add_argument(
        "--jobs", type=int, default=1, help="runs over the image at a time; times then mean little"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    quick, seed = arguments.quick, arguments.seed
    rows: list[Row] = []
    if "kernels" in arguments.parts:
        rows += tables(range(seed, seed + (3 if quick else 50)))
    if "peers" in arguments.parts:
        counts = tuple(arguments.counts or (COUNTS[:1] if quick else COUNTS))
        rows += beside(seed, arguments.runs or (5 if quick else 100), counts)
        rows += timed(seed) if TIMED in counts else []
    if "image" in arguments.parts:
        rows += images(seed, 2 if quick else 10, arguments.jobs)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

"""Whether a belief from two depth cameras that are off is honest: with their errors latent, and without.

Every seed is a new bench, simulated by `bcppl.models.worlds.two_cameras`: two cameras whose stated poses are
off by 2 mm and half a degree (standard deviations for each axis), whose ranges are biased by 2 mm, one image
each. Both models are given the same recording and the default inference, without climbs.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from report import Row, finish, options, show
from scipy.stats import chi2

from bcppl import poses
from bcppl.inference.filters.tempered_smc import infer
from bcppl.models import camera_error, part_in_view
from bcppl.models.worlds.two_cameras import simulate_recording

NONE = replace(part_in_view.model, prepare=partial(part_in_view.prepare, shift=0.0), proposals=())
MODELS = {"latent errors": camera_error.model, "none": NONE}
MASS = 0.9


class Run(NamedTuple):
    """How one belief ended.

    Attributes:
        error: of the mean's position, mm.
        turned: of the mean's rotation, degrees.
        spread: root mean square of the standard deviations of the three positions, mm.
        distance: squared Mahalanobis distance of the truth from the mean.
        seconds: wall.
        own_seconds: of all cores, this process alone.
    """

    error: float
    turned: float
    spread: float
    distance: float
    seconds: float
    own_seconds: float


def run(name: str, seed: int, particles: int) -> Run:
    """One bench and one belief."""
    recording = simulate_recording(seed)
    begun, own = time.perf_counter(), time.process_time()
    *_, last = infer(MODELS[name], recording, particles=particles, seed=seed, climbs=0)
    seconds, own = time.perf_counter() - begun, time.process_time() - own
    belief = last.belief
    off = poses.local(belief.mean, torch.as_tensor(recording.truth))
    return Run(
        error=1e3 * float(off[:3].norm()),
        turned=math.degrees(float(off[3:].norm())),
        spread=1e3 * float(belief.spread[:3].square().mean().sqrt()),
        distance=float(off @ torch.linalg.solve(belief.covariance, off)),
        seconds=seconds,
        own_seconds=own,
    )


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--runs", type=int, default=20, help="seeds of each model")
    parser.add_argument("--particles", type=int, default=75, help="of every run")
    parser.add_argument("--models", nargs="*", choices=list(MODELS), default=list(MODELS), help="only these")
    arguments = parser.parse_args()
    count = 2 if arguments.quick else arguments.runs
    within = float(chi2.ppf(MASS, 6))
    rows, summary = [], []
    for name in arguments.models:
        runs = []
        for seed in range(arguments.seed, arguments.seed + count):
            runs.append(run(name, seed, arguments.particles))
            print(name, seed, *(f"{n} {v:.2f}" for n, v in runs[-1]._asdict().items()), flush=True)
        table = np.array(runs)
        distance = table[:, 3]
        held = 100.0 * float((distance <= within).mean())
        median, most = np.quantile(distance, [0.5, MASS]).tolist()
        middle = np.median(table, axis=0)
        summary.append([name, len(runs), *middle[:3], median, most, held, *middle[4:]])
        honest = name == "latent errors"
        rows += [
            Row(f"{name}: squared distance of the truth, median", median, "", 7.0 if honest else None),
            Row(f"{name}: squared distance of the truth, 90 %", most, ""),
            Row(f"{name}: 90 % regions that hold the truth", held, "%", 75.0 if honest else None, "min"),
            Row(f"{name}: position off, median", float(middle[0]), "mm"),
            Row(f"{name}: position off, worst", float(table[:, 0].max()), "mm"),
            Row(f"{name}: spread of a position, median", float(middle[2]), "mm"),
            Row(f"{name}: wall, median", float(middle[4]), "s"),
        ]
    columns = ["errors", "runs", "mean off mm", "deg", "spread mm", "d^2 median", "d^2 90 %"]
    title = f"two cameras that are off, {arguments.particles} particles; chi-square: {chi2.ppf(0.5, 6):.1f}"
    show(f"{title} and {within:.1f}", [*columns, "90 % hold", "s", "own s"], summary)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

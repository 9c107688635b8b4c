"""Accuracy on the simulated 6 s probe, with and without a likelihood of the wrench beside contacts."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from report import Row, finish, options, show

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.inference.filters.guided_smc import infer
from bcppl.models import peg_in_hole
from bcppl.models.worlds.peg_in_hole import simulate_recording
from bcppl.sweeps import in_order

PARTICLES = 75
WORLD = ContactParameters(time_step=0.0015, friction=0.2, time_constant=0.003)  # the world's own friction


TIGHT = {"force_scale": 0.3, "torque_scale": 0.02, "wrench_share": 0.15}
LOOSE = {"force_scale": 4.0, "torque_scale": 0.2, "wrench_share": 0.3}
BOTH = {"evidence": ("contacts", "pose", "wrench")}
PLAIN = {"evidence": ("contacts", "pose")}
# Settings of `peg_in_hole`.
VARIANTS: dict[str, dict[str, Any]] = {
    "contacts and pose": PLAIN,
    "and wrench": {**BOTH, **TIGHT},
    "and wrench, loose": {**BOTH, **LOOSE},
    "and wrench, loose, latent friction": {**BOTH, **LOOSE, "friction": (0.25, 0.6)},
    "wrench and pose, loose": {"evidence": ("pose", "wrench"), **LOOSE},
    "contacts and pose, the world's friction": {**PLAIN, "contact": WORLD},
    "and wrench, the world's friction": {**BOTH, **TIGHT, "contact": WORLD},
}


def run(task: tuple[str, int]) -> tuple[float, ...]:
    """The error and the spread of a variant's belief over the hole of a seed, and its cost."""
    name, seed = task
    model = peg_in_hole.model.with_settings(**VARIANTS[name])
    recording = simulate_recording(seed)
    begun = time.perf_counter()
    *_, last = infer(model, recording, particles=PARTICLES, seed=seed)
    wall = time.perf_counter() - begun
    belief = last.belief
    error = poses.local(belief.mean, torch.from_numpy(recording.truth))
    covariance = belief.covariance + 1e-12 * torch.eye(6, dtype=torch.float64)
    spread = covariance.diagonal()
    return (
        1e3 * belief.weighted_add(recording.part.surface_points(), recording.truth),
        1e3 * float(error[:3].norm()),
        float(torch.rad2deg(error[3:].norm())),
        1e3 * float(spread[:3].sum().sqrt()),
        float(torch.rad2deg(spread[3:].sum().sqrt())),
        float((error @ torch.linalg.solve(covariance, error)).sqrt()) / 6**0.5,
        last.info.truth_gap,
        last.info.effective_sample_size,
        wall,
    )


COLUMNS = (
    "ADD mm",
    "error mm",
    "error deg",
    "spread mm",
    "spread deg",
    "error/spread",
    "truth gap",
    "ESS",
    "wall s",
)


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument(
        "--jobs", type=int, default=1, help="runs at a time; with more than one, times mean nothing"
    )
    parser.add_argument("--runs", type=int, default=5, help="seeds of each variant")
    parser.add_argument("--variants", nargs="*", choices=list(VARIANTS), default=list(VARIANTS))
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + (1 if arguments.quick else arguments.runs))
    tasks = [(name, seed) for seed in seeds for name in arguments.variants]
    found = dict(zip(tasks, list(in_order(run, tasks, arguments.jobs)), strict=True))
    lines, rows = [], []
    for name in arguments.variants:
        lines += [[f"{name}, seed {seed}", *found[name, seed]] for seed in seeds]
        median = np.median([found[name, seed] for seed in seeds], axis=0)
        lines.append([f"{name}, median", *[float(value) for value in median]])
        for column, value in zip(COLUMNS, median, strict=True):
            *what, unit = column.rpartition(" ") if " " in column else (column, "", "")
            rows.append(Row(f"{name}: {''.join(what).strip()}, median", float(value), unit))
    show(f"simulated probe, {PARTICLES} particles", ["", *COLUMNS], lines)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

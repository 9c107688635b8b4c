"""How well real touches find a part: pushes of an aluminium triangle by a robot's finger.

The true pose is known. The finger and its scatter are learnt on one log, pushes drawn from another log are
explained. One run over the longest series gives the beliefs after every shorter one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import torch
from report import Row, cores, finish, options, show
from touches import LOGS, OTHER, PARTICLES, errors, explained, learnt, pushes

from bcppl.sweeps import in_order

LOG = "10_90"
COUNTS = (1, 2, 3, 5, 10, 20)
WRONG = 5.0  # mm: farther than this from the truth is another mode, not noise

# Settings of the model: the finger's calibration, and which sites it has.
VARIANTS: dict[str, tuple[bool, dict[str, Any]]] = {
    "default": (True, {}),
    "and free path": (True, {"use_free_path": True}),
    "no direction": (True, {"use_direction": False}),
    "no direction, free path": (True, {"use_direction": False, "use_free_path": True}),
    "offset and spread only": (False, {}),
}


class Result(NamedTuple):
    """The belief after some pushes: errors of its mean (mm, degrees), weighted ADD (mm), what it cost (s)."""

    position: float
    yaw: float
    add: float
    effective: float
    truth_gap: float
    seconds: float


def run(asked: tuple[str, int, tuple[int, ...]]) -> list[Result]:
    """The results of one variant on one draw, after each of the counts."""
    variant, seed, counts = asked
    calibrated, sites = VARIANTS[variant]
    recording = pushes(LOG, max(counts), seed)
    settings = {**asdict(learnt(OTHER[LOG], calibrated)), **sites}
    results = []
    for done, (step, seconds) in enumerate(explained(recording, seed, settings)):
        if done in counts:
            off = errors(step.belief.mean, recording)
            add = step.belief.weighted_add(recording.part.surface_points(), torch.as_tensor(recording.truth))
            results.append(
                Result(
                    off.position,
                    off.yaw,
                    1e3 * add,
                    step.info.effective_sample_size,
                    step.info.truth_gap,
                    seconds,
                )
            )
    return results


def summary(results: Sequence[Result]) -> list[float | int]:
    """One line of the table, from the draws of one variant and count."""
    columns = {
        name: np.array(column)
        for name, column in zip(Result._fields, zip(*results, strict=True), strict=True)
    }
    numbers: list[float | int] = []
    for name in ("position", "yaw"):
        numbers += [float(np.median(columns[name])), float(np.quantile(columns[name], 0.9))]
    numbers += [float(np.median(columns[name])) for name in ("add", "effective", "truth_gap", "seconds")]
    return [*numbers, int((columns["position"] > WRONG).sum())]


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--jobs", type=int, default=cores(), help="processes, of one thread each if several")
    arguments = parser.parse_args()
    if not LOGS.is_dir():
        print(f"skipped: the push logs are not at {LOGS}.")
        return
    draws, counts = (3, (1, 3, 10)) if arguments.quick else (20, COUNTS)
    seeds = range(arguments.seed, arguments.seed + draws)
    asked = [(variant, seed, counts) for variant in VARIANTS for seed in seeds]
    results = list(in_order(run, asked, arguments.jobs))

    rows: list[Row] = []
    lines: list[list[Any]] = []
    for v, variant in enumerate(VARIANTS):
        of_variant = results[v * draws : (v + 1) * draws]
        for k, count in enumerate(counts):
            numbers = summary([one[k] for one in of_variant])
            lines.append([variant, count, *numbers])
            judged = variant == "default" and count == 10
            name = f"{variant}, {count} pushes"
            rows += [
                Row(f"{name}: position, median", numbers[0], "mm", 1.0 if judged else None),
                Row(f"{name}: position, 90 %", numbers[1], "mm"),
                Row(f"{name}: yaw, median", numbers[2], "deg", 0.5 if judged else None),
                Row(f"{name}: yaw, 90 %", numbers[3], "deg"),
                Row(f"{name}: weighted ADD, median", numbers[4], "mm"),
                Row(f"{name}: ESS, median", numbers[5], "particles", direction="min"),
                Row(f"{name}: truth gap, median", numbers[6], "nats", direction="min"),
                Row(f"{name}: wall, median", numbers[7], "s"),
                Row(f"{name}: position off by more than {WRONG:g} mm", numbers[8], f"of {draws}"),
            ]
    columns = [
        "model",
        "K",
        "position mm",
        "90 %",
        "yaw deg",
        "90 %",
        "ADD mm",
        "ESS",
        "truth gap",
        "s",
        f"> {WRONG:g} mm",
    ]
    show(
        f"real pushes: medians over {draws} draws, {PARTICLES} particles, {arguments.jobs} at a time",
        columns,
        lines,
    )
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

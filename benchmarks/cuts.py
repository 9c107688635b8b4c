"""One probe, in windows of 10 ms to all of it, read at 50 to 500 Hz: the same belief in the same time.

A scene of `foreign_world` is tapped and pressed. Each recording is assimilated after the same two views, with
the same seeds. Two beliefs differ by chance where the distance of their means is small against the spread.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from foreign_world import log_of, recording_of, scene_of, windows
from report import Row, finish, options, show

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.filters.smc import Step
from bcppl.models.look_and_touch import model
from bcppl.sensors import Recording
from bcppl.sensors.probe import Touch

CUTS = {"10 ms": 0.01, "0.1 s": 0.1, "0.5 s": 0.5, "whole": math.inf}
USUAL = "0.5 s"
RATES = 50, 100, 500
PARTICLES, SCENES = 75, 5


class Cut(NamedTuple):
    """What comes of one recording, at one rate, in windows of one length."""

    seed: int
    manner: str
    rate: int
    cut: str
    belief: Belief
    add: float  # mm, weighted
    spread: float  # mm, of the translation
    seconds: float
    log_evidence: float  # of the touches


def recut(recording: Recording, seconds: float) -> Recording:
    """The recording of one probe after two views, in windows of another length."""
    views, touched = recording.measurements[:2], recording.measurements[2:]
    probe = touched[0].action.probe
    touches = [each.observation for each in touched]
    whole = Touch(
        *(
            np.concatenate([getattr(one, name) for one in touches])
            for name in ("times", "wrench", "world_from_peg")
        )
    )
    step = float(np.median(np.diff(probe.stamps)))
    length = len(probe.stamps) if math.isinf(seconds) else max(1, round(seconds / step))
    return replace(recording, measurements=[*views, *windows(probe, whole, length)])


def after_views(recording: Recording, seed: int) -> Step:
    """The last step of a run over the two views."""
    *_, last = infer(
        model, replace(recording, measurements=recording.measurements[:2]), particles=PARTICLES, seed=seed
    )
    return last


def cut_up(recording: Recording, start: Step, seed: int, manner: str, rate: int, cut: str) -> Cut:
    """The belief after all windows."""
    given, begun = recut(recording, CUTS[cut]), time.process_time()
    *_, last = infer(model, given, particles=PARTICLES, seed=seed, start=start)
    seconds = time.process_time() - begun
    belief = last.belief
    spread = math.sqrt(float(belief.covariance[:3, :3].trace()))
    add = belief.weighted_add(recording.part.surface_points(), recording.truth)
    evidence = last.info.log_evidence - start.info.log_evidence
    return Cut(seed, manner, rate, cut, belief, 1e3 * add, 1e3 * spread, seconds, evidence)


def apart(one: Belief, other: Belief) -> float:
    """Distance of two beliefs' means, in standard deviations of their mean covariance, per axis."""
    off = poses.local(one.mean, other.mean)
    covariance = 0.5 * (one.covariance + other.covariance)
    return math.sqrt(float(off @ torch.linalg.solve(covariance, off)) / 6.0)


def rows_of(cuts: Sequence[Cut]) -> list[Row]:
    """Of every cut against the usual one of the same rate, and of every rate against 100 Hz."""
    rows, usual = list[Row](), {(c.seed, c.manner, c.rate): c for c in cuts if c.cut == USUAL}
    for (manner, rate), own in itertools.groupby(
        sorted(cuts, key=lambda c: (c.manner, c.rate)), lambda c: (c.manner, c.rate)
    ):
        several = list(own)
        for name in CUTS:
            these = [c for c in several if c.cut == name]
            off = max(apart(c.belief, usual[c.seed, manner, rate].belief) for c in these)
            slow = float(np.median([c.seconds / usual[c.seed, manner, rate].seconds for c in these]))
            title = f"{manner}, {rate} Hz, {name}"
            rows.append(Row(f"{title}: from {USUAL}", off, "standard deviations per axis", 1.0))
            rows.append(Row(f"{title}: time over that of {USUAL}", slow, "", 2.0))
        same = [c for c in several if c.cut == USUAL]
        between = max(apart(c.belief, usual[c.seed, manner, 100].belief) for c in same)
        rows.append(Row(f"{manner}, {rate} Hz: from 100 Hz", between, "standard deviations per axis"))
        rows.append(Row(f"{manner}, {rate} Hz: ADD", float(np.median([c.add for c in same])), "mm"))
    return rows


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, help=f"how many; {SCENES}, with --quick 1")
    given = parser.parse_args()
    count = given.scenes if given.scenes is not None else 1 if given.quick else SCENES
    rates, manners = ((100,), ("taps",)) if given.quick else (RATES, ("taps", "presses"))
    cuts: list[Cut] = []
    for seed in range(given.seed, given.seed + count):
        scene, start = scene_of(seed), None
        for manner in manners:
            log = log_of(scene, manner, "softer")
            for rate in rates:
                recording = recording_of(scene, manner, "softer", rate, log)
                start = after_views(recording, seed) if start is None else start
                for name in CUTS:
                    one = cut_up(recording, start, seed, manner, rate, name)
                    cuts.append(one)
                    print(
                        f"{seed}, {manner}, {rate} Hz, {name}: {one.add:.3f} mm, spread {one.spread:.3f} mm, "
                        f"log evidence {one.log_evidence:.2f}, {one.seconds:.1f} s",
                        flush=True,
                    )
    columns = ["scene", "manner", "Hz", "windows", "ADD mm", "spread mm", "log evidence", "cpu s"]
    show(
        "one probe, cut and read differently",
        columns,
        [[c.seed, c.manner, c.rate, c.cut, c.add, c.spread, c.log_evidence, c.seconds] for c in cuts],
    )
    finish(rows_of(cuts), given.json)


if __name__ == "__main__":
    main()

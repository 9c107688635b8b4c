"""A belief that follows a probe played at its own pace: how late its updates are, and what it ends at.

Scenes of the accuracy bench, their probe played in windows of a quarter of a second; the second run of each
is at twice the pace. Beside the live belief stands that of the same run over the whole recording. Run it
alone: it measures wall time.
"""

from __future__ import annotations

import math
import time
from typing import NamedTuple

import numpy as np
from report import Row, finish, options, show
from scenes import PARTICLES, model, quantile

from bcppl.beliefs import Belief
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.live import Filter, play
from bcppl.inference.planning.metrology import three_two_one
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.sensors import Measurement, ProbeWindow, Recording, Touch

WINDOW = 0.25  # s
DEADLINE = 0.5  # s, a cell: a belief changes twice a second
IN_TIME, LOST = 95.0, 0.0


class Played(NamedTuple):
    """One scene at one pace.

    Attributes:
        seconds: of each update, from the arrival of its window.
        joined, fewest: windows that were joined with others, and the fewest particles.
        lost: stamps of the probe that the belief was not given.
        apart: mean of the live belief from that of the batch run, in the batch's standard deviations.
        add, batch_add: weighted ADD at the end, mm.
    """

    seconds: list[float]
    joined: int
    fewest: int
    lost: int
    apart: float
    add: float
    batch_add: float


def windows_of(recording: Recording) -> list[Measurement]:
    """A recording's measurements, its windows cut to quarters of a second."""
    cut = []
    for each in recording.measurements:
        window, touch = each.action, each.observation
        if not isinstance(window, ProbeWindow):
            cut.append(each)
            continue
        size = max(1, round(WINDOW / float(np.median(np.diff(window.probe.stamps)))))
        for first in range(window.first, window.last, size):
            last = min(first + size, window.last)
            part = slice(first - window.first, last - window.first)
            own = Touch(touch.times[part], touch.wrench[part], touch.world_from_peg[part])
            cut.append(Measurement(ProbeWindow(window.probe, first, last), own))
    return cut


def played(seed: int, speed: float) -> Played:
    """One scene's probe, played."""
    scene = bench_scene(seed)
    look = scene.look()
    *_, seen = infer(model, look, particles=PARTICLES, seed=seed)
    recording = scene.probe(three_two_one(seen.belief, scene.part, scene.peg))
    *_, batch = infer(model, recording, particles=PARTICLES, seed=seed, start=seen)
    touches = [each for each in windows_of(recording) if isinstance(each.action, ProbeWindow)]
    with Filter(model, look, particles=PARTICLES, seed=seed, deadline=DEADLINE / speed) as live:
        live.settle()
        before = len(live.updates)
        for each in play(Recording(recording.part, recording.guess, touches, recording.peg), speed):
            live.observe(each.action, each.observation)
        belief = live.settle().belief
        updates = live.updates[before:]
        had = [m for m in live.recording.measurements if isinstance(m.action, ProbeWindow)]
    lost = len(touches[0].action.probe.stamps) - sum(m.action.last - m.action.first for m in had)
    points, truth = scene.part.surface_points(), recording.truth
    return Played(
        [update.seconds for update in updates],
        sum(update.joined - 1 for update in updates),
        min(update.particles for update in updates),
        lost,
        distance(belief, batch.belief),
        1e3 * belief.weighted_add(points, truth),
        1e3 * batch.belief.weighted_add(points, truth),
    )


def distance(belief: Belief, other: Belief) -> float:
    """The mean's distance from another's, per axis root mean square, in the other's standard deviations."""
    tangent = (belief.mean - other.mean)[:3]
    return float((tangent / other.spread[:3].clamp_min(1e-6)).square().mean().sqrt())


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--speed", type=float, nargs="+", default=[1.0, 2.0])
    arguments = parser.parse_args()
    count = 1 if arguments.quick else arguments.scenes
    lines, rows = [], []
    for speed in arguments.speed:
        begun = time.perf_counter()
        runs = [played(arguments.seed + 20000 + k, speed) for k in range(count)]
        seconds = [each for run in runs for each in run.seconds]
        limit = WINDOW / speed
        share = 100.0 * float(np.mean([each <= limit for each in seconds]))
        lost = sum(run.lost for run in runs)
        levels = [quantile(seconds, level) for level in (0.5, 0.95, 1.0)]
        lines.append(
            [
                f"at {speed:g} times its pace",
                len(runs),
                *levels,
                share,
                sum(run.joined for run in runs),
                min(run.fewest for run in runs),
                quantile([run.apart for run in runs], 0.5),
                quantile([run.apart for run in runs], 1.0),
                quantile([run.add for run in runs], 0.5),
                quantile([run.batch_add for run in runs], 0.5),
            ]
        )
        goal = IN_TIME if math.isclose(speed, 1.0) else None
        rows += [
            Row(f"x {speed:g}: updates before the next window ends", share, "%", goal, "min"),
            Row(f"x {speed:g}: updates, 95 %", levels[1], "s"),
            Row(f"x {speed:g}: stamps that were lost", lost, "", LOST),
            Row(f"x {speed:g}: wall for a scene", (time.perf_counter() - begun) / count, "s"),
        ]
    columns = ["", "scenes", "update s", "95 %", "latest", "in time %", "joined", "fewest", "off batch, sd"]
    show("a probe as it is made", [*columns, "worst", "ADD mm", "batch"], lines)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

"""How often credible regions hold the truth: over scenes of the accuracy bench, and where its model is wrong.

Regions of a belief of mass 0.9 are to hold the truth in nine of ten scenes, of mass 0.5 in half. A scene that
ends in an error holds it in none. Two variants are worlds that the model does not know of: a box hides a part
of one camera's view, or the cameras are off by twice what is stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import real
import touches
from accuracy import lost, misses, of, report
from report import Row, finish, options, show
from scenes import END, MASSES, PARTICLES, REGIONS, VISION, Probed, every, probed, quantile
from scipy.stats import binomtest

from bcppl.models.worlds.bench.parameters import BenchParameters

CONFIDENCE = 0.99  # of the intervals of a share
WITHIN = {0.9: (84.0, 95.0), 0.5: (41.0, 59.0)}  # %, what 200 scenes of true regions stay within
LEAST = 75.0  # %, of the 90 % regions where the model is wrong
SCENES, WRONG = 200, 50
WORLDS = {
    "as stated": BenchParameters(),
    "occluder": BenchParameters(occluder=True),
    "cameras off twice as far": BenchParameters(camera_error_factor=2.0),
}


class Share(NamedTuple):
    """How often a region held the truth: in how many scenes of how many, and the interval of the share, %."""

    held: int
    scenes: int
    low: float
    high: float

    @property
    def percent(self) -> float:
        """The share."""
        return 100.0 * self.held / self.scenes


def share_of(held: Sequence[bool]) -> Share:
    """With the exact binomial interval (Clopper and Pearson)."""
    interval = binomtest(sum(held), len(held)).proportion_ci(CONFIDENCE)
    return Share(sum(held), len(held), 100.0 * interval.low, 100.0 * interval.high)


def of_world(name: str, seeds: Sequence[int], particles: int, jobs: int) -> list[Row]:
    """The table of one world and its rows."""
    bench = WORLDS[name]
    found: list[Probed] = []
    try:
        for one in every(partial(probed, particles=particles, bench=bench), seeds, jobs, lost):
            found.append(one)
            report(one)
    except KeyboardInterrupt:
        print(f"interrupted: what follows is of {len(found)} scenes of {len(seeds)}.", flush=True)
    if not found:
        return []
    rows, lines = list[Row](), list[list[Any]]()
    for moment in (VISION, END):
        for region in REGIONS:
            for mass in MASSES:
                share = share_of([one.held(moment, region, mass) for one in found])
                when = f"{'after' if moment == VISION else 'at'} {moment}"
                region_named = f"{region}, {100 * mass:.0f} % region {when}"
                lines.append([region_named, share.held, share.scenes, share.percent, share.low, share.high])
                title = f"{name}: {region_named} holds the truth"
                rows += goals_of(title, share, mass, moment == END, name == "as stated")
    show(
        f"{name}: how often regions hold the truth, {100 * CONFIDENCE:.0f} % interval",
        ["", "held", "scenes", "%", "from %", "to %"],
        lines,
    )
    for level, words in ((0.5, "median"), (0.9, "90 %")):
        add = quantile(of(found, END, "weighted_add"), level)
        rows.append(Row(f"{name}: weighted ADD at 6 s, {words}", add if np.isfinite(add) else np.nan, "mm"))
    # Sure and wrong: outside what nine of ten draws lie in, and by more than a probe that went well leaves.
    far = [one for one in found if not one.held(END, "ADD-radius", 0.9) and one.at(END).add > 2.0]
    rows.append(Row(f"{name}: outside the 90 % ADD-radius and over 2 mm off", len(far), "scenes"))
    silent = sum(not one.warned for one in far)
    rows.append(
        Row(f"{name}: outside the 90 % ADD-radius, over 2 mm off, without a warning", silent, "scenes", 0.0)
    )
    rows.append(Row(f"{name}: scenes with a warning", sum(one.warned for one in found), "scenes"))
    rows.append(Row(f"{name}: scenes missed", sum(bool(one.missed) for one in found), "scenes"))
    for one in far:
        warned = "with" if one.warned else "without"
        print(f"outside and far, {one.name}: ADD {one.at(END).add:.2f} mm, {warned} a warning")
    misses(found)
    return rows


def goals_of(title: str, share: Share, mass: float, judged: bool, stated: bool) -> list[Row]:
    """Rows of one share: between two bounds where the model is right, above one where it is wrong."""
    if judged and stated:
        low, high = WITHIN[mass]
        return [
            Row(f"{title}, at least", share.percent, "%", low, "min"),
            Row(f"{title}, at most", share.percent, "%", high),
        ]
    if judged and mass == 0.9:
        return [Row(title, share.percent, "%", LEAST, "min")]
    return [Row(title, share.percent, "%")]


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--scenes", type=int, help=f"how many; {SCENES}, and {WRONG} of each variant")
    parser.add_argument("--only", choices=list(WORLDS), help="one of the worlds")
    parser.add_argument("--particles", type=int, default=PARTICLES)
    parser.add_argument("--jobs", type=int, default=2, help="scenes at a time")
    parser.add_argument("--real", action="store_true", help="the real pushes too, by benchmarks/real.py")
    given = parser.parse_args()
    rows: list[Row] = []
    for name in WORLDS:
        if given.only in (None, name):
            most = SCENES if name == "as stated" else WRONG
            count = given.scenes if given.scenes is not None else 2 if given.quick else most
            rows += of_world(name, range(given.seed, given.seed + count), given.particles, given.jobs)
    if given.real:
        if touches.LOGS.is_dir():
            rows += real.calibration(given.jobs, given.seed, 1 if given.quick else 4)
        else:
            print(f"skipped: the push logs are not at {touches.LOGS}.")
    finish(rows, given.json)


if __name__ == "__main__":
    main()

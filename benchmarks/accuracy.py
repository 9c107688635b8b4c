"""How accurately a hole is found, over many scenes that inference was not tuned to, each with another part.

A scene is two depth views from cameras that are off, then a 6 s probe planned from the belief after vision by
one fixed rule, carried out in a finer world whose friction and stiffness inference does not know. A scene
that ends in an error counts as infinitely far off.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import ablations
import curves
import numpy as np
from report import Row, finish, options, show
from scenes import (
    END,
    MASSES,
    MOMENTS,
    PARTICLES,
    REGIONS,
    VISION,
    Moment,
    Probed,
    apart,
    by,
    every,
    probed,
    probed_from,
    quantile,
)

SCENES, TIMED, ABLATED = 100, 20, 25
GOALS = (0.8, 0.4)  # mm, of the median ADD at the end
GROWTH = (75, 300, 1000, 3000, 10000)
NAMES = (
    "weighted ADD",
    "ADD",
    "ADD-S",
    "along",
    "across",
    "rotation",
    "tilt",
    "yaw",
)  # of a moment's numbers
WORDS = dict(zip(Moment._fields, NAMES, strict=True))
UNITS = dict.fromkeys(Moment._fields[:5], "mm") | dict.fromkeys(Moment._fields[5:], "deg")
STAGES = (VISION, "planning", "touch")
LATENCIES = {"view": 0.5, "window": 0.25}  # s, of 95 % of the measurements
TAILS = (("90 %", 0.9), ("99 %", 0.99), ("worst", 1.0))
TAIL_GOALS = {0.9: 0.35, 0.99: 1.0, 1.0: 2.0}  # mm, of the ADD at the end
COVERED = {0.5: 41.0, 0.9: 84.0}  # % of scenes, at least: the 99 % interval of 200 scenes


def all_scenes(seeds: Sequence[tuple[int, int | None]], particles: int, jobs: int) -> list[Probed]:
    """All scenes and seeds in order, reported as they come; an interrupted run keeps what it has."""
    found: list[Probed] = []
    try:
        for one in every(partial(probed_from, particles=particles), seeds, jobs, lost):
            found.append(one)
            report(one)
    except KeyboardInterrupt:
        print(f"interrupted: what follows is of {len(found)} scenes of {len(seeds)}.", flush=True)
    return sorted(found, key=lambda one: (one.seed, one.inference_seed or 0))


def lost(seeds: tuple[int, int | None], why: str) -> Probed:
    """A scene whose process died."""
    return Probed(seeds[0], missed=why, inference_seed=seeds[1])


def report(one: Probed) -> None:
    """One line on a scene."""
    end = f"MISSED: {one.missed}" if one.missed else f"{one.at(END).weighted_add:.3f} mm in {one.wall:.1f} s"
    print(f"{one.name}: vision {one.at(VISION).weighted_add:.2f} mm, end {end}", flush=True)


def of(found: Sequence[Probed], moment: str, what: str) -> list[float]:
    """One number of every scene, infinite where it was missed."""
    return [getattr(one.at(moment), what) for one in found]


def per_scene(found: Sequence[Probed]) -> None:
    """A line for every scene, then the medians and the tails."""
    columns = [
        *[f"ADD {moment}" for moment in MOMENTS],
        *NAMES[1:],
        *[f"{stage} s" for stage in STAGES],
        "tempered",
        "warned",
        "in 50/90 %",
    ]

    def numbers(one: Probed) -> list[float]:
        return [
            *[one.at(moment).weighted_add for moment in MOMENTS],
            *one.at(END)[1:],
            *[one.seconds.get(stage, math.nan) for stage in STAGES],
        ]

    def inside(one: Probed) -> str:
        return " ".join("/".join("yn"[not one.held(END, r, m)] for m in MASSES) for r in REGIONS)

    lines: list[list[Any]] = [
        [one.name, *numbers(one), one.tempered, "yes" if one.warned else "no", inside(one)] for one in found
    ]
    table = np.array([numbers(one) for one in found])
    for name, level in (("median", 0.5), *TAILS):
        lines.append([name, *[quantile(column, level) for column in table.T], "", "", ""])
    show(
        f"scenes: mm and degrees; the truth in the regions of {', '.join(REGIONS)}",
        ["", *columns],
        lines,
    )


def over_time(found: Sequence[Probed]) -> None:
    """Medians and 90th percentiles of every error after vision and at the times."""
    lines = [
        [f"{moment}, {name}", *[quantile(of(found, moment, what), level) for what in Moment._fields]]
        for name, level in (("median", 0.5), ("90 %", 0.9))
        for moment in MOMENTS
    ]
    show(f"{len(found)} scenes over time: mm and degrees", ["", *NAMES], lines)


def by_kind(found: Sequence[Probed]) -> None:
    """Medians at the end by part and by clearance."""
    groups = {
        **by(found, lambda one: one.part),
        **{f"{clearance:g} mm": ones for clearance, ones in by(found, lambda one: one.clearance).items()},
    }
    lines = [
        [
            name,
            len(ones),
            sum(bool(one.missed) for one in ones),
            quantile(of(ones, VISION, "weighted_add"), 0.5),
            quantile(of(ones, END, "weighted_add"), 0.9),
            *[quantile(of(ones, END, what), 0.5) for what in Moment._fields],
        ]
        for name, ones in groups.items()
    ]
    columns = ["", "scenes", "missed", "vision ADD", "ADD 90 %", *NAMES]
    show("by part and by clearance: medians at 6 s, mm and degrees", columns, lines)


def rows_of(found: Sequence[Probed], alone: bool) -> list[Row]:
    """What is reported over scenes, with goals for what is asked."""
    add, rows = of(found, END, "weighted_add"), list[Row]()
    rows += [Row(f"weighted ADD at 6 s, median, goal {g} mm", quantile(add, 0.5), "mm", g) for g in GOALS]
    for name, level in TAILS:
        rows.append(Row(f"weighted ADD at 6 s, {name}", quantile(add, level), "mm", TAIL_GOALS[level]))
    for what, name, goal in (
        ("along", "translation along the hole's axis", 0.3),
        ("across", "translation across the hole's axis", 0.3),
        ("tilt", "tilt", 0.5),
    ):
        rows.append(Row(f"{name} at 6 s, median", quantile(of(found, END, what), 0.5), UNITS[what], goal))
    rows.append(Row("scenes missed", sum(bool(one.missed) for one in found), "scenes", 0.0))
    for moment in MOMENTS:
        for what in Moment._fields:
            values = of(found, moment, what)
            for name, level in (("median", 0.5), ("90 %", 0.9)):
                title = f"{WORDS[what]}, {'after' if moment == VISION else 'at'} {moment}, {name}"
                rows.append(Row(title, quantile(values, level), UNITS[what]))
    rows.append(Row("scenes with a warning", sum(one.warned for one in found), "scenes"))
    wall = [one.wall for one in found if not one.missed]
    rows.append(Row("wall of a scene, median", quantile(wall, 0.5), "s", 6.0 if alone else None))
    for stage in STAGES:
        spent = [one.seconds[stage] for one in found if stage in one.seconds]
        rows.append(Row(f"wall of {stage}, median", quantile(spent, 0.5), "s"))
    for kind, goal in LATENCIES.items():
        spent = [seconds for one in found for seconds in one.waits.get(kind, ())]
        for name, level in (("median", 0.5), ("95 %", 0.95), ("worst", 1.0)):
            asked_of = goal if alone and level == 0.95 else None
            rows.append(Row(f"wall of a {kind}, {name}", quantile(spent, level), "s", asked_of))
    for name in sorted({name for one in found for name in one.efforts}):
        spent = [one.efforts[name][0] for one in found if name in one.efforts]
        made = [one.efforts[name][1] for one in found if name in one.efforts]
        rows.append(Row(f"{name}: wall, median", quantile(spent, 0.5), "s"))
        rows.append(Row(f"{name}: items, median", quantile(made, 0.5), "images or gaps"))
    most = max((one.memory for one in found if not math.isnan(one.memory)), default=math.nan)
    rows.append(Row("memory of a process, most", most, "GB", 1.5 if alone else None))
    for region in REGIONS:
        for mass in MASSES:
            share = float(np.mean([one.held(END, region, mass) for one in found]))
            title = f"{region}, {100 * mass:.0f} % region at 6 s holds the truth"
            rows.append(Row(title, 100 * share, "%", COVERED[mass], "min"))
    for one in found:
        rows.append(Row(f"scene {one.name}: weighted ADD at 6 s", one.at(END).weighted_add, "mm"))
    # JSON knows no infinity: what more than half of the scenes missed has no median.
    return [row._replace(value=math.nan) if math.isinf(row.value) else row for row in rows]


def misses(found: Sequence[Probed]) -> None:
    """Which scenes were missed and why."""
    for one in found:
        if one.missed:
            print(f"missed, {one.name}: {one.missed}")


def growth(seed: int, counts: Sequence[int]) -> list[Row]:
    """One scene with ever more particles, each in a process of its own with all its threads."""
    rows, lines = list[Row](), list[list[Any]]()
    for count in counts:
        one = apart(probed, seed, count)
        report(one)
        stages = [one.seconds.get(stage, math.nan) for stage in STAGES]
        lines.append([f"{count}", *stages, one.wall, one.memory, one.at(VISION).weighted_add, *one.at(END)])
        rows.append(Row(f"N = {count}: wall", one.wall, "s"))
        rows.append(Row(f"N = {count}: memory", one.memory, "GB"))
        rows.append(Row(f"N = {count}: weighted ADD at 6 s", one.at(END).weighted_add, "mm"))
    columns = ["N", *[f"{stage} s" for stage in STAGES], "wall s", "GB", "vision ADD", *NAMES]
    show(f"growth with the number of particles, scene {seed}", columns, lines)
    return [row._replace(value=math.nan) if math.isinf(row.value) else row for row in rows]


def paper(seed: int, particles: int, file: Path) -> list[Row]:
    """One run as a figure, and the number that the paper reports as the goal."""
    one = curves.beside_paper(seed, particles, file)
    report(one)
    name = f"scene {one.name}: weighted ADD at 6 s; the goal is what the paper reports"
    return [Row(name, one.at(END).weighted_add if not one.missed else math.nan, "mm", curves.REPORTED)]


def asked() -> argparse.Namespace:
    """The command line's options."""
    parser = options(__doc__ or "")
    parser.add_argument(
        "--scenes", type=int, help=f"how many; {SCENES}, with --times {TIMED}, with --ablations {ABLATED}"
    )
    parser.add_argument("--particles", type=int, default=PARTICLES)
    parser.add_argument(
        "--jobs", type=int, default=2, help="scenes at a time; with more than one, times mean little"
    )
    parser.add_argument(
        "--inference-seeds",
        type=int,
        default=1,
        metavar="K",
        help="run every scene with K seeds of inference: its own, then 1 to K - 1",
    )
    parser.add_argument("--figure", type=Path, metavar="FILE", help="ADD over time of all scenes")
    ways = parser.add_mutually_exclusive_group()
    ways.add_argument(
        "--times", action="store_true", help="scenes one at a time, with goals for time and memory"
    )
    ways.add_argument("--growth", action="store_true", help="one scene with ever more particles")
    ways.add_argument(
        "--ablations", action="store_true", help="what each part of the default gives and costs"
    )
    ways.add_argument(
        "--paper", type=Path, metavar="FILE", help="one scene as a figure like the paper's third"
    )
    return parser.parse_args()


def main() -> None:
    given = asked()
    if given.paper:
        finish(paper(given.seed, given.particles, given.paper), given.json)
        return
    if given.growth:
        finish(growth(given.seed, GROWTH[:2] if given.quick else GROWTH), given.json)
        return
    most = ABLATED if given.ablations else TIMED if given.times else SCENES
    count = given.scenes if given.scenes is not None else 2 if given.quick else most
    seeds, jobs = range(given.seed, given.seed + count), 1 if given.times else given.jobs
    if given.ablations:
        finish(ablations.rows_of(seeds, given.particles, jobs), given.json)
        return
    others = [None, *range(1, given.inference_seeds)]
    found = all_scenes([(seed, other) for seed in seeds for other in others], given.particles, jobs)
    if not found:
        print("no scene was run; give --scenes a number from 1.")
        return
    per_scene(found)
    over_time(found)
    by_kind(found)
    misses(found)
    if given.figure:
        curves.of_all(found, GOALS, "goals", given.figure)
    finish(rows_of(found, jobs == 1), given.json)


if __name__ == "__main__":
    main()

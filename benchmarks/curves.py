"""Figures of ADD over time: of all scenes of a run, and of one run beside what the paper reports."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scenes import Curve, Probed, followed, quantile

from bcppl.figures import add_over_time
from bcppl.figures.over_time import SMALLEST_ADD, logarithmic_axis
from bcppl.figures.palette import PARTICLE, STRONG, TRUTH

REPORTED = 0.8  # mm, the ADD that the paper reports with 75 particles after a 6 s probe
BEFORE = 0.5  # s on the axis that the prior and each view are given before the probe begins


def places(curve: Curve) -> list[float]:
    """Where a curve's points stand on a time axis: the prior and the views left of the probe's beginning."""
    untimed = sum(math.isnan(moment) for moment in curve.times)
    return [
        BEFORE * (k + 1 - untimed) if math.isnan(moment) else moment for k, moment in enumerate(curve.times)
    ]


def of_all(found: Sequence[Probed], beside: Sequence[float], what: str, file: Path) -> None:
    """ADD over time of every scene, with the median, where four of five scenes lie, and ADDs beside it."""
    curves = [one.curve for one in found if one.curve.times]
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    gathered: dict[float, list[float]] = {}
    for curve in curves:
        here = places(curve)
        axes.plot(here, np.maximum(curve.adds, SMALLEST_ADD), color=PARTICLE, alpha=0.3, linewidth=0.7)
        for place, add in zip(here, curve.adds, strict=True):
            gathered.setdefault(round(place, 2), []).append(add)
    # Scenes that stopped early are misses, not missing.
    times = sorted(gathered)
    filled = [gathered[t] + [math.inf] * (len(found) - len(gathered[t])) for t in times]
    low, middle, high = ([max(quantile(adds, q), SMALLEST_ADD) for adds in filled] for q in (0.1, 0.5, 0.9))
    axes.fill_between(times, low, high, color=STRONG, alpha=0.15, linewidth=0)
    axes.plot(times, middle, color=STRONG, linewidth=2.5, marker="o", markersize=4, zorder=3)
    for add in beside:
        axes.axhline(add, color=TRUTH, linewidth=1.0, linestyle="--")
    axes.axvspan(0.0, max(times), color="#0072B2", alpha=0.06, linewidth=0)
    axes.text(0.0, 1.01, " probing", transform=axes.get_xaxis_transform(), color="#0072B2")
    logarithmic_axis(axes, "ADD, weighted by particles (mm)")
    axes.set_xlabel("time of the probe (s)")
    first = curves[0]
    ticks = [(p, k) for p, k, t in zip(places(first), first.kinds, first.times, strict=True) if math.isnan(t)]
    whole = [(float(t), f"{t:g}") for t in range(1, math.ceil(max(times)) + 1)]
    axes.set_xticks(*zip(*ticks, *whole, strict=True))
    figure.legend(
        [
            Line2D([], [], color=PARTICLE, linewidth=0.7),
            Line2D([], [], color=STRONG, linewidth=2.5, marker="o", markersize=4),
            Patch(color=STRONG, alpha=0.15),
            Line2D([], [], color=TRUTH, linewidth=1.0, linestyle="--"),
        ],
        [f"{len(found)} scenes", "median", "10 to 90 %", what],
        loc="outside upper right",
        ncols=4,
        frameon=False,
    )
    figure.savefig(file, dpi=150)


def beside_paper(seed: int, particles: int, file: Path) -> Probed:
    """One run as the paper's figure 3 shows one: ADD of the weighted particles as views, then windows come.

    The paper's curve is not at hand: only the number that it reports is drawn, as a labelled line.
    """
    found, steps, recording = followed(seed, particles)
    if found.missed or recording is None:
        return found
    points, truth = recording.part.surface_points(), recording.truth
    assert truth is not None
    numbers = {kind: 0 for kind in found.curve.kinds}
    labels = []
    for kind, moment in zip(found.curve.kinds, found.curve.times, strict=True):
        numbers[kind] += 1
        named = kind if kind == "prior" else f"{kind} {numbers[kind]}"
        labels.append(named if math.isnan(moment) else f"{moment:.1f} s")
    figure = add_over_time(
        np.array(places(found.curve)),
        np.stack([step.belief.add(points, truth).numpy() for step in steps]),
        np.stack([step.belief.weights.numpy() for step in steps]),
        labels,
        contact_start=found.curve.kinds.index("window"),
    )
    axes = figure.axes[0]
    axes.axhline(REPORTED, color=TRUTH, linewidth=1.2, linestyle="--")
    axes.annotate(
        f"{REPORTED:g} mm: reported by the paper (its figure 3: 75 particles, at the end of a 6 s probe)",
        (0.01, REPORTED),
        xycoords=("axes fraction", "data"),
        xytext=(0, -4),
        textcoords="offset points",
        va="top",
        fontsize="small",
        color=TRUTH,
    )
    axes.set_xlabel(f"two views, then a window every half second of the probe ({found.name} clearance)")
    figure.savefig(file, dpi=150)
    return found

"""A run over its measurements: the error of every particle, and what inference reports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.figures.palette import PARTICLE, SEEN, STRONG

SMALLEST_ADD = 0.01  # mm: below it a logarithmic axis shows nothing of interest


def logarithmic_axis(axes: Axes, label: str) -> None:
    """A vertical axis for errors: logarithmic, with ticks at 1, 2 and 5 and lines at them."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_ylabel(label)


def add_over_time(
    times: Array, adds: Array, weights: Array, labels: Sequence[str], contact_start: int | None = None
) -> Figure:
    """ADD of every particle, and their weighted mean, after each measurement.

    A line joins the particles that stand at the same place in the population; its opacity follows the weight.

    Args:
        times: (K,) where each measurement stands on the horizontal axis: seconds, or its number.
        adds: (K, N) ADD of each particle in metres.
        weights: (K, N) weights, in any scale, that are not negative.
        labels: K names of the measurements, written at the ticks.
        contact_start: index of the first measurement by touch; None where there is none.

    Raises:
        InputError: a measurement's weights are negative, not finite, or all zero.
    """
    times, adds, weights = (np.asarray(values, dtype=np.float64) for values in (times, adds, weights))
    total = weights.sum(axis=1)
    if not np.isfinite(total).all() or (weights < 0).any() or (total <= 0).any():
        raise InputError(
            "ADD over time got weights that are negative, not finite or all zero; "
            "give each measurement's weights, not their logarithms."
        )
    weights = weights / total[:, None]
    millimetres = np.maximum(1000.0 * adds, SMALLEST_ADD)
    mean = np.maximum(1000.0 * (weights * adds).sum(axis=1), SMALLEST_ADD)

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    grey = np.zeros((*weights.shape, 4))
    grey[..., :3] = to_rgba(PARTICLE)[:3]
    grey[..., 3] = np.clip(weights / weights.max(axis=1, keepdims=True), 0.06, 0.75)
    lines = np.stack(np.broadcast_arrays(times[:, None], millimetres), axis=-1)
    segments = np.stack([lines[:-1], lines[1:]], axis=2).reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(segments), colors=grey[1:].reshape(-1, 4), linewidths=0.8))
    axes.scatter(lines[..., 0].ravel(), lines[..., 1].ravel(), s=9, c=grey.reshape(-1, 4), linewidths=0)
    axes.plot(times, mean, color=STRONG, linewidth=2.5, marker="o", markersize=5, zorder=3)
    axes.annotate(
        f"{mean[-1]:.2g} mm",
        (times[-1], mean[-1]),
        xytext=(8, 0),
        textcoords="offset points",
        va="center",
        color=STRONG,
        fontweight="bold",
    )

    logarithmic_axis(axes, "ADD (mm)")
    axes.set_xlabel("after measurement")
    crowded = sum(len(label) for label in labels) > 70
    axes.set_xticks(times, labels, rotation=45 if crowded else 0, ha="right" if crowded else "center")
    margin = 0.06 * max(float(np.ptp(times)), 1e-9) if len(times) > 1 else 1.0
    axes.set_xlim(times.min() - 0.5 * margin, times.max() + 1.7 * margin)
    if contact_start is not None:
        first = times[contact_start]
        edge = 0.5 * (first + times[contact_start - 1]) if contact_start > 0 else first - 0.25 * margin
        axes.axvspan(edge, times.max() + 1.7 * margin, color="#0072B2", alpha=0.06, linewidth=0)
        axes.text(edge, 1.01, " probing", transform=axes.get_xaxis_transform(), color="#0072B2")
    particle = Line2D([], [], color=PARTICLE, linewidth=1.0, marker="o", markersize=3)
    average = Line2D([], [], color=STRONG, linewidth=2.5, marker="o", markersize=5)
    figure.legend(
        [particle, average],
        [f"{adds.shape[1]} particles, darker is heavier", "weighted mean"],
        loc="outside upper right",
        ncols=2,
        frameon=False,
    )
    return figure


def spread_over_time(axes: Axes, labels: Sequence[str], spread: Array, relative: Array | None = None) -> Axes:
    """How far the particles are from their mean after each measurement, root mean square, on a log axis.

    Args:
        axes: in which it is drawn.
        labels: K names of the measurements.
        spread: (K,) of the pose in the world, mm.
        relative: (K,) of the pose as seen from the held peg, mm; NaN where it has touched nothing.
    """
    at = np.arange(len(labels))
    axes.plot(at, spread, color=STRONG, marker="o", markersize=4, label="in the world")
    if relative is not None and np.isfinite(relative).any():
        axes.plot(at, relative, color=SEEN, marker="s", markersize=4, label="as seen from the held peg")
        axes.legend(frameon=False, fontsize=8)
    if (np.asarray(spread) > 0.0).any():  # of a guess that is a point there is none
        axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_ylabel("spread (mm)")
    return _at_measurements(axes, labels)


def column_over_time(axes: Axes, labels: Sequence[str], values: Sequence[float], name: str) -> Axes:
    """A column of a run after each measurement, such as its effective sample size; NaN leaves a gap.

    `values` are K numbers, `name` is what the vertical axis says, with its unit.
    """
    numbers = np.asarray(values, dtype=np.float64)
    axes.plot(np.arange(len(labels)), numbers, color=STRONG, marker="o", markersize=4)
    axes.set_ylabel(name)
    return _at_measurements(axes, labels)


def _at_measurements(axes: Axes, labels: Sequence[str]) -> Any:
    step = max(1, len(labels) // 12)
    shown = range(0, len(labels), step)
    axes.set_xticks(shown, [labels[k] for k in shown], rotation=45, ha="right", fontsize=8)
    axes.grid(axis="y", color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
    return axes

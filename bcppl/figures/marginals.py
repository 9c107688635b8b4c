"""A pose's posterior axis by axis, and the errors that all touches share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.figures.palette import PARTICLE, SEEN, STRONG, TRUTH

AXES = ("x (mm)", "y (mm)", "z (mm)", "about x (°)", "about y (°)", "about z (°)")
UNITS = np.array([1e3] * 3 + [180.0 / np.pi] * 3)


class HasMoments(Protocol):
    """Such as `bcppl.inference.criticism.nuisances.SharedError`."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def mean(self) -> Tensor: ...  # noqa: D102
    @property
    def deviation(self) -> Tensor: ...  # noqa: D102


def marginals(belief: Belief, truth: Array | None = None, relative: Belief | None = None) -> Figure:
    """Marginals and pairs of a pose's six axes, mm and degrees from the belief's mean.

    Args:
        belief: over world_from_part.
        truth: (7,) where known.
        relative: the belief as seen from the held peg; its means need not agree, and are drawn apart.
    """
    figure = Figure(figsize=(8.0, 8.0), layout="constrained")
    grid = figure.subplots(6, 6)
    drawn = [(belief, STRONG)] + ([] if relative is None else [(relative, SEEN)])
    off = None if truth is None else UNITS * poses.local(belief.mean, torch.as_tensor(truth)).numpy()
    for each, colour in drawn:
        points, weights = UNITS * each.tangent.numpy(), each.weights.numpy()
        size = 2.0 + 60.0 * weights / max(weights.max(), 1e-12) / np.sqrt(len(weights))
        for row in range(6):
            axes = grid[row, row]
            axes.hist(points[:, row], 16, weights=weights, color=colour, alpha=0.5)
            for column in range(row):
                grid[row, column].scatter(
                    points[:, column], points[:, row], s=size, color=colour, alpha=0.5, linewidths=0
                )
    for row in range(6):
        for column in range(6):
            _frame(grid[row, column], row, column, off)
    entries: dict[str, Artist] = {"in the world": Patch(color=STRONG, alpha=0.5)}
    if relative is not None:
        entries["as seen from the held peg, from its own mean"] = Patch(color=SEEN, alpha=0.5)
    if off is not None:
        entries["the truth, in the world"] = Line2D([], [], color=TRUTH)
    figure.legend(entries.values(), entries.keys(), loc="upper right", frameon=False)
    return figure


def shared_error_bars(axes: Axes, errors: Sequence[HasMoments]) -> Axes:
    """What touches tell of the errors that they share: mean and standard deviation in those of the prior.

    A bar from -1 to 1 is the prior: nothing was learnt.
    """
    labels, means, deviations = [], [], []
    for error in errors:
        count = len(error.mean)
        labels += [error.name if count == 1 else f"{error.name} {k + 1}" for k in range(count)]
        means += error.mean.tolist()
        deviations += error.deviation.tolist()
    at = np.arange(len(labels))[::-1]
    axes.axvspan(-1.0, 1.0, color=PARTICLE, alpha=0.15, linewidth=0)
    axes.errorbar(means, at, xerr=deviations, fmt="o", color=STRONG, markersize=4, capsize=2)
    axes.set_yticks(at, labels, fontsize=8)
    axes.set_xlabel("standard deviations of the prior (grey)")
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def _frame(axes: Axes, row: int, column: int, off: Array | None) -> None:
    if column > row:
        axes.set_visible(False)
        return
    if off is not None:
        axes.axvline(off[column], color=TRUTH, linewidth=1.0)
        if column < row:
            axes.axhline(off[row], color=TRUTH, linewidth=1.0)
    axes.tick_params(labelsize=6)
    axes.spines[["top", "right"]].set_visible(False)
    if row == 5:
        axes.set_xlabel(AXES[column], fontsize=8)
    if column == 0 and row > 0:
        axes.set_ylabel(AXES[row], fontsize=8)
    if column == row:
        axes.set_yticks([])

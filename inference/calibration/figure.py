"""A picture of a calibration: each quantity's ranks with their simultaneous band, and expected coverage."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bcppl.inference.calibration.quantities import DENSITY, DISTANCE
from bcppl.inference.calibration.ranks import band
from bcppl.inference.calibration.result import Calibration

INSIDE, OUTSIDE, BAND = "#0072B2", "#D55E00", "0.85"  # of Okabe and Ito's palette
ACROSS = 4


def ranks_figure(calibration: Calibration, level: float = 0.95) -> Figure:
    """The ECDF of every quantity's ranks minus that of uniform ones, and expected coverage.

    The grey bands hold the curves of a calibrated inference with a probability of `level` or more, all panels
    together (Saeilynoja et al. 2022, and Bonferroni's correction). A curve that leaves its band is orange.
    High on the left and low on the right it speaks for a posterior that is too narrow, the other way round
    for one that is too wide, all to one side for one that is shifted. The last panel has the share of truths
    within regions of each mass: those of highest density, and TARP's.

    Returns:
        A figure of its own, made without pyplot.
    """
    count = len(calibration.names) + 1
    across = min(ACROSS, count)
    rows = math.ceil(count / across)
    figure = Figure(figsize=(2.6 * across, 2.3 * rows + 0.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, across, squeeze=False)).ravel()
    own = 1.0 - (1.0 - level) / len(calibration.names)
    for panel, name in zip(axes, calibration.names, strict=False):
        _ecdf(panel, calibration, name, own)
    _coverage(axes[count - 1], calibration)
    for panel in axes[count:]:
        panel.set_axis_off()
    figure.suptitle(
        f"{len(calibration)} draws of the joint; all quantities together: p = {calibration.p_value:.2g}",
        fontsize=10,
    )
    return figure


def _ecdf(panel: Axes, calibration: Calibration, name: str, level: float) -> None:
    draws = calibration.posterior_draws
    ranked = calibration.ranks[:, calibration.names.index(name)]
    expected = (np.arange(draws) + 1.0) / (draws + 1.0)
    low, high = band(len(calibration), draws, level)
    curve = np.bincount(ranked, minlength=draws + 1).cumsum()[:-1] / len(ranked)
    outside = bool(((curve < low) | (curve > high)).any())
    panel.fill_between(expected, low - expected, high - expected, color=BAND, linewidth=0, step="mid")
    panel.step(expected, curve - expected, where="mid", color=OUTSIDE if outside else INSIDE, linewidth=1.5)
    panel.axhline(0.0, color="0.5", linewidth=0.8)
    panel.set_xlim(0.0, 1.0)
    panel.set_title(f"{name}, p = {calibration.p_values[name]:.2g}", fontsize=9)
    panel.tick_params(labelsize=7)
    panel.spines[["top", "right"]].set_visible(False)


def _coverage(panel: Axes, calibration: Calibration) -> None:
    masses = np.linspace(0.0, 1.0, 101)
    shown = {DENSITY: "highest density", DISTANCE: "TARP"}
    panel.plot([0, 1], [0, 1], color="0.5", linewidth=0.8)
    for (name, label), style in zip(shown.items(), ("-", "--"), strict=True):
        if name in calibration.names:
            covered = calibration.coverage(name, masses.tolist())
            panel.plot(masses, covered, style, color=INSIDE, linewidth=1.5, label=label)
    panel.set_xlim(0.0, 1.0)
    panel.set_ylim(0.0, 1.0)
    panel.set_title("expected coverage", fontsize=9)
    panel.legend(fontsize=7, frameon=False, loc="upper left")
    panel.tick_params(labelsize=7)
    panel.spines[["top", "right"]].set_visible(False)

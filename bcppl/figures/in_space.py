"""A belief in space: its particles around the part, and the next measurement."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.figures.palette import BODY, PARTICLE, STRONG, TRUTH
from bcppl.figures.space_elements import (
    arrows,
    frame,
    in_words,
    limits_of,
    outline,
    panel,
    weighted,
)
from bcppl.geometry.parts import Part
from bcppl.sensors.candidates import Candidate
from bcppl.sensors.protocol import FAINT, Drawable, sensor_of
from bcppl.untrusted.visible_text import in_figure

HEAVIEST = 10


def belief_in_3d(
    part: Part, beliefs: Sequence[tuple[str, Array, Array]], truth: Array | None = None
) -> Figure:
    """Beliefs side by side: the part at each mean, and every particle as an arrow along the part's z axis.

    An arrow starts at the part's origin; the short tick at its foot is the part's x axis and shows yaw.
    All panels have the same limits, in millimetres of the world frame.

    Args:
        part: whose pose is sought.
        beliefs: (title, `world_from_part` (N, 7), log weights (N,)) of each panel; weights in any scale.
        truth: (7,) true `world_from_part`, where known.

    Raises:
        InputError: there is no belief, or as `bcppl.Belief`.
        InferenceError: a belief has no weight, or one that is not finite.
    """
    if not beliefs:
        raise InputError("a picture of beliefs got none; give at least one (title, poses, log weights).")
    panels = [(title, *weighted(poses, log_weights)) for title, poses, log_weights in beliefs]
    true = None if truth is None else np.asarray(truth, dtype=np.float64)
    length = 0.45 * 1000.0 * part.diameter
    shape, figure = outline(part), Figure(figsize=(max(4.6 * len(panels), 6.0), 4.8))
    reached = [limits_of(part, length, poses, mean) for _, poses, _, mean in panels]
    if true is not None:
        reached.append(limits_of(part, 1.15 * length, true[None], true))
    shown = np.concatenate(reached)
    low, high = shown.min(axis=0), shown.max(axis=0)
    for k, (title, poses, weights, mean) in enumerate(panels):
        axes = panel(figure, (1, len(panels), k + 1), shape, mean)
        order = np.argsort(-weights, kind="stable")
        heavy, light = poses[order[:HEAVIEST]], poses[order[HEAVIEST:]]
        arrows(axes, light, length, PARTICLE, width=0.8, alpha=0.45, zorder=3)
        arrows(axes, heavy, length, STRONG, width=1.4, alpha=0.95, zorder=5)
        if true is not None:
            arrows(axes, true[None], 1.15 * length, TRUTH, width=4.5, alpha=1.0, zorder=4)
        frame(axes, low, high)
        axes.set_title(f"{in_figure(title)}\n{in_words(poses, weights, mean, true)}", fontsize=10)
    heaviest = f"{HEAVIEST} heaviest (arrow: z axis, tick: x axis)"
    entries = {
        heaviest: Line2D([], [], color=STRONG, linewidth=1.6),
        "other particles": Line2D([], [], color=PARTICLE, linewidth=1.0),
        f"{in_figure(part.name)} at the mean": Patch(facecolor=BODY, edgecolor="0.3", alpha=0.6),
    }
    if true is not None:
        entries["truth"] = Line2D([], [], color=TRUTH, linewidth=4.5)
    # Four entries side by side are as wide as three panels.
    columns = len(entries) if len(panels) >= 3 else 2 if len(panels) == 2 else 1
    rows = -(-len(entries) // columns)
    figure.legend(
        entries.values(), entries.keys(), loc="lower center", ncols=columns, frameon=False, fontsize=9
    )
    bottom = 0.12 + 0.05 * (rows - 1)
    figure.subplots_adjust(left=0.02, right=0.95, top=0.88, bottom=bottom, wspace=0.12)
    return figure


def action_in_3d(
    part: Part,
    belief: tuple[str, Array, Array],
    action: Candidate,
    peg: Part | None = None,
    others: Sequence[Candidate] = (),
) -> Figure:
    """A candidate that was chosen, drawn around the part at a belief's mean and its particles.

    Args:
        part: whose pose is sought.
        belief: (title, `world_from_part` (N, 7), log weights (N,)); weights in any scale.
        action: the plan, view or other candidate that was chosen.
        peg: the held peg; without one the path of its frame's origin is drawn.
        others: candidates that were not chosen, drawn faintly.

    Raises:
        InputError: as `belief_in_3d`, or a candidate is of a kind that cannot be drawn.
    """
    title, poses, weights, mean = belief[0], *weighted(*belief[1:])
    length = 0.2 * 1000.0 * part.diameter
    figure = Figure(figsize=(7.0, 5.6))
    axes = panel(figure, (1, 1, 1), outline(part), mean)
    order = np.argsort(-weights, kind="stable")
    arrows(axes, poses[order], length, PARTICLE, width=0.8, alpha=0.35, zorder=3)
    for other in others:
        _drawer(other).draw(axes, other, mean, peg, faint=True)
    drawer = _drawer(action)
    reached = drawer.draw(axes, action, mean, peg)
    handles, labels = axes.get_legend_handles_labels()
    entries = dict(zip(labels, handles, strict=True))
    entries["particles (z axes)"] = Line2D([], [], color=PARTICLE, linewidth=1.0)
    if len(others) > 1:
        entries["other candidates"] = Line2D([], [], **FAINT)
    shown = np.concatenate([limits_of(part, length, poses, mean), reached])
    frame(axes, shown.min(axis=0), shown.max(axis=0))
    lines = [in_figure(title), in_words(poses, weights, mean, None), drawer.caption]
    axes.set_title("\n".join(filter(None, lines)), fontsize=10)
    figure.legend(entries.values(), entries.keys(), loc="lower center", ncols=4, frameon=False, fontsize=9)
    figure.subplots_adjust(left=0.02, right=0.95, top=0.87, bottom=0.14)
    return figure


def _drawer(candidate: Candidate) -> Drawable:
    sensor = sensor_of(candidate)
    if not isinstance(sensor, Drawable):
        raise InputError(f"a {sensor.names[0]} cannot be drawn; leave it out of the picture.")
    return sensor

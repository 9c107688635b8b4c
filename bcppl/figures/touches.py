"""Touches: the wrench over time, and where the peg was when it felt contact, as seen from the part."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from bcppl import poses
from bcppl.arrays import Array, Mask
from bcppl.contact.sensing.contact_detection import ContactDetector
from bcppl.figures.palette import FELT, PARTICLE, SEEN, STRONG
from bcppl.figures.space_elements import frame, outline, panel
from bcppl.geometry.parts import Part
from bcppl.sensors import Measurement

TARE = 10  # rows at the beginning, free of contact
COLOURS = {"x": SEEN, "y": "#009E73", "z": STRONG}


def wrench_over_time(axes: Axes, windows: Sequence[Measurement]) -> Axes:
    """The force on the peg along its axes (N, tared) over time, with windows, and stamps that felt contact.

    Args:
        axes: in which it is drawn.
        windows: of one probe, in their order.
    """
    times, force = tared_force(windows)
    for name, column, colour in zip(COLOURS, force.T, COLOURS.values(), strict=True):
        axes.plot(times, column, color=colour, linewidth=0.9, label=f"along the peg's {name}")
    for each in windows[1:]:
        axes.axvline(each.observation.times[0], color="0.85", linewidth=0.6, zorder=0)
    felt = contact_felt(force)
    low, high = axes.get_ylim()
    axes.fill_between(times, low, high, where=felt, color=FELT, alpha=0.18, linewidth=0, label="contact felt")
    axes.set_ylim(low, high)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("force (N)")
    axes.legend(frameon=False, fontsize=7, ncols=2)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def touches_on_part(
    figure: Figure,
    place: tuple[int, int, int],
    windows: Sequence[Measurement],
    part: Part,
    peg: Part,
    world_from_part: Array,
) -> Axes3D:
    """The path of the peg's tip in the part's frame at a pose (7,), contact in colour; axes of its own.

    Args:
        figure: in which it is drawn.
        place: rows, columns and number of the axes.
        windows: of one probe.
        part: that is touched.
        peg: that is held, its tip at its lowest z.
        world_from_part: (7,) such as a belief's mean.
    """
    _, force = tared_force(windows)
    felt = contact_felt(force)
    pose = np.concatenate([each.observation.world_from_peg for each in windows])
    tip = torch.tensor([[0.0, 0.0, float(peg.vertices[:, 2].min())]], dtype=torch.float64)
    at = poses.transform(torch.from_numpy(pose), tip)[:, 0]
    path = 1e3 * poses.transform(poses.inverse(torch.as_tensor(world_from_part)), at).numpy()
    axes = panel(figure, place, outline(part), poses.identity().numpy())
    axes.plot(*path.T, color=PARTICLE, linewidth=0.7, zorder=3)
    axes.scatter(*path[felt].T, color=FELT, s=8, zorder=4, depthshade=False)
    corners = 1e3 * np.stack([part.vertices.min(axis=0), part.vertices.max(axis=0)])
    near = path[felt] if felt.any() else path
    above = near.max(axis=0, keepdims=True)
    above[:, 2] += 10.0
    shown = np.concatenate([corners, near, above])
    frame(axes, shown.min(axis=0), shown.max(axis=0))
    axes.set_title("the tip's path, contact in colour", fontsize=9)
    return axes


def tared_force(touched: Sequence[Measurement]) -> tuple[Array, Array]:
    """Times (T,) s and tared forces (T, 3) N of a probe's windows, or of one push."""
    touches = [each.observation for each in touched]
    force = np.concatenate([touch.wrench[:, :3] for touch in touches])
    return np.concatenate([touch.times for touch in touches]), force - np.nanmean(force[:TARE], axis=0)


def contact_felt(force: Array) -> Mask:
    """Whether contact is beyond doubt by each of the tared forces (T, 3), N."""
    return np.asarray(ContactDetector()(torch.from_numpy(np.nan_to_num(force))).numpy() == 1.0)

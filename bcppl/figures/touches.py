"""Touches: the wrench and the gap over time, where the peg felt contact, and what touches would tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from bcppl import poses
from bcppl.arrays import Array, Mask
from bcppl.beliefs import Belief
from bcppl.contact.sensing.contact_detection import ContactDetector
from bcppl.errors import InputError
from bcppl.figures.palette import FELT, PARTICLE, SEEN, STRONG
from bcppl.figures.space_elements import frame, outline, panel
from bcppl.geometry.gap import PegGap
from bcppl.geometry.parts import Part
from bcppl.robot.plan import Plan
from bcppl.sensors import Measurement

TARE = 10  # rows at the beginning, free of contact
ROWS, DRAWS = 80, 2  # at which a gap is drawn; of the shared errors, for each particle
STEPS = 200  # of a guarded motion
NEAR = 0.0005  # m: farther gaps than this hide what a contact says
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


def gap_over_time(axes: Axes, windows: Sequence[Measurement], part: Part, peg: Part, belief: Belief) -> Axes:
    """The gap between part and peg by a belief (mm), its median and the middle 90 %, and contact felt.

    It is that of the pose as seen from the held peg. Where contact was felt it is 0, but for what the contact
    gives way, and it is nowhere less: a band that stays away from that contradicts what was felt. What the
    belief knows of the peg in the hand is what holds after the last window.

    Args:
        axes: in which it is drawn.
        windows: of one probe, in their order.
        part: that is touched.
        peg: that is held.
        belief: given them, or before.
    """
    times, force = tared_force(windows)
    pose = np.concatenate([each.observation.world_from_peg for each in windows])
    kept = np.flatnonzero(np.isfinite(pose).all(axis=1))
    kept = kept[np.linspace(0, len(kept) - 1, min(ROWS, len(kept))).astype(int)]
    measure, bands = PegGap(part, peg), []
    for row in kept:
        seen = belief.relative(pose[row], DRAWS)
        distance = measure(seen.world_from_part, torch.from_numpy(pose[row])[None]).distance[:, 0]
        order = distance.argsort()
        reached = seen.weights[order].cumsum(dim=0)
        places = torch.searchsorted(reached, torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64))
        bands.append(1e3 * distance[order[places.clamp(max=len(order) - 1)]].numpy())
    low, middle, high = np.transpose(bands)
    axes.fill_between(times[kept], low, high, color=SEEN, alpha=0.3, linewidth=0, label="middle 90 %")
    axes.plot(times[kept], middle, color=SEEN, linewidth=0.9, label="median")
    felt = contact_felt(force)
    limits = min(-1e3 * NEAR, 1.1 * low.min()), 4e3 * NEAR
    axes.fill_between(times, *limits, where=felt, color=FELT, alpha=0.18, linewidth=0, label="contact felt")
    axes.axhline(0.0, color="0.5", linewidth=0.6, zorder=0)
    axes.set_ylim(*limits)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("gap (mm)")
    axes.legend(frameon=False, fontsize=7, ncols=3)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def gains_on_part(
    figure: Figure,
    place: tuple[int, int, int],
    plans: Sequence[Plan],
    gains: Sequence[float],
    part: Part,
    peg: Part,
    world_from_part: Array,
) -> Axes3D:
    """Where plans would touch a part at a pose (7,), coloured by what they would tell; axes of its own.

    Args:
        figure: in which it is drawn.
        place: rows, columns and number of the axes.
        plans: with a guarded motion each: a touch is at its end, unless the part is met earlier.
        gains: of each, nats.
        part: that would be touched.
        peg: that is held.
        world_from_part: (7,) such as a belief's mean.

    Raises:
        InputError: no plan has a guarded motion, or there are not as many gains as plans.
    """
    if len(plans) != len(gains):
        raise InputError(f"a picture of gains got {len(plans)} plans and {len(gains)} gains; give one each.")
    part_pose, measure = torch.as_tensor(world_from_part, dtype=torch.float64), PegGap(part, peg)
    places, known = [], []
    for plan, gain in zip(plans, gains, strict=True):
        knots = torch.from_numpy(plan.world_from_peg)
        for k in (k for k, manner in enumerate(plan.manners) if manner == "guarded"):
            share = torch.linspace(0.0, 1.0, STEPS, dtype=torch.float64)[:, None]
            path = poses.retract(knots[k].expand(STEPS, 7), share * poses.local(knots[k], knots[k + 1]))
            gaps = measure(part_pose[None], path)
            met = (gaps.distance[0] <= 0.0).nonzero()
            at = int(met[0]) if len(met) else int(gaps.distance[0].argmin())
            on_part = gaps.witness[0, at] - gaps.distance[0, at] * gaps.normal[0, at]
            places.append(1e3 * on_part.numpy())
            known.append(gain)
    if not places:
        raise InputError("a picture of gains got no plan that touches; give plans with a guarded motion.")
    axes = panel(figure, place, outline(part), poses.identity().numpy())
    # The largest gains are drawn last, over the others.
    order, shown = np.argsort(known), np.stack(places)
    drawn = axes.scatter(
        *shown[order].T, c=np.array(known)[order], cmap="viridis", s=30, zorder=4, depthshade=False
    )
    figure.colorbar(drawn, ax=axes, label="information gain (nats)", shrink=0.6, pad=0.12)
    return _framed(axes, part, shown)


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
    near = path[felt] if felt.any() else path
    above = near.max(axis=0, keepdims=True)
    above[:, 2] += 10.0
    axes.set_title("the tip's path, contact in colour", fontsize=9)
    return _framed(axes, part, np.concatenate([near, above]))


def _framed(axes: Axes3D, part: Part, points: Array) -> Axes3D:
    """Axes that show the part and points (M, 3) in its frame, mm."""
    corners = 1e3 * np.stack([part.vertices.min(axis=0), part.vertices.max(axis=0)])
    shown = np.concatenate([corners, points])
    frame(axes, shown.min(axis=0), shown.max(axis=0))
    return axes


def tared_force(touched: Sequence[Measurement]) -> tuple[Array, Array]:
    """Times (T,) s and tared forces (T, 3) N of a probe's windows, or of one push."""
    touches = [each.observation for each in touched]
    force = np.concatenate([touch.wrench[:, :3] for touch in touches])
    return np.concatenate([touch.times for touch in touches]), force - np.nanmean(force[:TARE], axis=0)


def contact_felt(force: Array) -> Mask:
    """Whether contact is beyond doubt by each of the tared forces (T, 3), N."""
    return np.asarray(ContactDetector()(torch.from_numpy(np.nan_to_num(force))).numpy() == 1.0)

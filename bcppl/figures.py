"""Pictures of a belief: its error over time, and its particles around the part in space.

Every function returns a matplotlib `Figure` of its own, made without pyplot: nothing is shown or kept in a
global state, and `figure.savefig("name.png")` works without a display.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
import trimesh
from matplotlib import rc_context
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from scipy.spatial.transform import Rotation

from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.parts import Part

Array = npt.NDArray[np.float64]

# Okabe and Ito's palette, told apart by people of every colour vision.
STRONG = "#D55E00"
TRUTH = "#00A6D6"
PARTICLE = "#7F7F7F"
BODY = "#9DB4C8"

HEAVIEST = 10
SMALLEST_ADD = 0.01  # mm: below it a logarithmic axis shows nothing of interest
MANY_FACES = 4000  # more than this are drawn from vertices merged on a grid
FEATURE_ANGLE = np.radians(25.0)


def add_over_time(
    times: Array,
    adds: Array,
    weights: Array,
    labels: Sequence[str],
    contact_start: int | None = None,
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
        InputError: shapes do not fit, or a measurement's weights are negative, not finite, or all zero.
    """
    times, adds, weights = (np.asarray(values, dtype=np.float64) for values in (times, adds, weights))
    if adds.ndim != 2 or weights.shape != adds.shape or times.shape != adds.shape[:1]:
        raise InputError(
            f"ADD over time got times {times.shape}, ADD {adds.shape} and weights {weights.shape}; "
            "give (K,), (K, N) and (K, N)."
        )
    if len(labels) != len(times):
        raise InputError(
            f"ADD over time got {len(labels)} labels for {len(times)} measurements; give one each."
        )
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

    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(axis="y", color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_ylabel("ADD (mm)")
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


def belief_in_3d(
    part: Part,
    beliefs: Sequence[tuple[str, Array, Array]],
    truth: Array | None = None,
) -> Figure:
    """Beliefs side by side: the part at each mean, and every particle as an arrow along the part's z axis.

    An arrow starts at the part's origin; the short tick at its foot is the part's x axis and shows yaw.
    All panels have the same limits, in millimetres of the world frame.

    Args:
        part: whose pose is sought.
        beliefs: (title, `world_from_part` (N, 7), log weights (N,)) of each panel; weights in any scale.
        truth: (7,) true `world_from_part`, where known.

    Raises:
        InputError: there is no belief, shapes do not fit, or a belief has no finite weight.
    """
    if not beliefs:
        raise InputError("a picture of beliefs got none; give at least one (title, poses, log weights).")
    panels = [(title, *_checked(title, poses, log_weights)) for title, poses, log_weights in beliefs]
    true = None if truth is None else np.asarray(truth, dtype=np.float64)
    length = 0.45 * 1000.0 * part.diameter
    body, edges = _outline(part)

    figure = Figure(figsize=(max(4.6 * len(panels), 6.0), 4.8))
    reached = [_limits_of(part, length, poses, mean) for _, poses, _, mean in panels]
    if true is not None:
        reached.append(_limits_of(part, 1.15 * length, true[None], true))
    shown = np.concatenate(reached)
    low, high = shown.min(axis=0), shown.max(axis=0)
    for k, (title, poses, weights, mean) in enumerate(panels):
        with rc_context({"grid.color": "0.88", "grid.linewidth": 0.6}):
            axes: Axes3D = figure.add_subplot(1, len(panels), k + 1, projection="3d", computed_zorder=False)
        faces = _placed(mean, body)
        axes.add_collection3d(
            Poly3DCollection(faces, facecolors=BODY, linewidths=0.0, alpha=0.28, shade=True, zorder=1)
        )
        if len(edges):
            axes.add_collection3d(
                Line3DCollection(_placed(mean, edges), colors="0.3", linewidths=0.6, zorder=2)
            )
        order = np.argsort(-weights, kind="stable")
        heavy, light = poses[order[:HEAVIEST]], poses[order[HEAVIEST:]]
        _arrows(axes, light, length, PARTICLE, width=0.8, alpha=0.45, zorder=3)
        _arrows(axes, heavy, length, STRONG, width=1.4, alpha=0.95, zorder=5)
        if true is not None:
            _arrows(axes, true[None], 1.15 * length, TRUTH, width=4.5, alpha=1.0, zorder=4)
        _frame(axes, low, high)
        axes.set_title(f"{title}\n{_in_words(poses, weights, mean, true)}", fontsize=10)
    heaviest = f"{HEAVIEST} heaviest (arrow: z axis, tick: x axis)"
    entries = {
        heaviest: Line2D([], [], color=STRONG, linewidth=1.6),
        "other particles": Line2D([], [], color=PARTICLE, linewidth=1.0),
        f"{part.name} at the mean": Patch(facecolor=BODY, edgecolor="0.3", alpha=0.6),
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


def _checked(title: str, poses: Array, log_weights: Array) -> tuple[Array, Array, Array]:
    """Poses (N, 7), normalised weights (N,) and the mean pose (7,) of one panel."""
    poses, log_weights = (np.asarray(values, dtype=np.float64) for values in (poses, log_weights))
    if poses.ndim != 2 or poses.shape[1] != 7 or log_weights.shape != poses.shape[:1] or len(poses) == 0:
        raise InputError(
            f"belief {title!r} has poses {poses.shape} and log weights {log_weights.shape}; "
            "give (N, 7) and (N,)."
        )
    largest = log_weights.max()
    if not np.isfinite(largest):
        raise InputError(f"belief {title!r} has log weights whose largest is {largest}; give a finite one.")
    belief = Belief(torch.from_numpy(poses), torch.from_numpy(log_weights))
    return poses, belief.weights.numpy(), belief.mean.numpy()


def _rotation(pose: Array) -> Rotation:
    return Rotation.from_quat(pose[..., [4, 5, 6, 3]])


def _outline(part: Part) -> tuple[Array, Array]:
    """Triangles (F, 3, 3) and sharp or open edges (E, 2, 3) of the part, in its frame, metres."""
    mesh = part.mesh
    if len(mesh.faces) > MANY_FACES:
        # merge_vertices rounds to decimals: in units of a cell, to the cell.
        cell = float(part.extent.max()) / 40.0
        mesh = trimesh.Trimesh(mesh.vertices / cell, mesh.faces, process=False)
        mesh.merge_vertices(digits_vertex=0, merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
        mesh.apply_scale(cell)
        return np.asarray(mesh.triangles), np.zeros((0, 2, 3))
    sharp = mesh.face_adjacency_edges[mesh.face_adjacency_angles > FEATURE_ANGLE]
    alone = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    edges = np.concatenate([sharp, mesh.edges_sorted[alone]])
    return np.asarray(mesh.triangles), np.asarray(mesh.vertices[edges])


def _placed(pose: Array, points: Array) -> Array:
    """Points (..., 3) in metres of the part's frame, in millimetres of the world's."""
    turned = _rotation(pose).apply(np.array(points.reshape(-1, 3))) + pose[:3]
    return 1000.0 * turned.reshape(points.shape)


def _arrows(
    axes: Axes3D, poses: Array, length: float, color: str, width: float, alpha: float, zorder: int
) -> None:
    """One arrow (z axis) and one tick (x axis) for each pose, lengths in millimetres."""
    if len(poses) == 0:
        return
    foot = 1000.0 * poses[:, :3]
    turn = _rotation(poses).as_matrix()
    up, side = length * turn[:, :, 2], 0.3 * length * turn[:, :, 0]
    style = {"colors": to_rgba(color, alpha), "linewidths": width, "zorder": zorder}
    axes.quiver(*foot.T, *up.T, arrow_length_ratio=0.15, **style)
    axes.quiver(*foot.T, *side.T, arrow_length_ratio=0.0, **style)


def _limits_of(part: Part, length: float, poses: Array, mean: Array) -> Array:
    """Points (M, 3) in millimetres that a panel has to show: the part at the mean, arrows' feet and tips."""
    corners = _placed(mean, trimesh.bounds.corners(np.stack([part.vertices.min(0), part.vertices.max(0)])))
    feet = 1000.0 * poses[:, :3]
    tips = feet + length * _rotation(poses).as_matrix()[:, :, 2]
    return np.concatenate([corners, feet, tips])


def _frame(axes: Axes3D, low: Array, high: Array) -> None:
    """Equal millimetres along all axes, few ticks, quiet panes."""
    for name, axis, start, end in zip("xyz", (axes.xaxis, axes.yaxis, axes.zaxis), low, high, strict=True):
        getattr(axes, f"set_{name}lim")(start, end)
        getattr(axes, f"set_{name}label")(f"{name} (mm)", fontsize=9)
        axis.set_major_locator(MaxNLocator(4))
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.set_tick_params(labelsize=8)
    axes.zaxis.labelpad = 1.0
    axes.set_box_aspect(high - low, zoom=1.05)
    axes.patch.set_visible(False)  # or it covers the labels of the panel to its left
    axes.view_init(elev=28.0, azim=-60.0)


def _in_words(poses: Array, weights: Array, mean: Array, truth: Array | None) -> str:
    """How wide the belief is, and how far its mean is from the truth."""

    def millimetres(center: Array) -> Array:
        return 1000.0 * np.linalg.norm(poses[:, :3] - center[:3], axis=1)

    def degrees(center: Array) -> Array:
        return np.degrees((_rotation(center).inv() * _rotation(poses)).magnitude())

    spread = [float(np.sqrt(weights @ measure(mean) ** 2)) for measure in (millimetres, degrees)]
    words = f"spread {spread[0]:.2g} mm, {spread[1]:.2g}°"
    if truth is not None:
        off = 1000.0 * float(np.linalg.norm(mean[:3] - truth[:3]))
        turn = float(np.degrees((_rotation(truth).inv() * _rotation(mean)).magnitude()))
        words += f"; mean off by {off:.2g} mm, {turn:.2g}°"
    return words

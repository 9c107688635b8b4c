"""Parts, poses and axes drawn in space, in millimetres: the elements of the pictures of `bcppl.figures`."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from matplotlib import rc_context
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.figures.palette import BODY
from bcppl.geometry.parts import Part

MANY_FACES = 4000  # more than this are drawn from vertices merged on a grid
FEATURE_ANGLE = np.radians(25.0)


def weighted(poses: Array, log_weights: Array) -> tuple[Array, Array, Array]:
    """Poses (N, 7), normalised weights (N,) and the mean pose (7,) of one panel."""
    belief = Belief(torch.as_tensor(poses), torch.as_tensor(log_weights))
    return belief.world_from_part.numpy(), belief.weights.numpy(), belief.mean.numpy()


def rotation(pose: Array) -> Rotation:
    """The rotations of poses (..., 7)."""
    return Rotation.from_quat(pose[..., [4, 5, 6, 3]])


def outline(part: Part, most_faces: int = MANY_FACES, cells: float = 40.0) -> tuple[Array, Array]:
    """Triangles (F, 3, 3) and sharp or open edges (E, 2, 3) of the part, in its frame, metres.

    A mesh of more than `most_faces` has its vertices merged on a grid of so many cells along its longest
    side, and no edges.
    """
    mesh = part.mesh
    if len(mesh.faces) > most_faces:
        # merge_vertices rounds to decimals: in units of a cell, to the cell.
        cell = float(part.extent.max()) / cells
        mesh = trimesh.Trimesh(mesh.vertices / cell, mesh.faces, process=False)
        mesh.merge_vertices(digits_vertex=0, merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
        mesh.apply_scale(cell)
        return np.asarray(mesh.triangles), np.zeros((0, 2, 3))
    sharp = mesh.face_adjacency_edges[mesh.face_adjacency_angles > FEATURE_ANGLE]
    alone = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    edges = np.concatenate([sharp, mesh.edges_sorted[alone]])
    return np.asarray(mesh.triangles), np.asarray(mesh.vertices[edges])


def panel(figure: Figure, place: tuple[int, int, int], shape: tuple[Array, Array], mean: Array) -> Axes3D:
    """Axes at a place of a figure (rows, columns, number), with the part's `outline` at a pose (7,)."""
    with rc_context({"grid.color": "0.88", "grid.linewidth": 0.6}):
        axes: Axes3D = figure.add_subplot(*place, projection="3d", computed_zorder=False)
    faces, edges = (placed(mean, each) for each in shape)
    axes.add_collection3d(
        Poly3DCollection(faces, facecolors=BODY, linewidths=0.0, alpha=0.28, shade=True, zorder=1)
    )
    if len(edges):
        axes.add_collection3d(Line3DCollection(edges, colors="0.3", linewidths=0.6, zorder=2))
    return axes


def placed(pose: Array, points: Array) -> Array:
    """Points (..., 3) in metres of the part's frame, in millimetres of the world's."""
    turned = rotation(pose).apply(np.array(points.reshape(-1, 3))) + pose[:3]
    return 1000.0 * turned.reshape(points.shape)


def arrows(
    axes: Axes3D, poses: Array, length: float, color: str, width: float, alpha: float, zorder: int
) -> None:
    """One arrow (z axis) and one tick (x axis) for each pose, lengths in millimetres."""
    if len(poses) == 0:
        return
    foot = 1000.0 * poses[:, :3]
    turn = rotation(poses).as_matrix()
    up, side = length * turn[:, :, 2], 0.3 * length * turn[:, :, 0]
    style = {"colors": to_rgba(color, alpha), "linewidths": width, "zorder": zorder}
    axes.quiver(*foot.T, *up.T, arrow_length_ratio=0.15, **style)
    axes.quiver(*foot.T, *side.T, arrow_length_ratio=0.0, **style)


def limits_of(part: Part, length: float, poses: Array, mean: Array) -> Array:
    """Points (M, 3) in millimetres that a panel has to show: the part at the mean, arrows' feet and tips."""
    corners = placed(mean, trimesh.bounds.corners(np.stack([part.vertices.min(0), part.vertices.max(0)])))
    feet = 1000.0 * poses[:, :3]
    tips = feet + length * rotation(poses).as_matrix()[:, :, 2]
    return np.concatenate([corners, feet, tips])


def frame(axes: Axes3D, low: Array, high: Array) -> None:
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


def in_words(poses: Array, weights: Array, mean: Array, truth: Array | None) -> str:
    """The belief's spread, and the distance of its mean from the truth, in words."""

    def millimetres(center: Array) -> Array:
        return 1000.0 * np.linalg.norm(poses[:, :3] - center[:3], axis=1)

    def degrees(center: Array) -> Array:
        return np.degrees((rotation(center).inv() * rotation(poses)).magnitude())

    spread = [float(np.sqrt(weights @ measure(mean) ** 2)) for measure in (millimetres, degrees)]
    words = f"spread {spread[0]:.2g} mm, {spread[1]:.2g}°"
    if truth is not None:
        off = 1000.0 * float(np.linalg.norm(mean[:3] - truth[:3]))
        turn = float(np.degrees((rotation(truth).inv() * rotation(mean)).magnitude()))
        words += f"; mean off by {off:.2g} mm, {turn:.2g}°"
    return words

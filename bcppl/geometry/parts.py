"""Parts: rigid bodies as closed meshes, with convex pieces for contact."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.arrays import Array, Indices, as_array
from bcppl.cached import cached_property
from bcppl.errors import InputError
from bcppl.geometry.mesh_file import read_mesh

if TYPE_CHECKING:
    import trimesh
    from torch import Tensor

LARGEST_EXTENT = 5.0  # m: a larger mesh is in millimetres
FARTHEST = 3.0  # half widths of a guess's translation that its tails reach
ROUNDING = 1e-9  # m, rad
LARGEST_UNSCALED = 1.0  # m: the same of a mesh file without a stated scale


@dataclass(frozen=True)
class Piece:
    """One convex piece of a part's collision geometry.

    Attributes:
        kind: "box", "cylinder" (its axis along z) or "hull".
        size: half extents (3,) of a box, radius and half length (2,) of a cylinder, both in metres;
            vertices (V, 3) of a hull in the part's frame.
        center: (3,) centre of a box or cylinder in the part's frame (its axes are the part's), metres.
    """

    kind: str
    size: Array
    center: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def bounds(self) -> Array:
        """(2, 3) its least and largest coordinates in the part's frame, metres."""
        if self.kind == "hull":
            return np.array([np.min(self.size, axis=0), np.max(self.size, axis=0)])
        half = self.size if self.kind == "box" else np.asarray(self.size)[[0, 0, 1]]
        return np.array([self.center - half, self.center + half])


@dataclass(frozen=True, eq=False, repr=False)
class Part:
    """A rigid part: a closed triangle mesh and, for contact, convex pieces.

    Attributes:
        name: for people.
        vertices: (V, 3) in metres, in the part's frame.
        faces: (F, 3) indices of vertices, counter-clockwise seen from outside.
        pieces: convex pieces whose union is the solid; empty where contact is never simulated.
        source: attribution and licence of the mesh.
    """

    name: str
    vertices: Array
    faces: Indices
    pieces: Sequence[Piece] = ()
    source: str = ""

    @property
    def middle(self) -> Array:
        """(3,) of its bounding box, in its frame."""
        return np.asarray(0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0)))

    def __repr__(self) -> str:
        sides = " x ".join(f"{1000.0 * side:.3g}" for side in self.extent)
        return f"Part({self.name!r}, {sides} mm, faces {len(self.faces)}, convex pieces {len(self.pieces)})"

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The trimesh mesh, its vertices unmerged."""
        import trimesh  # takes as long to import as all that a check needs

        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    @property
    def extent(self) -> Array:
        """Side lengths (3,) of the bounding box along the part's axes, metres."""
        return np.asarray(self.vertices.max(axis=0) - self.vertices.min(axis=0))

    @cached_property
    def diameter(self) -> float:
        """The largest distance between two vertices, metres (the diameter of the BOP benchmark)."""
        from scipy.spatial.distance import pdist

        hull = self.vertices if len(self.vertices) <= 4 else self.mesh.convex_hull.vertices
        return float(pdist(hull).max())

    def surface_points(self, count: int = 1000, seed: int = 0) -> Array:
        """Points (count, 3) sampled uniformly by area on the surface, in the part's frame, as for ADD."""
        from trimesh.sample import sample_surface

        points, _ = sample_surface(self.mesh, count, seed=seed)
        return np.ascontiguousarray(points, dtype=np.float64)

    def moved(self, new_from_old: object, name: str | None = None) -> Part:
        """The same solid in another frame: a point p of the old frame becomes new_from_old p.

        A peg whose mesh has its origin at the tip gets its frame where it is held, 50 mm above, with
        `peg.moved([0, 0, -0.05, 1, 0, 0, 0])`. A box whose axes are not the new frame's becomes a hull.

        Args:
            new_from_old: (7,) pose of the old frame in the new one.
            name: of the new part; None for this one's.

        Raises:
            InputError: it is no pose, or tilts a cylinder, which must stay along z.
        """
        pose = poses.as_pose(new_from_old, f"the new frame of part {self.name!r}").detach().cpu().reshape(7)
        rotation, shift = poses.rotation_matrix(pose).numpy(), pose[:3].numpy()
        return replace(
            self,
            name=self.name if name is None else name,
            vertices=self.vertices @ rotation.T + shift,
            pieces=tuple(_moved(piece, rotation, shift, self.name) for piece in self.pieces),
        )

    def check(self, closed: bool = True) -> None:
        """Refuse a mesh that cannot be rendered or used in contact.

        Raises:
            InputError: the mesh is empty, not finite, larger than 5 m, or (with `closed`) open, wound both
                ways, or a body of it is inside out and no cavity of another.
        """
        if len(self.faces) == 0 or len(self.vertices) == 0:
            raise InputError(f"part {self.name!r} has an empty mesh; export it again with its triangles.")
        if not np.isfinite(self.vertices).all():
            raise InputError(f"part {self.name!r} has a vertex that is not finite; export its mesh again.")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise InputError(f"part {self.name!r} has a face without vertices; export its mesh again.")
        if self.extent.max() > LARGEST_EXTENT:
            raise InputError(
                f"part {self.name!r} is {self.extent.max():.4g} m long, probably in millimetres; rescale it."
            )
        if not closed:
            return
        open_edges, turned_edges = self._wrong_edges
        if open_edges:
            raise InputError(
                f"part {self.name!r} has an open mesh ({open_edges} open edges); close or merge it."
            )
        if turned_edges:
            raise InputError(
                f"part {self.name!r} has faces wound both ways ({turned_edges} edges between them); turn "
                "them all outwards, as trimesh.repair.fix_normals does."
            )
        self._refuse_inside_out()

    @property
    def is_closed(self) -> bool:
        """Whether every edge is shared by exactly two faces, which run along it in opposite directions."""
        return self._wrong_edges == (0, 0)

    @cached_property
    def _wrong_edges(self) -> tuple[int, int]:
        """How many edges are not shared by exactly two faces, and along how many both run the same way."""
        first, second = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64).T
        edges = np.minimum(first, second) * len(self.vertices) + np.maximum(first, second)
        _, edge, shared = np.unique(edges, return_inverse=True, return_counts=True)
        upwards = np.bincount(edge, weights=first < second)
        return int((shared != 2).sum()), int(((shared == 2) & (upwards != 1)).sum())

    def _refuse_inside_out(self) -> None:
        """Refuse a body of a closed mesh that is inside out, unless it is a cavity of the others."""
        body = _bodies(self.faces)
        corners = self.vertices[self.faces] - self.vertices.mean(axis=0)
        volumes = np.bincount(body, weights=np.linalg.det(corners)) / 6.0
        for k in np.flatnonzero(volumes < -1e-9 * self.extent.max() ** 3):
            place = corners[body == k][0].mean(axis=0)
            if _winding(corners[body != k] - place) < 0.5:
                words = "is" if len(volumes) == 1 else f"has a body of {np.sum(body == k)} faces that is"
                raise InputError(
                    f"part {self.name!r} {words} inside out ({volumes[k]:.3g} m^3); turn its faces with "
                    "faces[:, ::-1]."
                )


def _bodies(faces: Indices) -> Indices:
    """The body (F,) of each face of a closed mesh: faces that share edges are of one."""
    # Not by scipy: a recording is described without it.
    low, high = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)).T
    one, other = (np.lexsort((low, high)) // 3).reshape(-1, 2).T
    body, before = np.arange(len(faces)), np.full(len(faces), -1)
    while not np.array_equal(body, before):
        before, least = body, np.minimum(body[one], body[other])
        body = body.copy()
        np.minimum.at(body, one, least)
        np.minimum.at(body, other, least)
        body = body[body]
    return np.asarray(np.unique(body, return_inverse=True)[1])


def _winding(corners: Array) -> float:
    """How often triangles (F, 3, 3) go round the origin: 1 inside a closed mesh, 0 outside."""
    first, second, third = np.moveaxis(corners, 1, 0)
    one, two, three = np.moveaxis(np.linalg.norm(corners, axis=2), 1, 0)
    across = (first * second).sum(1) * three + (second * third).sum(1) * one + (third * first).sum(1) * two
    # Van Oosterom and Strackee's solid angles, "The solid angle of a plane triangle", 1983.
    return float(np.arctan2(np.linalg.det(corners), one * two * three + across).sum() / (2.0 * np.pi))


def with_tip_at(peg: Part, world_from_peg: Tensor, place: Tensor) -> Tensor:
    """The pose (7,) of a peg turned as at a pose (7,), its tip, the lowest z on its axis, at a place (3,)."""
    moved = world_from_peg.clone()
    moved[:3] = place - poses.rotation_matrix(moved)[:, 2] * float(peg.vertices[:, 2].min())
    return moved


def _moved(piece: Piece, rotation: Array, shift: Array, name: str) -> Piece:
    """A piece in another frame."""
    if piece.kind == "hull":
        return replace(piece, size=piece.size @ rotation.T + shift)
    center = rotation @ piece.center + shift
    if piece.kind == "cylinder":
        if abs(rotation[2, 2]) < 1.0 - 1e-14:
            raise InputError(
                f"part {name!r} has a cylinder among its pieces, which stays along z; turn it about z only."
            )
        return replace(piece, center=center)
    steps = np.abs(rotation)
    if np.allclose(steps, np.rint(steps), rtol=0.0, atol=1e-14):  # a permutation of the axes
        return replace(piece, size=np.rint(steps) @ piece.size, center=center)
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return Piece("hull", (signs * piece.size + piece.center) @ rotation.T + shift)


@dataclass(frozen=True, eq=False)
class Guess:
    """A prior: poses of the part within bounds of a guessed pose.

    A percent of each translation's mass lies in tails to three half widths (`prior_from_guess`), so that
    measurements may move the belief out of the box. Bounds of the rotation are hard.

    Attributes:
        world_from_part: (7,) the guessed pose, the centre of the prior.
        translation: (3,) half widths of a box along the world's axes, metres; 0 fixes an axis.
        tilt: largest angle between the part's z axis and its guess, radians; 0 fixes it.
        yaw: largest rotation about the part's z axis, radians; 0 fixes it.
        angle: if not None, the rotation is uniform within this angle (radians) of the guess, and
            `tilt` and `yaw` are not used.
    """

    world_from_part: Array
    translation: Array
    tilt: float = 0.0
    yaw: float = 0.0
    angle: float | None = None

    def __post_init__(self) -> None:
        for name in ("world_from_part", "translation"):
            object.__setattr__(self, name, as_array(getattr(self, name)))

    def allows(self, world_from_part: Array) -> bool:
        """Whether a pose (7,) is within the bounds, tails included."""
        away = np.abs(np.asarray(world_from_part)[:3] - self.world_from_part[:3])
        if (away > FARTHEST * self.translation + ROUNDING).any():
            return False
        guess, there = self.world_from_part[3:], np.asarray(world_from_part)[3:]
        w = abs(float(guess @ there))
        x, y, z = guess[0] * there[1:] - there[0] * guess[1:] - np.cross(guess[1:], there[1:])
        if self.angle is not None:
            return 2.0 * math.atan2(math.hypot(x, y, z), w) <= self.angle + ROUNDING
        tilt, yaw = 2.0 * math.atan2(math.hypot(x, y), math.hypot(w, z)), 2.0 * math.atan2(abs(z), w)
        return tilt <= self.tilt + ROUNDING and yaw <= self.yaw + ROUNDING

    def farthest(self, point: Array) -> float:
        """How far (m) a point (3,) of the part may be from where it is at the guess, within the bounds."""
        about = float(np.linalg.norm(point))
        if self.angle is not None:
            swing = 2.0 * about * math.sin(0.5 * min(self.angle, math.pi))
        else:
            across = 2.0 * float(np.linalg.norm(point[:2])) * math.sin(0.5 * min(self.yaw, math.pi))
            swing = across + 2.0 * about * math.sin(0.5 * min(self.tilt, math.pi))
        return float(np.linalg.norm(self.translation)) + swing


def load_mesh(path: str | Path, name: str | None = None, scale: float | None = None) -> Part:
    """A part from an OBJ, STL, PLY, OFF or DAE file, checked, without convex pieces.

    Duplicate vertices, as of STL files and of seams of normals or textures, are merged: otherwise most closed
    meshes look open. All bodies of a file become one part. A mesh that is inside out is inverted, with a
    warning. A peg's frame must have its origin where it is held, above the tip: where the file has it
    elsewhere, use `Part.moved`.

    Args:
        path: the file; its coordinates are the part's frame.
        name: the part's name; None for the file's.
        scale: metres per unit of the file: 0.001 for millimetres. None assumes metres, and refuses a part
            longer than 1 m: a small part in millimetres would be a large one in metres.

    Raises:
        InputError: there is no such file, it holds no mesh or is damaged, or the mesh is empty, open, or in
            millimetres.
    """
    factor = 1.0 if scale is None else number_within(f"mesh file {path} has scale {{}}", scale, above=0.0)
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no mesh file {path}; give the path of an OBJ, STL or PLY file.")
    mesh = read_mesh(path)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) and mesh.is_watertight and mesh.volume < 0:
        mesh.invert()
        warnings.warn(
            f"mesh file {path} is inside out; its faces are inverted.", RuntimeWarning, stacklevel=2
        )
    vertices = factor * np.asarray(mesh.vertices, dtype=np.float64)
    part = Part(name or path.stem, vertices, np.asarray(mesh.faces, dtype=np.int64))
    try:
        part.check()
    except InputError as error:
        raise InputError(f"mesh file {path}: {error}") from error
    if scale is None and part.extent.max() > LARGEST_UNSCALED:
        raise InputError(
            f"mesh file {path} is {part.extent.max():.3g} m long if it is in metres; give scale=0.001 if it "
            "is in millimetres, scale=1.0 if the part is so large."
        )
    return part

"""Depth images of several parts at once: each hides what lies behind it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within, whole_number
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.renderer import DepthRenderer, counted_pixels

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

AT_ONCE = 1 << 22  # pixels of all particles that are composed together: 32 MB of depths


class RendersPart(Protocol):
    """What draws one part, such as `DepthRenderer`."""

    @property
    def effort(self) -> Effort:
        """What it has done so far."""

    def hits(self, camera: Camera, world_from_part: Tensor | Array, counted: Mask | None = None) -> Any:
        """The pixels that see the part at poses (N, 7): particle, pixel and depth."""

    def images(self, camera: Camera, world_from_part: Tensor | Array) -> Array:
        """Depth images (N, H, W) in metres, +inf where a pixel does not see the part."""


@dataclass(frozen=True, eq=False)
class SceneHits:
    """The pixels that see a part, for all particles, ordered by particle and then by pixel.

    Attributes:
        particle: (M,) which particle.
        pixel: (M,) which pixel, v * width + u.
        depth: (M,) depth along the optical axis of the nearest part, metres.
        part: (M,) which part that is, by its place in the scene.
    """

    particle: Indices
    pixel: Indices
    depth: Array
    part: Indices


class SceneRenderer:
    """Renders the depth of several parts, each at its own pose: the part that is sought, and a robot's links.

    A part that is at one pose for all particles is rendered once. What never moves needs no place here where
    the camera is where it is said to be: `background` renders it once for each camera.

    Attributes:
        parts: the K parts; poses are given in their order.
        effort: images asked for, rays cast and seconds spent so far.
    """

    def __init__(
        self, parts: Sequence[Part], renderer: Callable[[Part], RendersPart] = DepthRenderer
    ) -> None:
        """Build what each part needs once; a part that is named twice is built once.

        Args:
            parts: what is rendered, for example `[part, *robot.parts]`.
            renderer: makes the renderer of one part: `DepthRenderer` casts rays, which is fastest to begin
                with and sees through any lens; `bcppl.rendering.choice.renderer_for` draws the triangles
                of meshes that are not too fine, for every camera whose lens does not distort.

        Raises:
            InputError: there is no part, or the mesh of one is empty or not finite.
        """
        if not parts:
            raise InputError("a scene has no parts; give at least one, or no renderer at all.")
        self.parts = tuple(parts)
        self.effort = Effort()
        built: dict[int, RendersPart] = {}
        self._renderers = [built.setdefault(id(p), renderer(p)) for p in self.parts]

    def hits(
        self, camera: Camera, world_from_parts: Tensor | Array, counted: Mask | None = None
    ) -> SceneHits:
        """What the camera sees of the parts, as the pixels that see one.

        Args:
            camera: the camera.
            world_from_parts: (N, K, 7) the poses of the K parts for each particle; (K, 7) for one scene.
            counted: (H * W,) or (H, W) the pixels that matter; None for all.

        Raises:
            InputError: there are not K poses; a pose, the camera's too, is not finite or has no unit
                quaternion; the camera's intrinsics are none; the counted pixels are not those of its image.
        """
        pose = self._poses(world_from_parts)
        camera.stated_pose()
        counted = None if counted is None else counted_pixels(camera, counted)
        with self.effort.measure(items=len(pose)) as effort:
            before = [r.effort.amount for r in self._renderers]
            rows = max(1, AT_ONCE // max(camera.width * camera.height, 1))
            found = [
                self._composed(camera, pose[first : first + rows], counted, first)
                for first in range(0, len(pose), rows)
            ]
            once = {id(r): r.effort.amount - b for r, b in zip(self._renderers, before, strict=True)}
            effort.amount += sum(once.values())
        none = np.zeros(0, dtype=np.int64)
        each = [(h.particle, h.pixel, h.depth, h.part) for h in found] or [(none, none, np.zeros(0), none)]
        particle, pixel, depth, part = (np.concatenate(column) for column in zip(*each, strict=True))
        return SceneHits(particle, pixel, depth, part)

    def images(self, camera: Camera, world_from_parts: Tensor | Array) -> Array:
        """Depth images (N, H, W) in metres, +inf where a pixel sees no part; N is 1 for poses (K, 7).

        Raises:
            InputError: as `hits`.
        """
        pose = self._poses(world_from_parts)
        camera.stated_pose()
        image = np.full((len(pose), camera.height * camera.width), np.inf)
        found = self.hits(camera, pose)
        image[found.particle, found.pixel] = found.depth
        return image.reshape(-1, camera.height, camera.width)

    def background(self, camera: Camera, world_from_parts: Tensor | Array) -> Array:
        """The depth (H, W) in metres of parts at poses (K, 7) that never move, NaN where there is nothing.

        It is what the depth likelihoods take as `background`.

        Raises:
            InputError: as `hits`, or more than one scene is given.
        """
        image = self.images(camera, world_from_parts)
        if len(image) != 1:
            raise InputError(
                f"a background of {len(image)} scenes is asked for; it never moves: give poses "
                f"({len(self.parts)}, 7)."
            )
        return np.where(np.isfinite(image[0]), image[0], np.nan)

    def _poses(self, world_from_parts: Tensor | Array) -> Tensor:
        pose = poses.as_pose(world_from_parts, "world_from_parts")
        if pose.ndim == 2:
            pose = pose[None]
        if pose.ndim != 3 or pose.shape[1] != len(self.parts):
            raise InputError(
                f"the poses of a scene of {len(self.parts)} parts have shape {tuple(pose.shape)}; "
                f"give (N, {len(self.parts)}, 7), one world_from_part for each particle and part."
            )
        return pose

    def _composed(self, camera: Camera, pose: Tensor, counted: Mask | None, first: int) -> SceneHits:
        """The nearest hits for some particles (n, K, 7), which are numbered from `first` on."""
        everything = camera.width * camera.height
        pixels = np.arange(everything) if counted is None else np.flatnonzero(counted)
        count, size = len(pose), len(pixels)
        column = np.zeros(everything, dtype=np.int64)
        column[pixels] = np.arange(size)
        still = [count > 1 and bool((pose[:, k] == pose[:1, k]).all()) for k in range(len(self.parts))]
        same, whose = np.full(size, np.inf), np.zeros(size, dtype=np.int16)
        for k in (k for k, shared in enumerate(still) if shared):
            found = self._renderers[k].hits(camera, pose[:1, k], counted)
            _draw(same, whose, column.take(found.pixel), found.depth, k)
        nearest, owner = np.tile(same, count), np.tile(whose, count)
        for k in (k for k, shared in enumerate(still) if not shared):
            found = self._renderers[k].hits(camera, pose[:, k], counted)
            _draw(nearest, owner, found.particle * size + column.take(found.pixel), found.depth, k)
        key = np.flatnonzero(nearest < np.inf)
        seen = np.diff(np.searchsorted(key, size * np.arange(count + 1)))
        particle = np.repeat(np.arange(count), seen)
        part = owner.take(key).astype(np.int64)
        return SceneHits(particle + first, pixels.take(key - size * particle), nearest.take(key), part)


def _draw(nearest: Array, owner: npt.NDArray[np.int16], place: Indices, depth: Array, part: int) -> None:
    """Draw a part over what is drawn already; no place is given twice."""
    closer = np.flatnonzero(depth < nearest.take(place))
    place = place.take(closer)
    nearest[place] = depth.take(closer)
    owner[place] = part


def background_part(
    camera: Camera, depth: npt.ArrayLike, stride: int = 4, jump: float = 0.03, name: str = "background"
) -> Part:
    """What a background image shows as a part in the camera's frame: its pose is `world_from_camera`.

    A background as a part can be seen from where the camera really stands, which an image cannot. Blocks of
    pixels become two triangles each, which is exact for planes; a block that holds a missing pixel or an edge
    is left open, for nothing is known of what lies behind an edge.

    Args:
        camera: whose image it is.
        depth: (H, W) metres, NaN, 0 or infinite where unknown; rendered, or an average of many images.
        stride: the side of a block, pixels.
        jump: an edge is where the depth turns by more than this share of itself from pixel to pixel.
        name: of the part.

    Raises:
        InputError: the image is not the camera's, the camera's intrinsics are none, the stride is no whole
            number of pixels, the jump is not positive, or too little is known to make a triangle.
    """
    stride = whole_number("background_part is given stride {}", stride)
    jump = number_within("background_part is given jump {}", jump, above=0.0)
    image = np.asarray(depth, dtype=np.float64)
    if image.shape != (camera.height, camera.width):
        raise InputError(
            f"the background of camera {camera.name!r} has shape {image.shape}; "
            f"give one of its image's, {(camera.height, camera.width)}."
        )
    known = np.isfinite(image) & (image > 0.0)
    rows = np.unique(np.append(np.arange(0, camera.height, stride), camera.height - 1))
    columns = np.unique(np.append(np.arange(0, camera.width, stride), camera.width - 1))
    open_block = _blocks(~known | _edges(np.where(known, image, 1.0), jump), rows, columns)
    index = np.arange(len(rows) * len(columns)).reshape(len(rows), len(columns))
    a, b, c, d = (x[~open_block] for x in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    # Both triangles of a block face the camera.
    faces = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([c, b, d], axis=-1)])
    if not len(faces):
        raise InputError(
            f"the background of camera {camera.name!r} shows no surface; leave it out where it is unknown."
        )
    at = np.ix_(rows, columns)
    corners = (
        camera.rays().reshape(camera.height, camera.width, 3)[at] * np.where(known, image, 0.0)[at][..., None]
    )
    used, faces = np.unique(faces, return_inverse=True)
    return Part(name, corners.reshape(-1, 3)[used], faces.reshape(-1, 3).astype(np.int64))


def _edges(depth: Array, jump: float) -> Mask:
    """Where the inverse depth, linear over a plane, bends by more than a share of itself at a pixel."""
    inverse = 1.0 / depth
    bend = np.zeros_like(depth)
    bend[1:-1] = np.abs(inverse[2:] + inverse[:-2] - 2.0 * inverse[1:-1])
    bend[:, 1:-1] = np.maximum(
        bend[:, 1:-1], np.abs(inverse[:, 2:] + inverse[:, :-2] - 2.0 * inverse[:, 1:-1])
    )
    return np.asarray(bend > jump * inverse)


def _blocks(marked: Mask, rows: Indices, columns: Indices) -> Mask:
    """Whether a pixel is marked in each block from one row and column to the next, their ends included."""
    count = np.pad(np.cumsum(np.cumsum(marked, axis=0), axis=1), ((1, 0), (1, 0)))
    top, bottom, left, right = rows[:-1, None], rows[1:, None] + 1, columns[:-1], columns[1:] + 1
    return np.asarray(count[bottom, right] - count[top, right] - count[bottom, left] + count[top, left] > 0)


def placed(*world_from_parts: Tensor) -> Tensor:
    """Poses of a scene's parts side by side, (N, K, 7).

    Args:
        *world_from_parts: poses (7,) that all particles share, (N, 7) of one part, or (N, k, 7) of several,
            such as a robot's links.

    Raises:
        InputError: they are of different numbers of particles, or no poses.
    """
    counts = {len(p) for p in world_from_parts if p.ndim > 1}
    if any(p.shape[-1:] != (7,) or p.ndim not in (1, 2, 3) for p in world_from_parts) or len(counts) > 1:
        raise InputError(
            f"poses of shapes {', '.join(str(tuple(p.shape)) for p in world_from_parts)} make no scene; "
            "give (7,), (N, 7) or (N, k, 7), for the same N."
        )
    particles = counts.pop() if counts else 1
    each = [
        p.to(torch.float64) if p.ndim == 3 else p.to(torch.float64)[..., None, :] for p in world_from_parts
    ]
    return torch.cat([p.expand(particles, *p.shape[-2:]) for p in each], dim=1)

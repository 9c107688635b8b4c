"""Depth images of several parts at once, with occlusion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within, whole_number
from bcppl.arrays import Array, Indices, Mask
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.part_renderer import Hits, PartRenderer, pixel_mask
from bcppl.rendering.ray_casting import RayCaster

BATCH = 1 << 22  # pixels of all particles that are composed together: 32 MB of depths


@dataclass(frozen=True, eq=False)
class SceneHits(Hits):
    """Hits, and `part`, (M,): the index of the nearest part in the scene."""

    part: Indices = field(kw_only=True)


class SceneRenderer:
    """Renders the depth of several parts, each at its own pose: the part to be localised, a robot's links.

    A part that is at one pose for all particles is rendered once. Where the extrinsics are exact, parts that
    never move are better left to `background`, which renders them once for each camera.

    Attributes:
        parts: the K parts, such as `[part, *robot.parts]`; poses are given in their order.
        effort: images rendered, rays cast (or fragments tested) and seconds spent so far.
    """

    def __init__(self, parts: Sequence[Part], renderer: Callable[[Part], PartRenderer] = RayCaster) -> None:
        """Build a renderer for each part with `renderer`, one for a part that appears twice.

        `RayCaster` has the shortest first call; `rasterisation.renderer_for` rasterises meshes that
        are not too fine.

        Raises:
            InputError: the mesh of a part is empty or not finite.
        """
        self.parts = tuple(parts)
        self.effort = Effort()
        built = {key: renderer(part) for key, part in {id(part): part for part in self.parts}.items()}
        self._renderers = [built[id(part)] for part in self.parts]

    def hits(
        self, camera: Camera, world_from_parts: Tensor | Array, counted: Mask | None = None
    ) -> SceneHits:
        """The pixels of a camera that see a part.

        Args:
            camera: the camera.
            world_from_parts: (N, K, 7) the poses of the K parts for each particle; (K, 7) for one scene.
            counted: (H * W,) or (H, W) mask of the pixels to be rendered; None for all.

        Raises:
            InputError: there are not K poses; a pose, the camera's too, is not finite or has no unit
                quaternion; the camera's intrinsics are invalid; the mask is not of its image.
        """
        pose = self._poses(world_from_parts)
        camera.stated_pose()
        counted = None if counted is None else pixel_mask(camera, counted)
        rows, renderers = max(1, BATCH // (camera.width * camera.height)), set(self._renderers)
        before = sum(r.effort.amount for r in renderers)
        with self.effort.measure(items=len(pose)) as effort:
            batches = [
                self._composed(camera, pose[first : first + rows], counted, first)
                for first in range(0, max(len(pose), 1), rows)
            ]
            effort.amount += sum(r.effort.amount for r in renderers) - before
        return SceneHits.joined(batches)

    def images(self, camera: Camera, world_from_parts: Tensor | Array) -> Array:
        """Depth images (N, H, W) in metres, +inf where a pixel sees no part; N is 1 for poses (K, 7).

        Raises:
            InputError: as `hits`.
        """
        pose = self._poses(world_from_parts)
        return self.hits(camera, pose).images(camera, len(pose))

    def background(self, camera: Camera, world_from_parts: Tensor | Array) -> Array:
        """The depth (H, W) in metres of parts at fixed poses (K, 7), NaN where there is none.

        This is the `background` of the depth likelihoods.

        Raises:
            InputError: as `hits`.
            ValueError: there are poses of several scenes.
        """
        (image,) = self.images(camera, world_from_parts)
        return np.where(np.isfinite(image), image, np.nan)

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
        """The nearest hits at poses (n, K, 7), whose particles are numbered from `first` on."""
        everything = camera.width * camera.height
        pixels = np.arange(everything) if counted is None else np.flatnonzero(counted)
        count, size = len(pose), len(pixels)
        column = np.zeros(everything, dtype=np.int64)
        column[pixels] = np.arange(size)
        still = [count > 1 and bool((pose[:, k] == pose[:1, k]).all()) for k in range(len(self.parts))]
        same, same_owner = np.full(size, np.inf), np.zeros(size, dtype=np.int16)
        for k in (k for k, shared in enumerate(still) if shared):
            hits = self._renderers[k].hits(camera, pose[:1, k], counted)
            _compose(same, same_owner, column.take(hits.pixel), hits.depth, k)
        nearest, owner = np.tile(same, count), np.tile(same_owner, count)
        for k in (k for k, shared in enumerate(still) if not shared):
            hits = self._renderers[k].hits(camera, pose[:, k], counted)
            _compose(nearest, owner, hits.particle * size + column.take(hits.pixel), hits.depth, k)
        key = np.flatnonzero(nearest < np.inf)
        seen = np.diff(np.searchsorted(key, size * np.arange(count + 1)))
        particle = np.repeat(np.arange(count), seen)
        part = owner.take(key).astype(np.int64)
        return SceneHits(particle + first, pixels.take(key - size * particle), nearest.take(key), part=part)


def _compose(nearest: Array, owner: npt.NDArray[np.int16], place: Indices, depth: Array, part: int) -> None:
    """Write a part's depths where they are nearer; no place is given twice."""
    closer = np.flatnonzero(depth < nearest.take(place))
    place = place.take(closer)
    nearest[place] = depth.take(closer)
    owner[place] = part


def background_part(camera: Camera, depth: npt.ArrayLike, stride: int = 4, jump: float = 0.03) -> Part:
    """A background image as a part in the camera's frame: its pose is `world_from_camera`.

    Unlike an image, a part can be rendered from where the camera really is. Blocks of pixels become two
    triangles each, which is exact for planes; a block that contains a missing pixel or an edge is left open,
    because the surface behind an edge is unknown.

    Args:
        camera: of the image.
        depth: (H, W) metres, NaN, 0 or infinite where unknown; rendered, or an average of many images.
        stride: the side of a block, pixels.
        jump: at an edge the depth bends by more than this share of itself from pixel to pixel.

    Raises:
        InputError: the image is not the camera's, the camera's intrinsics are invalid, the stride is no whole
            number of pixels, the jump is not positive, or no block is complete.
    """
    stride = whole_number("background_part is given stride {}", stride)
    jump = number_within("background_part is given jump {}", jump, above=0.0)
    image = np.asarray(depth, dtype=np.float64)
    if image.shape != (camera.height, camera.width):
        raise InputError(
            f"the background of camera {camera.name!r} has shape {image.shape}; give one of its image's."
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
    return Part("background", corners.reshape(-1, 3)[used], faces.reshape(-1, 3).astype(np.int64))


def _edges(depth: Array, jump: float) -> Mask:
    """Pixels at which the inverse depth, linear over a plane, bends by more than a share of itself."""
    inverse = 1.0 / depth
    bend = np.zeros_like(depth)
    bend[1:-1] = np.abs(inverse[2:] + inverse[:-2] - 2.0 * inverse[1:-1])
    bend[:, 1:-1] = np.maximum(
        bend[:, 1:-1], np.abs(inverse[:, 2:] + inverse[:, :-2] - 2.0 * inverse[:, 1:-1])
    )
    return np.asarray(bend > jump * inverse)


def _blocks(marked: Mask, rows: Indices, columns: Indices) -> Mask:
    """Blocks from one row and column to the next, both included, in which a pixel is marked."""
    count = np.pad(np.cumsum(np.cumsum(marked, axis=0), axis=1), ((1, 0), (1, 0)))
    top, bottom, left, right = rows[:-1, None], rows[1:, None] + 1, columns[:-1], columns[1:] + 1
    return np.asarray(count[bottom, right] - count[top, right] - count[bottom, left] + count[top, left] > 0)


def scene_poses(*world_from_parts: Tensor) -> Tensor:
    """Poses (N, K, 7) of a scene's parts side by side.

    From poses (7,) that all particles share, (N, 7) of one part, or (N, k, 7) of several, such as links.
    """
    each = [p.double() if p.ndim == 3 else p.double()[..., None, :] for p in world_from_parts]
    particles = next((len(p) for p in each if p.ndim == 3), 1)
    return torch.cat([p.expand(particles, -1, -1) for p in each], dim=1)

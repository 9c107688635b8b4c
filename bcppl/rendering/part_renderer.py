"""The interface of the renderers of one part, and the hits that they return."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array, ArrayRecord, Indices, Mask
from bcppl.devices import is_on_host, on_device_of, on_host
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part

if TYPE_CHECKING:
    from bcppl.rendering.warp_casting import WarpCaster


@dataclass(frozen=True, eq=False)
class Hits(ArrayRecord):
    """The pixels that see a part, for all particles, ordered by particle and then by pixel.

    Attributes:
        particle: (M,) index of the particle.
        pixel: (M,) index of the pixel, v * width + u.
        depth: (M,) depth along the optical axis of the nearest surface, metres.
        face: (M,) index of the face in the part's mesh; None unless it was asked for.
    """

    particle: Indices
    pixel: Indices
    depth: Array
    face: Indices | None = None

    def images(self, camera: Camera, particles: int) -> Array:
        """Depth images (N, H, W) in metres, +inf where a pixel has no hit."""
        image = np.full((particles, camera.height * camera.width), np.inf)
        image[self.particle, self.pixel] = self.depth
        return image.reshape(-1, camera.height, camera.width)


class PartRenderer(ABC):
    """Renders the depth of one part at many poses.

    Attributes:
        part: the part; its mesh may be open.
        effort: images rendered, rays cast (or fragments tested) and seconds spent so far.

    Poses on a GPU are rendered there (`on`).

    Raises:
        InputError: the mesh is empty or not finite.
    """

    __caches__: tuple[str, ...] = ("_elsewhere",)

    def __init__(self, part: Part) -> None:
        part.check(closed=False)
        self.part = part
        self.effort = Effort()
        self._elsewhere: dict[torch.device, WarpCaster] = {}

    def on(self, device: torch.device) -> WarpCaster:
        """What renders the part at poses on a GPU; its effort is this one's.

        Raises:
            InputError: Warp is not installed.
        """
        if device not in self._elsewhere:
            try:
                from bcppl.rendering.warp_casting import WarpCaster
            except ImportError as error:
                raise InputError(
                    f"poses on {device} are rendered by Warp, which is not installed; install bcppl[warp], "
                    "or run on the processor."
                ) from error
            caster = self._elsewhere[device] = WarpCaster(self.part, device)
            caster.effort = self.effort
        return self._elsewhere[device]

    def hits(
        self,
        camera: Camera,
        world_from_part: Tensor | Array,
        counted: Mask | None = None,
        faces: bool = False,
    ) -> Hits:
        """The pixels of a camera that see the part.

        Args:
            camera: the camera.
            world_from_part: (N, 7) the part's poses.
            counted: (H * W,) or (H, W) mask of the pixels to be rendered; None for all.
            faces: whether the hits hold the index of the face.

        Returns:
            The hits. A surface nearer than `camera.near` is a hit too; one behind the camera is none.

        Raises:
            InputError: a pose, the camera's too, is not finite or has no unit quaternion; the camera's
                intrinsics are invalid; the mask is not of its image.
        """
        camera_from_part = self._camera_from_part(camera, world_from_part)
        if not is_on_host(camera_from_part):
            return self.on(camera_from_part.device).hits_of(camera, camera_from_part, counted, faces)
        return self.hits_of(camera, camera_from_part, counted, faces)

    def hits_of(
        self, camera: Camera, camera_from_part: Tensor, counted: Mask | None, faces: bool = False
    ) -> Hits:
        """As `hits`, at valid poses (N, 7) of the part in the camera's frame."""
        counted = None if counted is None else pixel_mask(camera, counted)
        with self.effort.measure(items=len(camera_from_part)) as effort:
            return self._hits(camera, camera_from_part, counted, faces, effort)

    def images(self, camera: Camera, world_from_part: Tensor | Array) -> Array:
        """Depth images (N, H, W) in metres, +inf where a pixel does not see the part.

        Raises:
            InputError: as `hits`.
        """
        pose = poses.as_pose(world_from_part, "world_from_part").reshape(-1, 7)
        return self.hits(camera, pose).images(camera, len(pose))

    @staticmethod
    def _camera_from_part(camera: Camera, world_from_part: Tensor | Array) -> Tensor:
        pose = poses.as_pose(world_from_part, "world_from_part").reshape(-1, 7)
        with on_host():
            stated = camera.stated_pose()
        return poses.compose(on_device_of(poses.inverse(stated), pose), pose)

    @abstractmethod
    def _hits(
        self, camera: Camera, camera_from_part: Tensor, counted: Mask | None, faces: bool, effort: Effort
    ) -> Hits:
        """The hits at poses (N, 7) of the part in the camera's frame; adds the rays to `effort.amount`."""


def pixel_mask(camera: Camera, counted: npt.ArrayLike) -> Mask:
    """A mask (H * W,) of a camera's pixels, from one (H * W,) or (H, W).

    Raises:
        InputError: the shape is not that of the camera's image.
    """
    mask = np.asarray(counted)
    if mask.shape not in ((camera.height, camera.width), (camera.height * camera.width,)):
        raise InputError(
            f"the counted pixels of camera {camera.name!r} have shape {mask.shape}; give a mask of all its "
            f"pixels, {(camera.height, camera.width)}, true where a pixel counts, and no indices."
        )
    return np.ascontiguousarray(mask, dtype=bool).reshape(-1)

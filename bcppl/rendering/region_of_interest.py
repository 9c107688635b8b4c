"""The region of interest of an image: the pixels in which a part can be."""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.errors import InputError
from bcppl.geometry.camera import OPTICAL, Camera
from bcppl.geometry.parts import Part


class UnseenError(InputError):
    """No pixel of a camera can show a part."""


def region_of_interest(
    camera: Camera, part: Part, world_from_part: npt.ArrayLike, within: float, least: int = 1
) -> tuple[int, int, int, int]:
    """Left, top, width and height of the pixels in which a part can be, for `Camera.cropped`.

    Args:
        camera: of the image.
        part: the part to be localised.
        world_from_part: (7,) its expected pose.
        within: bound of the displacement of its middle from there, metres; its rotation is arbitrary.
        least: lower bound of each side's pixels, where the image has so many.

    Returns:
        Numbers of pixels; the whole image where the part may be partly behind the camera.

    Raises:
        InputError: the camera's pose or intrinsics are invalid.
        UnseenError: no pixel can show the part.
    """
    camera_from_world = poses.inverse(camera.stated_pose())
    expected = poses.as_pose(world_from_part)
    middle = torch.as_tensor(part.middle)[None]
    there = poses.transform(camera_from_world, poses.transform(expected, middle)).numpy()
    reach = float(np.linalg.norm(part.extent) / 2 + within)
    # All corners of the cube that it may fill: off the axis, the far face reaches farthest inwards.
    corners = there + reach * np.array(list(product((-1, 1), repeat=3)))
    pixel = camera.project(corners)
    unseen = (
        f"camera {camera.name!r} cannot see part {part.name!r} within {within:.3g} m of where it is expected"
    )
    if (corners[:, 2] <= 0.0).all():
        raise UnseenError(f"{unseen}: that is behind it; {OPTICAL}, or leave its views out.")
    if not np.isfinite(pixel).all():
        return 0, 0, camera.width, camera.height
    size = np.array([camera.width, camera.height])
    if (pixel.max(axis=0) < -0.5).any() or (pixel.min(axis=0) > size - 0.5).any():
        raise UnseenError(
            f"{unseen}: that is beside its image; correct its world_from_camera or the guess, or leave its "
            "views out."
        )
    low = np.clip(np.floor(pixel.min(axis=0)), 0, np.maximum(size - least, 0)).astype(int)
    high = np.clip(np.ceil(pixel.max(axis=0)), np.minimum(low + least, size), size).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])

"""Which pixels of an image a part can be in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.parts import Part
from bcppl.simulators.camera import Camera


def region_of(
    camera: Camera, part: Part, world_from_part: npt.ArrayLike, within: float
) -> tuple[int, int, int, int]:
    """The left, top, width and height of the pixels in which a part can be, for `Camera.cropped`.

    Args:
        camera: what looks.
        part: what is looked for.
        world_from_part: (7,) where it is expected.
        within: how far from there it may be, metres, turned in any way about its middle.

    Returns:
        Whole pixels, at least one; the whole image where the part may be beside or behind the camera.
    """
    camera_from_world = poses.inverse(poses.as_pose(torch.as_tensor(np.asarray(camera.world_from_camera))))
    expected = poses.as_pose(torch.as_tensor(np.asarray(world_from_part)))
    middle = torch.as_tensor(0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0)))[None]
    there = poses.transform(camera_from_world, poses.transform(expected, middle)).numpy()
    reach = float(np.linalg.norm(part.extent) / 2 + within)
    # The near face of the cube around all it may fill: farther ones lie within its outline.
    corners = there + reach * np.array([[x, y, -1] for x in (-1, 1) for y in (-1, 1)])
    pixel = camera.project(corners)
    if not np.isfinite(pixel).all():
        return 0, 0, camera.width, camera.height
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixel.min(axis=0)), 0, size - 1).astype(int)
    high = np.clip(np.ceil(pixel.max(axis=0)), low + 1, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])

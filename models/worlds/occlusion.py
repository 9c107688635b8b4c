"""A box in front of a camera that is in no recording."""

from __future__ import annotations

import math

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.extrusion import block
from bcppl.geometry.parts import Part
from bcppl.rendering.ray_casting import RayCaster

WIDTH, LENGTH, THICKNESS = 0.05, 0.08, 0.01  # m


def occluder(
    camera: Camera, part: Part, world_from_part: Array, share: float, angle: float
) -> tuple[Part, Array]:
    """A box between a camera and a part that hides about a share of the part's pixels.

    It is half-way, perpendicular to the optical axis, and covers the part from one side.

    Args:
        camera: with its true pose.
        part: the part.
        world_from_part: (7,) its pose.
        share: of the part's pixels, from 0 to 1.
        angle: direction of the box in the image, radians from right to down.

    Returns:
        The box, and its pose (7,).

    Raises:
        InputError: the camera does not see the part.
    """
    depth = RayCaster(part).images(camera, world_from_part[None])[0].ravel()
    seen = np.isfinite(depth)
    if not seen.any():
        raise InputError(f"camera {camera.name!r} does not see part {part.name!r}; turn it towards the part.")
    halfway = 0.5 * float(np.median(depth[seen]))
    place = halfway * camera.rays()[seen][:, :2]
    outwards = np.array([math.cos(angle), math.sin(angle)])
    along = np.array([-outwards[1], outwards[0]])
    edge = float(np.quantile(place @ outwards, 1.0 - share))
    middle = (edge + 0.5 * WIDTH) * outwards + float(np.median(place @ along)) * along
    stand = torch.tensor([*middle, halfway, 0.0, 0.0, angle], dtype=torch.float64)
    world_from_box = poses.compose(
        torch.from_numpy(camera.world_from_camera), poses.retract(poses.identity(), stand)
    )
    return block((WIDTH, LENGTH, THICKNESS), "occluder"), world_from_box.numpy()

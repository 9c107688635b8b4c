"""First-order effects of a camera's extrinsic and range errors on the poses at which it sees parts."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from bcppl import poses
from bcppl.geometry.camera import Camera


@lru_cache(maxsize=256)
def _nominal(camera: Camera, device: torch.device) -> tuple[Tensor, Tensor]:
    """A camera's nominal position (3,), and its axes (3, 3) in columns, in the world."""
    pose = torch.as_tensor(camera.world_from_camera, dtype=torch.float64, device=device)
    return pose[:3], poses.rotation_matrix(pose)


def line_of_sight(camera: Camera, part: Tensor) -> Tensor:
    """Displacements (..., 3), in the world, of the apparent positions of parts for each metre of range bias.

    They are along the lines of sight to parts at `world_from_part` (..., 7), and one metre along the optical
    axis.
    """
    origin, axes = _nominal(camera, part.device)
    away = part[..., :3] - origin
    return away / (away @ axes[:, 2])[..., None]


def apparent_motion(camera: Camera, part: Tensor, shift: float, turn: float) -> Tensor:
    """How the apparent poses of parts change with an error of a camera's extrinsics, (..., 6, 6).

    An extrinsic error of v along and w about the camera's axes moves a part at p in them by -v + p x w and
    turns it by -w.

    Args:
        camera: with its nominal extrinsics.
        part: (..., 7) world_from_part, in whose tangent space the rows are: metres, radians.
        shift: the error along each of the camera's axes, metres, of the first three columns.
        turn: the error about each of them, radians, of the last three.
    """
    origin, axes = _nominal(camera, part.device)
    axes = axes.expand(*part.shape[:-1], 3, 3)
    away = part[..., :3] - origin
    across = torch.linalg.cross(away[..., None].expand_as(axes), axes, dim=-2)
    moved = torch.cat([-shift * axes, turn * across], dim=-1)
    turned = -turn * poses.rotation_matrix(part).transpose(-1, -2) @ axes
    return torch.cat([moved, torch.cat([torch.zeros_like(turned), turned], dim=-1)], dim=-2)

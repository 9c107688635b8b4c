"""What errors of a camera's stated pose and of its range do to what it seems to see, to first order."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from bcppl import poses
from bcppl.geometry.camera import Camera


@lru_cache(maxsize=256)
def _stated(camera: Camera) -> tuple[Tensor, Tensor]:
    """Where a camera is said to stand, and the direction in which it is said to look, (3,) each."""
    pose = torch.as_tensor(camera.world_from_camera, dtype=torch.float64)
    return pose[:3], poses.rotation_matrix(pose)[:, 2]


def line_of_sight(camera: Camera, part: Tensor) -> Tensor:
    """How parts at poses (..., 7), world_from_part, seem moved by each metre that is added to all ranges.

    Returns:
        Directions (..., 3) in the world, one metre deep along the optical axis.
    """
    origin, forward = _stated(camera)
    away = part[..., :3] - origin
    return away / (away @ forward)[..., None]


def apparent_covariance(camera: Camera, part: Tensor, shift: float, turn: float) -> Tensor:
    """How far parts seem moved where a camera does not stand quite where it is said to.

    With an error of v along and w about the camera's axes, a part at p in them seems moved by -v + p x w and
    turned by -w. The errors are the same about all axes, so it does not matter which way the camera looks.

    Args:
        camera: where it is said to stand.
        part: (..., 7) world_from_part.
        shift: standard deviation of the error along each of the camera's axes, metres.
        turn: and about each, radians.

    Returns:
        (..., 6, 6) in the tangent space at the part's pose: m^2, m rad, rad^2.
    """
    away = part[..., :3] - _stated(camera)[0]
    unit = torch.eye(3, dtype=torch.float64).expand(*away.shape, 3)
    # Columns are away x unit.
    across = turn * torch.linalg.cross(away[..., None, :].expand_as(unit), unit, dim=-1).transpose(-1, -2)
    moved = shift**2 * unit + across @ across.transpose(-1, -2)
    tied = -turn * across @ poses.rotation_matrix(part)
    upper = torch.cat([moved, tied], dim=-1)
    lower = torch.cat([tied.transpose(-1, -2), turn**2 * unit], dim=-1)
    return torch.cat([upper, lower], dim=-2)


def seen_elsewhere(first: Camera, second: Camera, part: Tensor, seen: Tensor) -> Tensor:
    """Where one instrument, taken by its word, sees a part from a second place, if its error stays the same.

    Args:
        first: the instrument where it sees the part at `seen`.
        second: the same instrument at the second place.
        part: (..., 7) where the part is, world_from_part.
        seen: (..., 7) where it is seen from the first place.
    """
    there, here = (torch.as_tensor(c.world_from_camera, dtype=torch.float64) for c in (second, first))
    through = poses.compose(there, poses.inverse(here))
    moved = poses.compose(seen, poses.inverse(part))
    return poses.compose(poses.compose(through, poses.compose(moved, poses.inverse(through))), part)

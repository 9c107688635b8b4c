"""First-order effects of a camera's extrinsic and range errors on the poses at which it sees parts."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from bcppl import poses
from bcppl.geometry.camera import Camera


@lru_cache(maxsize=256)
def _nominal(camera: Camera) -> tuple[Tensor, Tensor]:
    """A camera's nominal position and optical axis in the world, (3,) each."""
    pose = torch.as_tensor(camera.world_from_camera, dtype=torch.float64)
    return pose[:3], poses.rotation_matrix(pose)[:, 2]


def line_of_sight(camera: Camera, part: Tensor) -> Tensor:
    """Displacements (..., 3), in the world, of the apparent positions of parts for each metre of range bias.

    They are along the lines of sight to parts at `world_from_part` (..., 7), and one metre along the optical
    axis.
    """
    origin, forward = _nominal(camera)
    away = part[..., :3] - origin
    return away / (away @ forward)[..., None]


def apparent_covariance(camera: Camera, part: Tensor, shift: float, turn: float) -> Tensor:
    """Covariances (..., 6, 6) of the apparent poses of parts under an error of a camera's extrinsics.

    An extrinsic error of v along and w about the camera's axes moves a part at p in them by -v + p x w and
    turns it by -w. The error is isotropic, so the camera's orientation does not matter.

    Args:
        camera: with its nominal extrinsics.
        part: (..., 7) world_from_part, in whose tangent space the covariance is: m^2, m rad, rad^2.
        shift: standard deviation of the error along each of the camera's axes, metres.
        turn: standard deviation of the error about each of them, radians.
    """
    away = part[..., :3] - _nominal(camera)[0]
    unit = torch.eye(3, dtype=torch.float64).expand(*away.shape, 3)
    # Columns are away x unit.
    across = turn * torch.linalg.cross(away[..., None, :].expand_as(unit), unit, dim=-1).transpose(-1, -2)
    moved = shift**2 * unit + across @ across.transpose(-1, -2)
    mixed = -turn * across @ poses.rotation_matrix(part)
    upper = torch.cat([moved, mixed], dim=-1)
    lower = torch.cat([mixed.transpose(-1, -2), turn**2 * unit], dim=-1)
    return torch.cat([upper, lower], dim=-2)


def apparent_pose(first: Camera, second: Camera, part: Tensor, apparent: Tensor) -> Tensor:
    """Apparent poses (..., 7) of a part from a second viewpoint, under the extrinsic error of the first.

    Args:
        first: the instrument at the first viewpoint, with its nominal extrinsics.
        second: the same instrument at the second viewpoint.
        part: (..., 7) the part's true pose in the world.
        apparent: (..., 7) its apparent pose from the first viewpoint.
    """
    there, here = (torch.as_tensor(c.world_from_camera, dtype=torch.float64) for c in (second, first))
    through = poses.compose(there, poses.inverse(here))
    moved = poses.compose(apparent, poses.inverse(part))
    return poses.compose(poses.compose(through, poses.compose(moved, poses.inverse(through))), part)

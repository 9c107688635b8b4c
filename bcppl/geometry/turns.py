"""Turns of a part that may make it look nearly as before."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.parts import Part

_STEP = math.radians(30.0)  # contains the symmetries of polygons with 2, 3, 4, 6 and 12 corners

_ODD = (0.31, 1.17, 2.59)  # radians, symmetries of no polygon with few corners


@lru_cache(maxsize=8)
def box_turns(part: Part) -> Tensor:
    """The symmetries of a cube, and turns by multiples of 30 degrees about each axis, (K, 7).

    They are about the middle of the part's bounding box, along the axes of its frame, and map its frame to
    itself. What is not a symmetry of the part is among them too: who uses them compares.
    """
    about = [_STEP * k * axis for axis in np.eye(3) for k in range(1, 12)]
    every = np.concatenate(
        [
            Rotation.create_group("O").as_quat(canonical=True),
            Rotation.from_rotvec(about).as_quat(canonical=True),
        ]
    )
    _, first = np.unique(every.round(6), axis=0, return_index=True)
    other = torch.from_numpy(every[first][every[first, 3] < 1.0 - 1e-9])
    middle = torch.as_tensor(0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0)))
    turned = poses.from_translation_quaternion_xyzw(torch.zeros(len(other), 3).double(), other)
    there = torch.cat([middle, poses.identity()[3:]])
    return poses.compose(there, poses.compose(turned, poses.inverse(there)))


@lru_cache(maxsize=8)
def turns_freely(part: Part) -> bool:
    """Whether a part is round about the z axis of its frame: turns about it leave its surface where it is.

    A mesh is round to 1 % of its radius, the sagitta of a polygon of 22 corners.
    """
    radius = float(np.linalg.norm(part.vertices[:, :2], axis=1).max())
    turned = torch.zeros(len(_ODD), 6, dtype=torch.float64)
    turned[:, 5] = torch.tensor(_ODD)
    points = torch.from_numpy(part.surface_points(200))
    there = poses.transform(poses.retract(poses.identity(len(_ODD)), turned), points)
    return float(SignedDistance(part)(there.reshape(-1, 3)).distance.abs().max()) < 0.01 * radius

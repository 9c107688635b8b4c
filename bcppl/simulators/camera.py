"""A pinhole camera: intrinsics and where it stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bcppl.errors import InputError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in its optical frame: x right, y down, z forward; depth is along z, metres.

    Attributes:
        name: cameras are told apart by name; two views from two places are two cameras.
        width, height: the image's size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels; pixel (u, v) is centred at the
            integers, so it sees along ((u - cx) / fx, (v - cy) / fy, 1).
        world_from_camera: (7,) pose of the optical frame.
        near, far: the sensor's range in metres: a depth outside it is missing, not far away.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: Array
    near: float = 0.05
    far: float = 10.0

    def rays(self) -> Array:
        """Directions (height * width, 3) of the pixels in the optical frame, z = 1 (lengths are depths)."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        x, y = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


def looking_at(eye: npt.ArrayLike, point: npt.ArrayLike, up: npt.ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """The pose (7,) `world_from_camera` of an optical frame at `eye` that sees `point` in its middle.

    Args:
        eye: (3,) where the camera stands, metres in the world.
        point: (3,) what it looks at.
        up: (3,) the direction that is upwards in the image.

    Raises:
        InputError: the camera would look at itself, or straight along `up`.
    """
    there = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(point, dtype=np.float64) - there
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if not np.linalg.norm(right) > 1e-9 * max(float(np.linalg.norm(forward)), 1e-9):
        raise InputError(
            f"a camera at {there.tolist()} cannot look at {np.asarray(point).tolist()} with "
            f"{np.asarray(up).tolist()} upwards; give another point, or another direction for up."
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    return np.concatenate([there, Rotation.from_matrix(axes).as_quat()[[3, 0, 1, 2]]])

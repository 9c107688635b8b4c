"""A pinhole camera: intrinsics and where it stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

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

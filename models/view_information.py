"""What a depth image is expected to tell of a part's pose, for the models with cameras that err.

Fisher's information of the pixels, by finite differences of what is rendered, and what the camera's range
bias and the error of its stated pose leave of it. Images of one instrument share both, so the tenth tells
less than the first. Pixels are weighed as `RobustDepth` does: Laplace noise, outliers, a temperature.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl import poses
from bcppl.geometry.camera import Camera
from bcppl.rendering.region import region_of
from bcppl.rendering.renderer import DepthRenderer
from bcppl.rendering.stated_cameras import apparent_covariance
from bcppl.sensors import View
from bcppl.traces import Trace

Array = npt.NDArray[np.float64]

# Differences are taken over this much: less, and a ray's jumps from face to face are all there is.
STEPS = (5e-4, 5e-4, 5e-4, 5e-3, 5e-3, 5e-3)
JUMP = 0.01  # m: pixels that change by more go from the part to what is behind it, and are outliers
WITHIN = 0.01  # m around the mean pose that is looked at


def view_information(candidate: Any, trace: Trace) -> Tensor | None:
    """What a view would tell of the part beside what the trace's views told: (N, 6, 6) at its particles.

    It says what is told about one place of the part, nothing of which of several is right. For `information`
    of `bcppl.inference.design.linearised_information_gain`, and populations of
    `bcppl.models.look_and_touch`. Images of one instrument are taken to share its error as it appears at the
    part, wherever it looks from.

    Returns:
        None for what is no view.
    """
    if not isinstance(candidate, View):
        return None
    scene, actions = trace.args
    part, instrument = trace["part"], candidate.camera.instrument
    before = [a.camera for a in actions if isinstance(a, View) and a.camera.instrument == instrument]
    known = _told(scene, before, part)
    return _told(scene, [*before, candidate.camera], part) - known


def _told(scene: Any, cameras: Sequence[Camera], part: Tensor) -> Tensor:
    """What views of one instrument tell together of a part at poses (N, 7), (N, 6, 6)."""
    settings = scene.settings
    whole = torch.zeros(len(part), 7, 7, dtype=torch.float64)
    if not cameras:
        return whole[:, :6, :6]
    worth = (1.0 - settings.outlier) / (settings.scale**2 * settings.temperature)
    for camera in cameras:
        whole = whole + worth * pixel_information(scene.renderer, camera, part, settings.bins)
    both = whole[:, :6, 6:]
    own = whole[:, 6:, 6:] + 1.0 / settings.bias**2
    seen = whole[:, :6, :6] - both @ both.transpose(-1, -2) / own
    error = apparent_covariance(cameras[0], part, settings.camera_shift, settings.camera_turn)
    # (seen^-1 + error)^-1, also where what is seen tells nothing of an axis.
    eye = torch.eye(6, dtype=torch.float64)
    left = torch.linalg.solve(eye + seen @ error, seen)
    return 0.5 * (left + left.transpose(-1, -2))


def pixel_information(renderer: DepthRenderer, camera: Camera, part: Tensor, bins: int = 1) -> Tensor:
    """Sums (N, 7, 7) of products of how pixels' depths change with a part's pose (N, 7) and a range bias.

    Pixels at which the part comes or goes, or is out of the sensor's range, are left out. With `bins` a pixel
    is read for so many squared.
    """
    middle = part[0].numpy()
    spread = float((part[:, :3] - part[0, :3]).norm(dim=1).max())
    near = camera.cropped(*region_of(camera, renderer.part, middle, WITHIN + spread)).binned(bins)
    slopes = []
    for axis, step in enumerate(STEPS):
        away = torch.zeros(6, dtype=torch.float64)
        away[axis] = step
        ahead, behind = (_read(renderer, near, poses.retract(part, s * away)) for s in (1.0, -1.0))
        with np.errstate(invalid="ignore"):
            change = ahead - behind
        change = np.where(np.isfinite(change) & (np.abs(change) < JUMP), change, 0.0)
        slopes.append(torch.from_numpy(change.reshape(len(part), -1) / (2.0 * step)))
    sees = np.isfinite(_read(renderer, near, part)).reshape(len(part), -1)
    rows = torch.stack([*slopes, torch.from_numpy(sees.astype(np.float64))], dim=1)
    return rows @ rows.transpose(-1, -2)


def _read(renderer: DepthRenderer, camera: Camera, part: Tensor) -> Array:
    """Depths (N, height, width) as the sensor reads them: none out of its range."""
    depth = renderer.images(camera, part)
    with np.errstate(invalid="ignore"):
        return np.where((depth >= camera.near) & (depth <= camera.far), depth, np.nan)

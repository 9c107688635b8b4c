"""Fisher information of a depth image's pixels, by finite differences of the rendered depth."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.geometry.camera import Camera
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.region_of_interest import UnseenError, region_of_interest

# Steps of the differences; with smaller ones a ray's jumps from face to face dominate.
STEPS = (5e-4, 5e-4, 5e-4, 5e-3, 5e-3, 5e-3)
JUMP = 0.01  # m: a pixel that changes by more goes from the part to its background, and is an outlier
WITHIN = 0.01  # m: margin of the rendered region around where the part is by any pose


def pixel_information(renderer: PartRenderer, camera: Camera, part: Tensor, bins: int = 1) -> Tensor:
    """The sum (N, 7, 7) over pixels of the outer products of their gradients.

    The gradient of a pixel's depth is with respect to the part's pose (N, 7), in its tangent space, and to a
    range bias. Pixels at which the part appears or disappears, or that are out of the sensor's range, are
    left out: the sum is zero where no pixel shows the part. With `bins` one pixel stands for a square of so
    many.
    """
    middles = poses.transform(part, torch.as_tensor(renderer.part.middle)[None])
    spread = float((middles - middles[0]).norm(dim=-1).max())
    try:
        region = region_of_interest(camera, renderer.part, part[0].numpy(), WITHIN + spread, bins)
    except UnseenError:
        return torch.zeros(len(part), 7, 7, dtype=torch.float64)
    near = camera.cropped(*region).binned(bins)
    # A pixel that one step takes off the part, or on to it, has no gradient along any axis.
    kept = np.isfinite(_read(renderer, near, part))
    changes = []
    for axis, step in enumerate(STEPS):
        away = torch.zeros(6, dtype=torch.float64)
        away[axis] = step
        ahead, behind = (_read(renderer, near, poses.retract(part, s * away)) for s in (1.0, -1.0))
        with np.errstate(invalid="ignore"):
            change = ahead - behind
            kept &= np.abs(change) < JUMP  # not where one of them is NaN or infinite
        changes.append(change / (2.0 * step))
    gradients = np.where(kept, np.stack([*changes, np.ones_like(changes[0])]), 0.0)
    rows = torch.from_numpy(gradients).flatten(2).transpose(0, 1)
    return rows @ rows.transpose(-1, -2)


def _read(renderer: PartRenderer, camera: Camera, part: Tensor) -> Array:
    """Depths (N, height, width) in the sensor's range, NaN elsewhere."""
    depth = renderer.images(camera, part)
    with np.errstate(invalid="ignore"):
        return np.where((depth >= camera.near) & (depth <= camera.far), depth, np.nan)

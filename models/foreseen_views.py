"""What a view that is not yet taken would tell of the part, for `bcppl.models.look_and_touch`.

An image is foretold where the part is thought to be. What it says of where the camera sees the part is fitted
as it is when an image is taken in; how far off the camera may stand is added to that.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.fitted import fitted_normal
from bcppl.distributions.pose_normals import normal_like
from bcppl.models.camera_error import farther
from bcppl.models.look_and_touch_proposals import SHARPEST
from bcppl.models.look_and_touch_scene import Scene, image_of
from bcppl.recordings.measurements import View
from bcppl.simulators.stated_cameras import apparent_covariance
from bcppl.traces import Trace


def information_of_views(scene: Scene, part: Tensor, seed: int = 0) -> Callable[[Any, Trace], Tensor | None]:
    """What `bcppl.inference.probing.linearised` asks of candidates that are views.

    Args:
        scene: one that knows the candidates' cameras.
        part: (7,) where the part is thought to be.
        seed: of the images that are foretold.

    Returns:
        Of a candidate and a trace of H hypotheses, (H, 6, 6) information in the tangent space; None for what
        is no view. An instrument that has looked before counts as a new one, which promises too much where it
        looks from nearly the same place.
    """
    known: dict[str, Tensor] = {}

    def information(candidate: Any, trace: Trace) -> Tensor | None:
        if not isinstance(candidate, View):
            return None
        name = candidate.camera.name
        if name not in known:
            known[name] = told_by_view(scene, candidate, part, seed)
        return known[name].expand(trace.particles, 6, 6)

    return information


def told_by_view(scene: Scene, view: View, part: Tensor, seed: int = 0) -> Tensor:
    """The information (6, 6) of an image about a part at a pose (7,), its camera's errors integrated out."""
    settings, camera = scene.settings, scene.looks[view.camera.name].camera
    spread = normal_like(scene.prior).covariance.diagonal().sqrt()
    start = torch.cat([spread, torch.tensor([settings.bias], dtype=torch.float64)])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        image = image_of(scene, camera, part[None], 0.0).sample()[0]

        def log_density(point: Tensor) -> Tensor:
            seen, bias = poses.retract(part, point[:, :6]), point[:, 6]
            return image_of(scene, camera, farther(camera, seen, -bias), bias).log_prob(image)

        fit = fitted_normal(log_density, start, SHARPEST)
    # What the fit began with is no news.
    said = torch.linalg.inv(fit.covariance[:6, :6]) - torch.diag(start[:6] ** -2)
    values, axes = torch.linalg.eigh(0.5 * (said + said.T))
    said = axes @ torch.diag(values.clamp_min(0.0)) @ axes.T
    error = apparent_covariance(camera, part, settings.camera_shift, settings.camera_turn)
    told = said @ torch.linalg.inv(torch.eye(6, dtype=torch.float64) + error @ said)
    return 0.5 * (told + told.T)

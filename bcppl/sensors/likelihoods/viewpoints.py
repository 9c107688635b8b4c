"""Errors of one instrument at several viewpoints: most is common to all, some is each viewpoint's own.

A camera on a wrist is mounted as far off at every viewpoint, and the arm places it a little off at each. To
first order both move the pose at which it sees a part by a normal, correlated between viewpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.pose_normals import PoseFactor
from bcppl.geometry.camera import Camera
from bcppl.sensors.depth import View
from bcppl.sensors.measurements import Recording


def place_of(camera: Camera) -> tuple[str, tuple[float, ...]]:
    """What all images from one viewpoint have in common: the instrument, and its nominal pose."""
    return camera.instrument, tuple(np.asarray(camera.world_from_camera, dtype=np.float64).tolist())


def viewpoints_of(recording: Recording) -> dict[str, str]:
    """The name of a viewpoint, that of its first camera, by the names of a recording's cameras."""
    views = (m.action for m in recording.measurements if isinstance(m.action, View))
    first: dict[tuple[str, tuple[float, ...]], str] = {}
    return {v.camera.name: first.setdefault(place_of(v.camera), v.camera.name) for v in views}


class Sighting(NamedTuple):
    """Where an instrument sees a part from one viewpoint.

    Attributes:
        camera: at the viewpoint.
        seen: (..., 7) the part's apparent pose.
        bias: (...,) of the camera's range there, metres.
    """

    camera: Camera
    seen: Tensor
    bias: Tensor | float = 0.0

    def beside(self, other: Sighting) -> Sighting:
        """This sighting and another from the same viewpoint in one batch, (2, ...)."""
        bias = torch.stack([torch.as_tensor(each.bias) for each in (self, other)])
        return Sighting(self.camera, torch.stack([self.seen, other.seen]), bias)


class Prediction(NamedTuple):
    """The next sighting given those before: a normal about where it would be without errors.

    Attributes:
        mean: (..., 6) tangent there.
        covariance: (..., 6, 6).
        follows: (..., 6, 6) how far it moves with the part, for each of the part's tangents.
    """

    mean: Tensor
    covariance: Tensor
    follows: Tensor


@dataclass(frozen=True)
class InstrumentError:
    """The errors of an instrument.

    Attributes:
        effect: of a camera and a part (..., 7), the changes (..., 6, R) of the part's apparent pose, in its
            tangent space, by each of R independent errors of one standard deviation.
        own: the share of these standard deviations that is each viewpoint's own.
    """

    effect: Callable[[Camera, Tensor], Tensor]
    own: float

    def covariance(self, cameras: Sequence[Camera], part: Tensor) -> Tensor:
        """Covariance (..., 6 K, 6 K) of the apparent poses from K viewpoints of a part (..., 7)."""
        effects = [self.effect(camera, part) for camera in cameras]
        size = 6 * len(cameras)
        whole = part.new_zeros(*part.shape[:-1], size, size)
        for j, one in enumerate(effects):
            for k, other in enumerate(effects):
                common = 1.0 if j == k else 1.0 - self.own**2
                block = common * one @ other.transpose(-1, -2)
                whole[..., 6 * j : 6 * j + 6, 6 * k : 6 * k + 6] = block
        return whole

    def predicted(
        self, camera: Camera, part: Tensor, before: Sequence[Sighting], expected: Sequence[Tensor]
    ) -> Prediction:
        """The sighting by a camera of a part (..., 7), given those before.

        `expected` are the poses (..., 7) at which these would have been without errors.
        """
        whole = self.covariance([*(each.camera for each in before), camera], part)
        size = 6 * len(before)
        eye = torch.eye(6, dtype=torch.float64, device=part.device).expand(*part.shape[:-1], 6, 6)
        if not before:
            return Prediction(part.new_zeros(*part.shape[:-1], 6), whole, eye)
        away = torch.cat(
            [poses.local(pose, each.seen) for pose, each in zip(expected, before, strict=True)], dim=-1
        )
        factor = torch.linalg.cholesky(whole[..., :size, :size])
        gain = torch.cholesky_solve(whole[..., :size, size:], factor).transpose(-1, -2)
        left = whole[..., size:, size:] - gain @ whole[..., :size, size:]
        stacked = gain.unflatten(-1, (len(before), 6)).sum(dim=-2)
        return Prediction(
            (gain @ away[..., None])[..., 0], 0.5 * (left + left.transpose(-1, -2)), eye - stacked
        )

    def factor(self, sightings: Sequence[Sighting], more: Sequence[Tensor] = ()) -> PoseFactor:
        """The Gaussian over a part's pose (N, 7), given sightings whose range biases are removed.

        `more` are covariances (N, 6, 6) of each sighting, in addition.
        """
        cameras, center = [each.camera for each in sightings], sightings[0].seen

        def covariance(center: Tensor) -> Tensor:
            whole = self.covariance(cameras, center)
            for k, each in enumerate(more):
                own = slice(6 * k, 6 * k + 6)
                whole[..., own, own] = whole[..., own, own] + each
            return whole

        if len(cameras) == 1:
            return PoseFactor(center, covariance)
        alike = torch.eye(6, dtype=torch.float64, device=center.device).repeat(len(cameras), 1)

        def combined(center: Tensor) -> Tensor:
            return torch.linalg.inv(alike.T @ torch.linalg.solve(covariance(center), alike))

        for _ in range(3):  # what viewpoints differ in is sharp, and turns with the part
            away = torch.cat([poses.local(center, each.seen) for each in sightings], dim=-1)[..., None]
            pulls = torch.linalg.solve(covariance(center), away)
            middle = combined(center) @ alike.T @ pulls
            # How well the sightings agree: what they have in common is in the factor.
            squared = (away * pulls).sum(dim=(-2, -1)) - (middle * (alike.T @ pulls)).sum(dim=(-2, -1))
            center = poses.retract(center, middle[..., 0])
        spread = torch.linalg.slogdet(covariance(center))[1] - torch.linalg.slogdet(combined(center))[1]
        return PoseFactor(center, combined, -0.5 * (squared + spread))

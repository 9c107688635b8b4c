"""Likelihood of depth images by cameras whose extrinsics are in error and whose ranges are biased."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import whole_number
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.fitted import FittedMixture, fitted_mixture
from bcppl.distributions.pose_normals import (
    GaussianMixture,
    PoseFactor,
    allowed,
    mixture_of,
    normal_like,
    widened_mixture,
)
from bcppl.distributions.poses import NormalPose
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, bin_depth
from bcppl.geometry.turns import box_turns
from bcppl.rendering.extrinsics_error import apparent_covariance, apparent_pose, line_of_sight
from bcppl.rendering.information import pixel_information
from bcppl.rendering.ray_casting import RayCaster
from bcppl.rendering.region_of_interest import region_of_interest
from bcppl.sensors.depth import View
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered, require_positive
from bcppl.traces.carried import once

# The Gaussian fit of an image is no sharper than this: metres, radians, metres of bias.
SHARPEST = torch.tensor([5e-5] * 3 + [1e-3] * 3 + [1e-4], dtype=torch.float64)
_OUTSIDE = 4.0  # standard deviations of a camera's errors: an apparent pose is so far off the prior at most
_WIDER = 1.3  # standard deviations of a proposed bias, in those of the fit


@dataclass(frozen=True)
class CameraSettings:
    """Prior standard deviations of a camera's errors, and the noise of its pixels.

    Attributes:
        camera_shift, camera_turn: standard deviations of the error of a camera's stated pose, along and about
            each of its axes, metres and radians: those that an extrinsic calibration reports.
        bias: standard deviation of the bias of a camera's range, metres.
        scale: of the Laplace noise of a pixel, metres.
        outlier: the probability that a pixel does not show the part that is rendered there.
        bins: the side of the square of pixels that is replaced by its median.
        effective_pixels: number of independent pixels that an image is worth; None for all of them. The
            errors carry what all pixels have in common, not what neighbours at an edge have.
        temperature: the divisor of an image's log-likelihood, instead of `effective_pixels`.
    """

    camera_shift: float = 0.002
    camera_turn: float = math.radians(0.5)
    bias: float = 0.002
    scale: float = 0.002
    outlier: float = 0.1
    bins: int = 3
    effective_pixels: float | None = 100.0
    temperature: float | None = None

    def __post_init__(self) -> None:
        require_positive(self, "camera_shift", "camera_turn", "bias", "scale")
        whole_number("a camera's images are read with bins {}", self.bins)


class Look(NamedTuple):
    """The pixels of a camera's images that count.

    Attributes:
        region: left, top, width and height of where the part may be, pixels.
        camera: of that region, binned.
    """

    region: tuple[int, int, int, int]
    camera: Camera


class Instrument(NamedTuple):
    """One camera, which has the same errors in all its images, also of one on a wrist.

    Attributes:
        camera: where it took its first image.
        apparent: (N, 7) where it measures the part, range bias included, if its stated pose is taken as true.
        bias: (N,) of its range, metres.
    """

    camera: Camera
    apparent: Tensor
    bias: Tensor


class ErringCamera:
    """Depth images by cameras whose stated poses are in error and whose ranges are biased.

    A camera's error is not sampled as such but as the pose at which the camera, were its stated pose true,
    sees the part (`seen_by_*`). The image determines that pose whatever the error is, so particles need not
    follow a ridge; both parametrisations are the same model. One error and one bias (`bias_*`) is shared by
    all images of an instrument.

    Args:
        recording: its part, guess and views.
        prior: of the part's pose.
        settings: of the cameras.

    Raises:
        InputError: a camera cannot see the part near its guess.
    """

    def __init__(self, recording: Recording, prior: Any, settings: CameraSettings) -> None:
        self.settings, self.prior = settings, prior
        self.renderer = RayCaster(recording.part)
        self.looks: dict[str, Look] = {}
        within = float(np.linalg.norm(recording.guess.translation))
        guess, bins = recording.guess.world_from_part, settings.bins
        for camera in (m.action.camera for m in recording.measurements if isinstance(m.action, View)):
            if camera.name not in self.looks:
                region = region_of_interest(camera, recording.part, guess, within, bins)
                self.looks[camera.name] = Look(region, camera.cropped(*region).binned(bins))

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The cost of rendering."""
        return {"rendering": self.renderer.effort}

    def camera(self, action: View) -> Camera:
        """The cropped and binned camera of a view.

        Raises:
            InputError: the scene was prepared without views of this camera.
        """
        if action.camera.name not in self.looks:
            name = action.camera.name
            raise InputError(
                f"the scene was prepared without a view of camera {name!r}; prepare it with one."
            )
        return self.looks[action.camera.name].camera

    # ---- the program's sites

    def observe(self, number: int, action: View, world_from_part: Tensor) -> None:
        """Sample `depth_*`, and with an instrument's first image its `bias_*` and `seen_by_*`."""
        camera = self.camera(action)
        name = action.camera.instrument
        first = once(f"instrument {name}", partial(self._instrument, name, camera, world_from_part))
        there = without_bias(first.camera, first.apparent, first.bias)
        if camera.name != first.camera.name:
            there = apparent_pose(first.camera, camera, world_from_part, there)
        pyro.sample(f"depth_{number}", self.image(camera, there, first.bias))

    def _instrument(self, name: str, camera: Camera, part: Tensor) -> Instrument:
        bias = pyro.sample(
            f"bias_{name}", dist.Normal(torch.zeros((), dtype=torch.float64), self.settings.bias)
        )
        apparent = pyro.sample(f"seen_by_{name}", self._apparent(camera, part, bias))
        return Instrument(camera, apparent, bias)

    def _apparent(self, camera: Camera, part: Tensor, bias: Tensor) -> NormalPose:
        """The distribution of where a camera with a bias (N,) measures a part at poses (N, 7)."""
        settings = self.settings
        error = apparent_covariance(camera, part, settings.camera_shift, settings.camera_turn)
        return NormalPose(with_bias(camera, part, bias), error)

    def image(self, camera: Camera, there: Tensor, bias: Tensor | float) -> RobustDepth:
        """The likelihood of an image by a camera with a bias (N,) of a part at poses (N, 7)."""
        settings = self.settings
        return RobustDepth(
            self.renderer,
            camera,
            there,
            scale=settings.scale,
            outlier=settings.outlier,
            effective_pixels=settings.effective_pixels,
            temperature=settings.temperature,
            bias=bias,
        )

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """The cropped and binned images, by address."""
        values = {}
        for number, measurement in measurements:
            camera = self.camera(measurement.action)
            left, top, width, height = self.looks[camera.name].region
            region = measurement.observation.depth[top : top + height, left : left + width]
            binned = bin_depth(region, self.settings.bins, near=camera.near, far=camera.far)
            values[f"depth_{number}"] = torch.from_numpy(binned)
        return values

    # ---- a Gaussian approximation of an image's likelihood (`bcppl.sensors.capabilities.FitsPose`)

    def instrument(self, action: View) -> str:
        """The name of the instrument, which has one error for all its measurements."""
        return action.camera.instrument

    def fit(
        self, number: int, action: View, observations: Mapping[str, Tensor], near: Tensor | None = None
    ) -> FittedMixture:
        """Gaussians (7,) over the apparent pose, in the tangent space of the prior's mean, and the bias.

        There is one for each mode that turns about the middle of the part lead to (`box_turns`), and that
        poses `near` (K, 7) lead to.
        """
        camera, prior, image = self.camera(action), self.prior, observations[f"depth_{number}"]
        errors = self._errors(camera)

        def log_density(point: Tensor) -> Tensor:
            seen, bias = poses.retract(prior.center, point[:, :6]), point[:, 6]
            image_here = self.image(camera, without_bias(camera, seen, bias), bias).log_prob(image)
            return torch.where(allowed(prior, seen, _OUTSIDE * errors), image_here, -torch.inf)

        def alike(point: Tensor) -> Tensor:
            here = poses.retract(prior.center, point[:, :6])
            seen = poses.compose(here, turns[:, None])
            if near is not None:
                off = poses.compose(poses.inverse(here[0]), here)
                seen = torch.cat([seen, poses.compose(near[:, None], off)])
            images = torch.cat(
                [poses.local(prior.center, seen), point[:, 6:].expand(len(seen), -1, 1)], dim=2
            )
            return images[allowed(prior, seen[:, 0], _OUTSIDE * errors)]

        turns = box_turns(self.renderer.part)
        spread = torch.hypot(normal_like(prior).covariance.diagonal().sqrt(), errors)
        bias = torch.tensor([self.settings.bias], dtype=torch.float64)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # a fit depends on the image alone
            fit = fitted_mixture(log_density, torch.cat([spread, bias]), SHARPEST, alike)
        # Weights are of the likelihood alone, in the poses' base measure.
        own = 0.5 * (fit.means[:, :6] / spread).square().sum(dim=1)
        own = own + poses.FREE.log_base_density(fit.means[:, 3:6].norm(dim=1))
        return FittedMixture.of(fit.components, fit.log_weights + own)

    def _errors(self, camera: Camera) -> Tensor:
        """Standard deviations (6,) of the apparent pose of a part at the prior's mean."""
        center, settings = self.prior.center, self.settings
        error = apparent_covariance(camera, center, settings.camera_shift, settings.camera_turn).diagonal()
        along = settings.bias * line_of_sight(camera, center)
        return (error + torch.cat([along, torch.zeros_like(along)]).square()).sqrt()

    def factor(self, action: View, values: Mapping[str, Tensor]) -> PoseFactor:
        """The Gaussian over the part's pose, given where its camera measures it (N, 7) and its bias (N,)."""
        name, camera = action.camera.instrument, self.camera(action)
        there = without_bias(camera, values[f"seen_by_{name}"], values[f"bias_{name}"])
        return PoseFactor(there, self._covariance(camera))

    def marginal_factor(self, action: View, fit: FittedMixture) -> PoseFactor:
        """The Gaussian over the part's pose (M, 7), given each component of a fit of an image."""
        camera, points = self.camera(action), torch.stack([each.sigma_points() for each in fit.components])
        seen, bias = poses.retract(self.prior.center, points[..., :6]), points[..., 6]
        # Where the image leaves the part's pose open, so does the approximation.
        parts = without_bias(camera, seen, bias)
        away = poses.local(parts[:, :1], parts[:, 1:])
        return PoseFactor(parts[:, 0], self._covariance(camera, 0.5 * away.transpose(1, 2) @ away))

    def _covariance(self, camera: Camera, more: Tensor | float = 0.0) -> Any:
        settings = self.settings

        def covariance(center: Tensor) -> Tensor:
            error = apparent_covariance(camera, center, settings.camera_shift, settings.camera_turn)
            return error + more

        return covariance

    def information(self, done: Sequence[Any], action: View, part: Tensor) -> Tensor:
        """The information (N, 6, 6) that an image adds to the part's pose (N, 7) after `done`.

        Pixels are weighted as by `RobustDepth`; range bias and extrinsic error are integrated out. Images of
        one instrument share both, so the tenth adds less than the first. It is information about one mode:
        it does not discriminate between modes.
        """
        views = [a.camera for a in done if isinstance(a, View)]
        before = [camera for camera in views if camera.instrument == action.camera.instrument]
        return self._information([*before, action.camera], part) - self._information(before, part)

    def _information(self, cameras: Sequence[Camera], part: Tensor) -> Tensor:
        """The information (N, 6, 6) of images of one instrument together."""
        settings = self.settings
        whole = torch.zeros(len(part), 7, 7, dtype=torch.float64)
        if not cameras:
            return whole[:, :6, :6]
        weight = (1.0 - settings.outlier) / settings.scale**2 / (settings.temperature or 1.0)
        for camera in cameras:
            whole = whole + weight * pixel_information(self.renderer, camera, part, settings.bins)
        both = whole[:, :6, 6:]
        own = whole[:, 6:, 6:] + 1.0 / settings.bias**2
        seen = whole[:, :6, :6] - both @ both.transpose(-1, -2) / own
        error = apparent_covariance(cameras[0], part, settings.camera_shift, settings.camera_turn)
        # (seen^-1 + error)^-1, also where the image leaves an axis open.
        eye = torch.eye(6, dtype=torch.float64)
        left = torch.linalg.solve(eye + seen @ error, seen)
        return 0.5 * (left + left.transpose(-1, -2))

    # ---- proposals of the nuisance parameters

    def brings_nuisances(self, action: View, trace: Any) -> bool:
        """Whether this is the first image of its instrument."""
        return f"seen_by_{action.camera.instrument}" not in trace

    def propose(self, action: View, fit: FittedMixture, part: NormalPose | None) -> Mapping[str, Tensor]:
        """Sample the nuisance parameters from their approximate conditional, given their first image's fit.

        `part` is the part's pose (N, 7) given all measurements before; None where there are none.
        """
        name, camera = action.camera.instrument, self.camera(action)
        bias = pyro.sample(f"bias_{name}", self._bias(fit))
        around = self._given_bias(fit, bias)
        if part is not None:
            seen = self._apparent(camera, part.center, bias)
            around = around.times(NormalPose(seen.center, part.covariance + seen.covariance))
        seen_by = pyro.sample(f"seen_by_{name}", widened_mixture(around))
        return {f"bias_{name}": bias, f"seen_by_{name}": seen_by}

    def accompany(
        self, action: View, fit: FittedMixture, trace: Any, old: Tensor, new: Tensor, correlation: float
    ) -> None:
        """Sample the apparent pose for a part that moves, at the same quantile of its conditional.

        Contacts move the part by more than a camera's error; what the image leaves open has to follow.
        `correlation` is that of the standardised deviations from the conditional mean, before and after.
        """
        name, camera = action.camera.instrument, self.camera(action)
        bias = trace[f"bias_{name}"]
        seen = self._given_bias(fit, bias)
        before, after = (seen.times(self._apparent(camera, part, bias)) for part in (old, new))
        # The deviation is from the component that it most probably came of, and is kept in all others.
        at, own = trace[f"seen_by_{name}"], torch.arange(len(old))
        away = poses.local(before.centers[own, before.component(at)], at)
        centers = poses.retract(after.centers, correlation * away[:, None])
        covariances = (1.0 - correlation**2) * after.covariances
        pyro.sample(f"seen_by_{name}", mixture_of(GaussianMixture(centers, covariances, after.log_weights)))

    def _bias(self, fit: FittedMixture) -> Any:
        """The bias given an image, wider."""
        each = dist.Normal(fit.means[:, 6], _WIDER * fit.covariances[:, 6, 6].sqrt())
        if len(fit.means) == 1:
            return dist.Normal(each.mean[0], each.stddev[0])
        return dist.MixtureSameFamily(dist.Categorical(logits=fit.log_weights), each)

    def _given_bias(self, fit: FittedMixture, bias: Tensor) -> GaussianMixture:
        """The apparent pose, given an image and the bias (N,): M components for each."""
        own, both = fit.covariances[:, 6, 6], fit.covariances[:, :6, 6]
        away = bias[:, None] - fit.means[:, 6]
        off = fit.means[:, :6] + away[..., None] * both / own[:, None]
        covariances = fit.covariances[:, :6, :6] - both[:, :, None] * both[:, None] / own[:, None, None]
        return GaussianMixture(
            poses.retract(self.prior.center, off),
            covariances.expand(len(bias), -1, 6, 6),
            fit.log_weights - 0.5 * (away.square() / own + own.log()),
        )


def with_bias(camera: Camera, part: Tensor, bias: Tensor) -> Tensor:
    """The apparent pose (..., 7) of a part (..., 7) when a bias (...,) in metres is added to the ranges."""
    moved = part[..., :3] + bias[..., None] * line_of_sight(camera, part)
    return torch.cat([moved, part[..., 3:]], dim=-1)


def without_bias(camera: Camera, seen: Tensor, bias: Tensor) -> Tensor:
    """The pose (..., 7) of a part that is measured at (..., 7) with a bias (...,) in metres."""
    return with_bias(camera, seen, -bias)

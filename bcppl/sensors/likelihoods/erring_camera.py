"""Likelihood of depth images by cameras whose extrinsics are in error and whose ranges are biased."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.devices import on_device_of, same_random_state, seed_here
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
from bcppl.geometry.parts import Part
from bcppl.geometry.simplified import SEEN, simplified
from bcppl.geometry.turns import box_turns
from bcppl.rendering.extrinsics_error import apparent_motion, line_of_sight
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.rasterisation import renderer_for
from bcppl.rendering.region_of_interest import region_of_interest
from bcppl.sensors.depth import View
from bcppl.sensors.likelihoods.camera_information import information_of_images
from bcppl.sensors.likelihoods.camera_settings import CameraSettings
from bcppl.sensors.likelihoods.viewpoints import InstrumentError, Sighting, viewpoints_of
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Numbered
from bcppl.traces.carried import once

# The Gaussian fit of an image is no sharper than this: metres, radians, metres of bias.
SHARPEST = torch.tensor([5e-5] * 3 + [1e-3] * 3 + [1e-4], dtype=torch.float64)
_OUTSIDE = 4.0  # standard deviations of a camera's errors: an apparent pose is so far off the prior at most
_WIDER = 1.3  # standard deviations of a proposed bias, in those of the fit


class Look(NamedTuple):
    """The pixels of a camera's images that count.

    Attributes:
        region: left, top, width and height of where the part may be, pixels.
        camera: of that region, binned.
    """

    region: tuple[int, int, int, int]
    camera: Camera


class ErringCamera:
    """Depth images by cameras whose stated poses are in error and whose ranges are biased.

    A camera's error is not sampled as such but as the pose at which the camera, were its stated pose true,
    sees the part (`seen_by_*`). The image determines that pose whatever the error is, so particles need not
    follow a ridge; both parametrisations are the same model. All images from one viewpoint share that pose
    and a bias (`bias_*`); of both all viewpoints of one instrument share most (`InstrumentError`).

    Args:
        recording: its part, guess and views.
        prior: of the part's pose.
        settings: of the cameras.
        renderer: makes the renderer of the part; by default the one that is faster for its mesh.

    Raises:
        InputError: a camera cannot see the part near its guess.
    """

    nuisance_addresses = ("bias_*", "seen_by_*")

    def __init__(
        self,
        recording: Recording,
        prior: Any,
        settings: CameraSettings,
        renderer: Callable[[Part], PartRenderer] = renderer_for,
    ) -> None:
        self.settings, self.prior = settings, prior
        self.renderer = renderer(simplified(recording.part, SEEN))
        self.looks: dict[str, Look] = {}
        self.viewpoints = viewpoints_of(recording)
        motion = partial(apparent_motion, shift=settings.camera_shift, turn=settings.camera_turn)
        self.error = InstrumentError(motion, settings.viewpoint)
        # The part turns about its frame's origin, which may be far from its middle.
        within = recording.guess.farthest(recording.part.middle)
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
        """Sample `depth_*`, and with a viewpoint's first image its `bias_*` and `seen_by_*`."""
        camera, viewpoint = self.camera(action), self.viewpoint(action)
        sightings: dict[str, Sighting] = once(f"instrument {self.instrument(action)}", dict)
        if viewpoint not in sightings:
            before = list(sightings.values())
            bias = pyro.sample(f"bias_{viewpoint}", dist.Normal(*self.settings.expected_bias(before)))
            apparent, _ = self._apparent(camera, world_from_part, bias, before)
            sightings[viewpoint] = Sighting(camera, pyro.sample(f"seen_by_{viewpoint}", apparent), bias)
        sighting = sightings[viewpoint]
        there = without_bias(camera, sighting.seen, sighting.bias)
        pyro.sample(f"depth_{number}", self.image(camera, there, sighting.bias))

    def _apparent(
        self, camera: Camera, part: Tensor, bias: Tensor, before: Sequence[Sighting] = ()
    ) -> tuple[NormalPose, Tensor]:
        """The distribution of where a camera with a bias (N,) measures a part at poses (..., N, 7).

        Given where its instrument measured it before; and how far that distribution follows the part
        (..., N, 6, 6).
        """
        expected = [with_bias(each.camera, part, each.bias) for each in before]
        mean, covariance, follows = self.error.predicted(camera, part, before, expected)
        return NormalPose(poses.retract(with_bias(camera, part, bias), mean), covariance), follows

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
        """The name of the instrument, whose measurements' errors are correlated."""
        return action.camera.instrument

    def viewpoint(self, action: View) -> str:
        """The name of the viewpoint, whose measurements share all nuisance parameters."""
        self.camera(action)
        return self.viewpoints[action.camera.name]

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
            seen = poses.retract(prior.center, point[:, :6])
            inside = allowed(prior, seen, _OUTSIDE * errors)
            seen, bias = seen[inside], point[inside, 6]
            density = point.new_full(inside.shape, -torch.inf)
            density[inside] = self.image(camera, without_bias(camera, seen, bias), bias).log_prob(image)
            return density

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
        with same_random_state():
            seed_here(0)  # a fit depends on the image alone
            fit = fitted_mixture(log_density, torch.cat([spread, bias]), SHARPEST, alike)
        # Weights are of the likelihood alone, in the poses' base measure.
        own = 0.5 * (fit.means[:, :6] / spread).square().sum(dim=1)
        own = own + poses.FREE.log_base_density(fit.means[:, 3:6].norm(dim=1))
        return FittedMixture.of(fit.components, fit.log_weights + own)

    def _errors(self, camera: Camera) -> Tensor:
        """Standard deviations (6,) of the apparent pose of a part at the prior's mean."""
        center, settings = self.prior.center, self.settings
        error = self.error.covariance([camera], center).diagonal()
        along = settings.bias * line_of_sight(camera, center)
        return (error + torch.cat([along, torch.zeros_like(along)]).square()).sqrt()

    def factor(self, actions: Sequence[View], values: Mapping[str, Tensor]) -> PoseFactor:
        """The Gaussian over the part's pose, given where a camera measures it (N, 7) and its biases (N,)."""
        sightings = (self._sighting(self.viewpoint(action), values) for action in actions)
        return self.error.factor([s._replace(seen=without_bias(*s)) for s in sightings])

    def _sighting(self, viewpoint: str, values: Any) -> Sighting:
        camera = self.looks[viewpoint].camera
        return Sighting(camera, values[f"seen_by_{viewpoint}"], values[f"bias_{viewpoint}"])

    def marginal_factor(self, actions: Sequence[View], fits: Sequence[FittedMixture]) -> PoseFactor:
        """The Gaussian over the part's pose (M, 7), given each component of fits of one camera's images."""
        sightings, more = [], []
        for action, fit in zip(actions, fits, strict=True):
            camera = self.camera(action)
            points = torch.stack([each.sigma_points() for each in fit.components])
            seen, bias = poses.retract(self.prior.center, points[..., :6]), points[..., 6]
            # Where the image leaves the part's pose open, so does the approximation.
            parts = without_bias(camera, seen, bias)
            away = poses.local(parts[:, :1], parts[:, 1:])
            sightings.append(Sighting(camera, parts[:, 0]))
            more.append(0.5 * away.transpose(1, 2) @ away)
        return self.error.factor(sightings, more)

    def information(self, done: Sequence[Any], action: View, part: Tensor) -> Tensor:
        """The information (N, 6, 6) that an image adds to the part's pose (N, 7) after `done`.

        Pixels are weighted as by `RobustDepth` where none is missing; range bias and extrinsic error are
        integrated out. Images of one instrument share the bias and most of the error, so the tenth adds less
        than the first. It is information about one mode: it does not discriminate between modes.
        """
        views = [a.camera for a in done if isinstance(a, View)]
        before = [camera for camera in views if camera.instrument == action.camera.instrument]
        both, alone = (
            information_of_images(self.renderer, each, part, self.settings, self.error, self._pixels)
            for each in ([*before, action.camera], before)
        )
        return both - alone

    def _pixels(self, camera: Camera) -> int:
        """How many pixels of a camera's images are compared."""
        compared = self.camera(View(camera))
        return compared.width * compared.height

    # ---- proposals of the nuisance parameters

    def brings_nuisances(self, action: View, trace: Any) -> bool:
        """Whether this is the first image from its viewpoint."""
        return f"seen_by_{self.viewpoint(action)}" not in trace

    def propose(
        self, action: View, fit: FittedMixture, part: NormalPose | None, values: Mapping[str, Tensor]
    ) -> Mapping[str, Tensor]:
        """Sample the nuisance parameters from their approximate conditional, given their first image's fit.

        `part` is the part's pose (N, 7) given all measurements before, None where there are none; `values`
        are the nuisance parameters that these brought.
        """
        camera, viewpoint, before = self.camera(action), self.viewpoint(action), self._before(action, values)
        bias = pyro.sample(f"bias_{viewpoint}", self._bias(fit, before))
        around = self._given_bias(fit, bias)
        if part is not None:
            seen, follows = self._apparent(camera, part.center, bias, before)
            moved = follows @ part.covariance @ follows.transpose(-1, -2)
            around = around.times(NormalPose(seen.center, moved + seen.covariance))
        seen_by = pyro.sample(f"seen_by_{viewpoint}", widened_mixture(around))
        return {f"bias_{viewpoint}": bias, f"seen_by_{viewpoint}": seen_by}

    def accompany(
        self,
        action: View,
        fit: FittedMixture,
        trace: Any,
        old: Tensor,
        new: Tensor,
        correlation: float,
        values: Mapping[str, Tensor],
    ) -> Mapping[str, Tensor]:
        """Sample the apparent pose for a part that moves, at the same quantile of its conditional.

        Contacts move the part by more than a camera's error; what the image leaves open has to follow.
        `correlation` is that of the standardised deviations from the conditional mean, before and after;
        `values` has the nuisance parameters that were sampled before this.
        """
        camera, address = self.camera(action), f"seen_by_{self.viewpoint(action)}"
        bias, moved = trace[f"bias_{self.viewpoint(action)}"], ChainMap(dict(values), trace)
        # The conditionals of both at once, (2, N): a small batch costs by operations.
        known = zip(self._before(action, trace), self._before(action, moved), strict=True)
        sightings = [one.beside(other) for one, other in known]
        apparent, _ = self._apparent(camera, torch.stack([old, new]), bias, sightings)
        both = self._given_bias(fit, bias).times(apparent)
        before, after = (GaussianMixture(*each) for each in zip(*both, strict=True))
        # The deviation is from the component that it most probably came of, and is kept in all others.
        at, own = trace[address], torch.arange(len(old))
        away = poses.local(before.centers[own, before.component(at)], at)
        centers = poses.retract(after.centers, correlation * away[:, None])
        covariances = (1.0 - correlation**2) * after.covariances
        following = mixture_of(GaussianMixture(centers, covariances, after.log_weights))
        return {address: pyro.sample(address, following)}

    def _before(self, action: View, values: Any) -> list[Sighting]:
        """Where the camera of a view measured the part before, from other viewpoints, of what is known."""
        name, here, before = self.instrument(action), self.viewpoint(action), []
        for viewpoint in dict.fromkeys(self.viewpoints.values()):
            if viewpoint == here:
                break
            if self.looks[viewpoint].camera.instrument == name and f"seen_by_{viewpoint}" in values:
                before.append(self._sighting(viewpoint, values))
        return before

    def _bias(self, fit: FittedMixture, before: Sequence[Sighting]) -> Any:
        """The bias given an image, and those of the instrument's other viewpoints; wider."""
        mean, variance, log_weights = fit.means[:, 6], fit.covariances[:, 6, 6], fit.log_weights
        if before:
            expected, deviation = self.settings.expected_bias(before)
            away, both = expected[:, None] - mean, variance + deviation**2
            log_weights = log_weights - 0.5 * (away.square() / both + both.log())
            mean, variance = mean + variance / both * away, variance * deviation**2 / both
        each = dist.Normal(mean, _WIDER * variance.sqrt())
        if len(fit.means) == 1:
            return dist.Normal(each.mean[..., 0], each.stddev[..., 0])
        return dist.MixtureSameFamily(dist.Categorical(logits=log_weights), each)

    def _given_bias(self, fit: FittedMixture, bias: Tensor) -> GaussianMixture:
        """The apparent pose, given an image and the bias (N,): M components for each."""
        own, both = fit.covariances[:, 6, 6], fit.covariances[:, :6, 6]
        away = bias[:, None] - fit.means[:, 6]
        off = fit.means[:, :6] + away[..., None] * both / own[:, None]
        covariances = fit.covariances[:, :6, :6] - both[:, :, None] * both[:, None] / own[:, None, None]
        return GaussianMixture(
            poses.retract(on_device_of(self.prior.center, off), off),
            covariances.expand(len(bias), -1, 6, 6),
            fit.log_weights - 0.5 * (away.square() / own + own.log()),
        )


def with_bias(camera: Camera, part: Tensor, bias: Tensor | float) -> Tensor:
    """The apparent pose (..., 7) of a part (..., 7) when a bias (...,) in metres is added to the ranges."""
    bias = torch.as_tensor(bias, dtype=torch.float64, device=part.device)
    moved = part[..., :3] + bias[..., None] * line_of_sight(camera, part)
    return torch.cat([moved, part[..., 3:]], dim=-1)


def without_bias(camera: Camera, seen: Tensor, bias: Tensor | float) -> Tensor:
    """The pose (..., 7) of a part that is measured at (..., 7) with a bias (...,) in metres."""
    return with_bias(camera, seen, -bias)

"""A depth image of parts at poses: all but the density of one pixel."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.stats import norm
from torch import Tensor

from bcppl import poses
from bcppl.distributions.checks import Check
from bcppl.distributions.depth.observed import KEPT, Observed
from bcppl.distributions.depth.rendering import Array, HitsOfPoses, Mask, RendersDepth
from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.geometry.camera import Camera


class DepthDistribution(LazyDistribution):
    """A depth image whose pixels are independent given the poses, the camera's error and its bias.

    Neighbouring pixels err together. With `effective_pixels` the likelihood is raised to the power
    min(1, effective_pixels / number of valid pixels in the region), with `temperature` to 1 / temperature,
    the same for all particles. A power other than 1 makes it a power likelihood: no density of the image, and
    evidence containing it is a surrogate's. A latent `camera_error` and `bias` carry what pixels have in
    common by a density instead.

    Args:
        renderer: renders the part, or several.
        camera: where the image is said to be taken; its range says which pixels are missing.
        pose: (N, 7) `world_from_part`; (N, K, 7) for a renderer of K parts.
        scale: of the noise, metres; what it is exactly, the distribution says.
        background: (H, W) metres, depth of what else stands in view; NaN, 0 or None where unknown.
        effective_pixels: how many independent pixels the image is worth; None for all.
        region: (H, W) pixels that count at all; None for all.
        temperature: what the log-likelihood is divided by, instead of `effective_pixels`.
        camera_error: (N, 7) or (7,) `stated_camera_from_camera`: where the camera really stands, seen from
            where it is said to stand. What it moves, a background image does not say: render the background
            as a part of the scene. Sampled plainly beside the pose it mixes badly: the image tells how the
            two together place the part before the camera, far more sharply than either, so particles would
            have to follow a narrow ridge. `bcppl.models.camera_error` samples where the camera sees the part
            instead, which is the same model, and moves both at once.
        bias: (N,) or one for all, metres that are added to every rendered depth, the background's too.
        background_is_measured: whether the same sensor measured the background, whose depths then hold the
            bias already; otherwise they are where things are.

    Raises:
        InputError: a shape does not fit; the scale, effective_pixels, temperature or sensor's range is not
            positive; both effective_pixels and temperature, or both camera_error and background are given.
    """

    cost = 1

    def __init__(
        self,
        renderer: RendersDepth,
        camera: Camera,
        pose: Tensor,
        scale: float,
        background: Array | Tensor | None = None,
        effective_pixels: float | None = None,
        region: Mask | Tensor | None = None,
        *,
        temperature: float | None = None,
        camera_error: Tensor | None = None,
        bias: Tensor | float = 0.0,
        background_is_measured: bool = False,
    ) -> None:
        shape = (camera.height, camera.width)
        _check_shapes(renderer, camera, pose, camera_error, bias)
        if not (math.isfinite(scale) and scale > 0.0):
            raise InputError(f"the scale of the depth noise is {scale}; give a positive length in metres.")
        if effective_pixels is not None and not effective_pixels > 0.0:
            raise InputError(
                f"effective_pixels is {effective_pixels}; give a positive number, or None for all."
            )
        if temperature is not None and not (math.isfinite(temperature) and temperature > 0.0):
            raise InputError(f"temperature is {temperature}; give a positive number, or None for 1.")
        if temperature is not None and effective_pixels is not None:
            raise InputError(
                "both effective_pixels and temperature are given, and each says how much the image is worth; "
                "give one of them."
            )
        if not camera.far > camera.near >= 0.0:
            raise InputError(
                f"camera {camera.name!r} has the range {camera.near} to {camera.far} m; give 0 <= near < far."
            )
        for name, array in (("background", background), ("region", region)):
            if array is not None and tuple(array.shape) != shape:
                raise InputError(
                    f"the {name} of camera {camera.name!r} has shape {tuple(array.shape)}; "
                    f"give one of its image's, {shape}."
                )
        if camera_error is not None and background is not None:
            raise InputError(
                f"camera {camera.name!r} is given both a camera_error and a background image, which was "
                "rendered where the camera is said to stand; leave the background out, or render it as a "
                "part of the scene (bcppl.rendering.scene.background_part)."
            )
        super().__init__(len(pose), shape)
        self.renderer = renderer
        self.camera = camera
        self.pose = pose
        self.scale = float(scale)
        self.effective_pixels = effective_pixels
        self.temperature = temperature
        self.background = background
        self.region = region
        self.camera_error = camera_error
        self.bias = bias
        self.background_is_measured = background_is_measured
        self._log_uniform = -math.log(camera.far - camera.near)

    # ---- what a subclass says

    @property
    def _parameters(self) -> tuple[Any, ...]:
        """All that the density of a pixel hangs on beside what is observed and rendered there."""
        camera = self.camera
        return (type(self), camera.near, camera.far, self.scale, self.effective_pixels, self.temperature)

    def _log_density(self, depth: Tensor, rendered: Tensor) -> Tensor:
        """Log-density of pixels that read `depth` where `rendered` is rendered, metres."""
        raise NotImplementedError

    def _noisy(self, rendered: Tensor) -> Tensor:
        """Draws of pixels at which the depth `rendered` is known, metres."""
        return torch.distributions.Laplace(rendered, self.scale).sample()

    # ---- what is the same for all

    @property
    def _behind(self) -> Array:
        """The depth of the background, (H * W,): +inf where unknown, so that the nearer is the minimum."""
        if self.background is None:
            return np.full(self.camera.height * self.camera.width, np.inf)
        behind = np.asarray(self.background, dtype=np.float64).reshape(-1)
        return np.where(np.isfinite(behind) & (behind > 0.0), behind, np.inf)

    @cached_property
    def seen_pose(self) -> Tensor:
        """Where the parts would look the same from where the camera is said to stand, as `pose`."""
        pose = self.pose.detach()
        if self.camera_error is None:
            return pose
        stated = self.camera.stated_pose()
        error = poses.inverse(self.camera_error.detach().to(torch.float64))
        moved = poses.compose(poses.compose(stated, error), poses.inverse(stated))
        return poses.compose(moved if pose.ndim == 2 else moved[..., None, :], pose)

    @cached_property
    def _hits(self) -> HitsOfPoses:
        region = None if self.region is None else np.asarray(self.region, dtype=bool).reshape(-1)
        return HitsOfPoses(partial(self.renderer.hits, self.camera, self.seen_pose), region)

    def all_hits(self) -> HitsOfPoses:
        """What the camera sees of the parts at every pixel, for another site that hangs on the same."""
        return self._hits.keep_all()

    @cached_property
    def _biases(self) -> Array | None:
        """The biases (N,), metres; None where there is none."""
        if not isinstance(self.bias, Tensor) and self.bias == 0.0:
            return None
        bias = torch.as_tensor(self.bias, dtype=torch.float64).detach()
        return np.ascontiguousarray(bias.expand(len(self.pose)).numpy())

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of a depth image (H, W), or of one for each particle (N, H, W).

        Raises:
            InputError: a pose, a camera's error or a bias is not finite, or the image has another shape.
        """
        self._check_finite()
        seen = self.observed(value)
        hits = self._hits(np.asarray(seen.valid.any(axis=0)))
        pixel = hits.pixel
        behind = seen.behind.take(pixel)
        several = len(seen.depth) > 1
        if several:
            pixel = pixel + hits.particle * seen.depth.shape[1]
        depth = torch.from_numpy(seen.depth.take(pixel))
        shift = 0.0 if self._biases is None else self._biases.take(hits.particle)
        if self._biases is None or self.background_is_measured:
            rendered = np.minimum(hits.depth + shift, behind)
            gain = self._log_density(depth, torch.from_numpy(rendered)).numpy()
            gain -= seen.empty.take(pixel)
            total = seen.emptiness
        else:
            rendered = np.minimum(hits.depth, behind) + shift
            gain = self._log_density(depth, torch.from_numpy(rendered)).numpy()
            known = np.isfinite(behind)
            without = np.where(known, behind + shift, 0.0)
            gain -= np.where(
                known, self._log_density(depth, torch.from_numpy(without)).numpy(), self._log_uniform
            )
            total = seen.biased(self._log_density, self._log_uniform, self._biases)
        if several:
            gain = np.where(seen.valid.take(pixel), gain, 0.0)
        gains = np.bincount(hits.particle, weights=gain, minlength=len(self.pose))
        return torch.from_numpy(seen.power * (total + gains))

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One depth image for each particle, (N, H, W), metres, with no pixel missing.

        Where the ray misses the part and the background is unknown, the pixel is uniform over the sensor's
        range. Noise may push a pixel out of the range, where `log_prob` takes it for missing. A power
        (`effective_pixels`, `temperature`) does not change the draws.

        Raises:
            InputError: a pose, a camera's error or a bias is not finite, or a sample_shape was asked for.
        """
        if torch.Size(sample_shape) != torch.Size():
            raise InputError(
                f"{type(self).__name__} draws one image for each particle; ask for no sample_shape, "
                "or make it with more particles."
            )
        self._check_finite()
        images = torch.from_numpy(self.renderer.images(self.camera, self.seen_pose))
        bias = torch.zeros(1) if self._biases is None else torch.from_numpy(self._biases)
        behind = torch.from_numpy(self._behind).reshape(self.event_shape)
        if self.background_is_measured:
            rendered = torch.minimum(images + bias[:, None, None], behind)
        else:
            rendered = torch.minimum(images, behind) + bias[:, None, None]
        unknown = torch.isinf(rendered)
        noisy = self._noisy(torch.where(unknown, 0.0, rendered))
        return torch.where(unknown, self._uniform(rendered), noisy)

    def predictive_check(self, value: Tensor, replicas: Callable[[], Any]) -> Check:
        """The check of an image (H, W) at P particles (`bcppl.distributions.checks.Checked`).

        The discrepancy is -log p(y | theta), which is a sum over pixels and so nearly normal. Replicated
        images are missing where the observed one is.
        """
        many, observed = replicas(), -self.log_prob(value)
        replicated = -many.log_prob(self._replicated(value, many)).reshape(len(observed), -1)
        # One spread for all: that of a sum over pixels hardly depends on the pose.
        spread = float(replicated.var(dim=1).mean().sqrt())
        if not spread > 0.0:  # no pixel of the image counts
            return Check(1.0, "image", 0.0)
        excess = (observed - replicated.mean(dim=1)) / spread
        return Check(float(norm.sf(excess.numpy()).mean()), "image", float(excess.mean()))

    def _replicated(self, value: Tensor, many: Any) -> Tensor:
        missing = torch.from_numpy(~self.observed(value).valid.any(axis=0)).reshape(value.shape)
        return torch.where(missing, torch.nan, many.sample())

    def _uniform(self, like: Tensor) -> Tensor:
        return self.camera.near + (self.camera.far - self.camera.near) * torch.rand_like(like)

    def observed(self, value: Tensor) -> Observed:
        """What a depth image (H, W), or one for each particle (N, H, W), says without any pose.

        It is kept with the image for as long as image, background and region hold the same numbers. Warns
        where no pixel of it counts, for it then says nothing.

        Raises:
            InputError: the image has another shape.
        """
        image = value.detach().numpy()
        background, region = _plain(self.background), _plain(self.region)
        cached: Observed | None = KEPT.get(value)
        if cached is not None and cached.was_read_from(self._parameters, image, background, region):
            return cached
        batch = (self.batch_shape[0], *self.event_shape)
        if value.shape not in (self.event_shape, torch.Size(batch)):
            raise InputError(
                f"a depth image of camera {self.camera.name!r} has shape {tuple(value.shape)}; "
                f"give {tuple(self.event_shape)}, or {batch} for one image per particle."
            )
        image = np.array(image)
        depth = image.astype(np.float64, copy=False).reshape(-1, self.event_shape.numel())
        valid = np.isfinite(depth) & (depth > 0.0) & (depth >= self.camera.near) & (depth <= self.camera.far)
        if self.region is not None:
            valid &= np.asarray(self.region, dtype=bool).reshape(-1)
        if not valid.any():
            self._warn_of_silence(depth)
        beyond = self._behind
        known = np.isfinite(beyond)
        behind = torch.from_numpy(np.where(known, beyond, 0.0))
        shown = self._log_density(torch.from_numpy(depth), behind).numpy()
        empty = np.where(valid, np.where(known, shown, self._log_uniform), 0.0)
        power = np.ones(len(depth))
        if self.effective_pixels is not None:
            power = np.minimum(1.0, self.effective_pixels / np.maximum(valid.sum(axis=1), 1))
        elif self.temperature is not None:
            power = power / self.temperature
        background, region = _copy(background), _copy(region)
        observed = Observed(image, self._parameters, background, region, beyond, depth, valid, empty, power)
        KEPT[value] = observed
        return observed

    def _warn_of_silence(self, depth: Array) -> None:
        """Say that no pixel of an image (1 or N, H * W) counts, and what may be wrong."""
        camera, read = self.camera, depth[np.isfinite(depth) & (depth > 0.0)]
        if not read.size:
            why = "every pixel is missing"
        elif not ((read >= camera.near) & (read <= camera.far)).any():
            median = float(np.median(read))
            why = f"their median is {median:.4g} m and its range {camera.near:.4g} to {camera.far:.4g} m"
            if camera.near <= 0.001 * median <= camera.far:
                why += ": probably millimetres, scale the image by 0.001"
        else:
            why = "none within its range lies in the region"
        warnings.warn(
            f"no pixel of a depth image of camera {camera.name!r} counts and it says nothing of the pose; "
            f"{why}.",
            stacklevel=3,
        )

    def _check_finite(self) -> None:
        count = len(self.pose)
        latent = {"pose": self.pose, "camera error": self.camera_error, "bias": self.bias}
        for what, value in latent.items():
            if value is None:
                continue
            each = torch.as_tensor(value)
            each = each.expand(count, *each.shape[1 if len(each.shape) and len(each) == count else 0 :])
            bad = torch.nonzero(~torch.isfinite(each.reshape(count, -1)).all(dim=-1)).flatten().tolist()
            if bad:
                shown = ", ".join(map(str, bad[:10])) + (", ..." if len(bad) > 10 else "")
                raise InputError(
                    f"{len(bad)} of {count} particles have a {what} that is not finite "
                    f"(particles {shown}) and cannot be seen by camera {self.camera.name!r}; "
                    "look at what proposed them."
                )


def _plain(values: npt.NDArray[Any] | Tensor | None) -> npt.NDArray[Any] | None:
    """The numbers themselves, not copied."""
    return values.detach().numpy() if isinstance(values, Tensor) else values


def _copy(values: npt.NDArray[Any] | None) -> npt.NDArray[Any] | None:
    return None if values is None else np.array(values)


def _check_shapes(
    renderer: RendersDepth, camera: Camera, pose: Tensor, camera_error: Tensor | None, bias: Tensor | float
) -> None:
    parts = getattr(renderer, "parts", None)
    wanted = (7,) if parts is None else (len(parts), 7)
    if pose.ndim != 1 + len(wanted) or pose.shape[1:] != wanted:
        each = "one world_from_part" if parts is None else f"a world_from_part of each of {len(parts)} parts"
        raise InputError(
            f"the pose of a depth image has shape {tuple(pose.shape)}; "
            f"give {('N', *wanted)}, {each} per particle.".replace("'", "")
        )
    if camera_error is not None and tuple(camera_error.shape) not in ((7,), (len(pose), 7)):
        raise InputError(
            f"the camera_error of camera {camera.name!r} has shape {tuple(camera_error.shape)}; "
            f"give ({len(pose)}, 7), one stated_camera_from_camera per particle."
        )
    if isinstance(bias, Tensor) and tuple(bias.shape) not in ((), (len(pose),)):
        raise InputError(
            f"the bias of camera {camera.name!r} has shape {tuple(bias.shape)}; "
            f"give ({len(pose)},), metres, one per particle."
        )

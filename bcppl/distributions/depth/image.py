"""A depth image of parts at poses: all but the density of one pixel."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import ndtr
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.cached import cached_property
from bcppl.devices import is_on_host, numbers, on_device_of
from bcppl.distributions.checks import Check
from bcppl.distributions.depth.camera_image import CameraImage
from bcppl.distributions.depth.observed import CACHE, Observed
from bcppl.distributions.depth.pixels import PixelLaw, Pixels, log_densities, sum_gains
from bcppl.distributions.depth.rendering import CachedHits
from bcppl.distributions.parameters import IF_GIVEN, POSITIVE, ranges
from bcppl.errors import InputError
from bcppl.threads import parallel_sum, thread_count

HITS, CHUNKS = 1 << 16, 64  # of a chunk of work, at least; of these at most, each with sums of its own


@dataclass(eq=False, repr=False)
class DepthDistribution(CameraImage):
    """A depth image whose pixels are independent given the poses, the camera's error and its bias.

    The errors of neighbouring pixels are correlated. With `effective_pixels` the likelihood is raised to the
    power min(1, effective_pixels / number of valid pixels in the region), with `temperature` to
    1 / temperature, the same for all particles. A power other than 1 makes it a power likelihood: no density
    of the image, and evidence containing it is a surrogate's. A latent `camera_error` and `bias` model the
    common error of all pixels by a density instead.

    `sample` leaves no pixel missing, and ignores the power. Noise may push a pixel out of the sensor's range,
    where `log_prob` takes it for missing; one whose ray misses all that is known is uniform over the range.

    Args:
        renderer: renders the part, or several.
        camera: as stated by the recording; pixels out of its range are missing.
        pose: (N, 7) `world_from_part`; (N, K, 7) for a renderer of K parts.
        scale: of the noise, metres; the subclass defines it.
        background: (H, W) metres, depth of other things in view; NaN, 0 or None where unknown.
        effective_pixels: the number of independent pixels that are worth as much; None for all.
        region: (H, W) pixels that may count; None for all.
        temperature: the divisor of the log-likelihood, instead of `effective_pixels`.
        camera_error: (N, 7) or (7,) `stated_camera_from_camera`: the camera's true pose in the frame of the
            stated one. A background image does not move with it: render the background as a part of the
            scene. Sampled independently of the pose it mixes badly: the image informs the pose of the part
            in the true camera far more sharply than either factor, so the posterior is a narrow ridge.
            `bcppl.models.camera_error` samples the pose in the camera instead, which is the same model, and
            moves both at once.
        bias: (N,) or one for all, metres that are added to every rendered depth, the background's too.
        background_is_measured: whether the same sensor measured the background, whose depths then contain the
            bias already; otherwise they are true depths.

    Raises:
        InputError: a shape does not fit; a parameter or the sensor's range is out of range; both
            effective_pixels and temperature, or both camera_error and background are given.
    """

    latent = ("pose", "camera_error", "bias")

    scale: float = field(metadata=POSITIVE)
    background: Array | Tensor | None = None
    effective_pixels: float | None = field(default=None, metadata=IF_GIVEN)
    _: KW_ONLY
    temperature: float | None = field(default=None, metadata=IF_GIVEN)
    camera_error: Tensor | None = None
    bias: Tensor | float = 0.0
    background_is_measured: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        each = self.batch_shape
        self._check_shape("a background", self.background, self.event_shape)
        self._check_shape("a camera_error (stated_camera_from_camera)", self.camera_error, (7,), (*each, 7))
        self._check_shape("a bias", self.bias, (), each)
        if self.temperature is not None and self.effective_pixels is not None:
            raise InputError(
                f"{self._where} has both effective_pixels and temperature, and each is a power of the "
                "likelihood; give one of them."
            )
        if self.camera_error is not None and self.background is not None:
            raise InputError(
                f"{self._where} has both a camera_error and a background image, which was rendered from the "
                "camera's stated pose; give no background, or render it as a part of the scene "
                "(bcppl.rendering.scene.background_part)."
            )
        # Some pixels are uniform over the range. A camera's own may be infinite: it renders as well.
        what = f"{self._where} has a range from"
        near = number_within(f"{what} {{}} m", self.camera.near)
        far = number_within(f"{what} {near:g} m to {{}} m", self.camera.far, above=near)
        self._log_uniform = -math.log(far - near)

    # ---- a subclass defines the law of a pixel

    @property
    def _law(self) -> PixelLaw:
        """The law of a pixel; Laplace noise alone."""
        return PixelLaw(self.camera.near, self.camera.far, self.scale, 0.0)

    def _noisy(self, rendered: Tensor) -> Tensor:
        """Draws of pixels at which the depth `rendered` is known, metres."""
        return torch.distributions.Laplace(rendered, self.scale).sample()

    # ---- all subclasses share the rest

    @property
    def _settings(self) -> tuple[Any, ...]:
        """All that a pixel's density depends on besides its observed and rendered depth."""
        values = (getattr(self, name) for name in ranges(type(self)))
        return (type(self), self.camera.near, self.camera.far, *values)

    @property
    def _behind(self) -> Array:
        """The depth of the background, (H * W,): +inf where unknown, so that the nearer is the minimum."""
        if self.background is None:
            return np.full(self.camera.height * self.camera.width, np.inf)
        behind = np.asarray(self.background, dtype=np.float64).reshape(-1)
        return np.where(np.isfinite(behind) & (behind > 0.0), behind, np.inf)

    @cached_property
    def apparent_pose(self) -> Tensor:
        """The poses, shaped as `pose`, at which the stated camera renders the true camera's image."""
        pose = self.pose.detach()
        if self.camera_error is None:
            return pose
        stated = self.camera.stated_pose()
        error = poses.inverse(self.camera_error.detach().to(torch.float64))
        moved = poses.compose(poses.compose(stated, error), poses.inverse(stated))
        return poses.compose(moved if pose.ndim == 2 else moved[..., None, :], pose)

    @cached_property
    def _hits(self) -> CachedHits:
        region = None if self.region is None else np.asarray(self.region, dtype=bool).reshape(-1)
        return CachedHits(partial(self.renderer.hits, self.camera, self.apparent_pose), region)

    def all_hits(self) -> CachedHits:
        """The camera's view of the parts at every pixel, for another site with the same poses."""
        return self._hits.keep_all()

    @cached_property
    def _biases(self) -> Array | None:
        """The biases (N,), metres; None where there is none."""
        if not isinstance(self.bias, Tensor) and self.bias == 0.0:
            return None
        bias = torch.as_tensor(self.bias, dtype=torch.float64).detach()
        return np.ascontiguousarray(numbers(bias.expand(len(self.pose))))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of a depth image (H, W), or of one for each particle (N, H, W)."""
        self._check_finite()
        seen = self.observed(value)
        if not is_on_host(self.apparent_pose):
            return self._on_device(seen)
        hits = self._hits(np.asarray(seen.valid.any(axis=0)))
        bias = np.empty(0) if self._biases is None else self._biases
        moves = bool(len(bias)) and not self.background_is_measured
        total = seen.totals_at(self._law, bias) if moves else seen.total_without_part
        pixels = Pixels(seen.depth, seen.valid, seen.behind, seen.without_part, bias, moves)
        size = max(HITS, len(hits.pixel) // CHUNKS + 1)
        starts = range(0, len(hits.pixel), size)
        gains = np.zeros((len(starts), len(self.pose)))

        def work(first: int, last: int) -> int:
            for k in range(first, last):
                begin, end = starts[k], min(starts[k] + size, len(hits.pixel))
                sum_gains(begin, end, hits.particle, hits.pixel, hits.depth, pixels, self._law, gains[k])
            return 0

        parallel_sum(work, 0, len(starts), 1, thread_count())
        return torch.from_numpy(seen.power * (total + gains.sum(axis=0)))

    def _on_device(self, seen: Observed) -> Tensor:
        """Log-probability (N,) at poses on a GPU, where the renderer casts the rays and sums over pixels."""
        pose = self.apparent_pose
        caster = self.renderer.on(pose.device)  # type: ignore[attr-defined]
        given = isinstance(self.bias, Tensor) or self.bias != 0.0
        bias = torch.as_tensor(self.bias, dtype=torch.float64, device=pose.device).detach().expand(len(pose))
        moves = given and not self.background_is_measured
        total = on_device_of(seen.total_without_part, pose)
        if moves:
            nothing, known = seen.apart(self._law)
            total = on_device_of(nothing, pose)
            if known.any():
                shown = caster.totals(seen.depth[:, known], seen.behind[known], bias, self._law)
                total = total + shown
        pixels = Pixels(seen.depth, seen.valid, seen.behind, seen.without_part, np.empty(0), moves)
        gains = caster.gains(self.camera, pose, pixels, self._law, bias)
        return on_device_of(seen.power, pose) * (total + gains)

    def without_part(self, value: Tensor) -> Tensor:
        """Log-probability (1 or N,) of an image (H, W), or of N, with no part in view, and no bias."""
        seen = self.observed(value)
        return on_device_of(seen.power * seen.total_without_part, self.pose)

    def _sample(self) -> Tensor:
        images = torch.from_numpy(self.renderer.images(self.camera, self.apparent_pose))
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

        The discrepancy is -log p(y | theta) over the pixels at which one of the particles has the part: it is
        a sum over pixels and so nearly normal. Pixels off the part do not inform its pose, and a background
        that is off by the error of the camera's pose is no reason to doubt it. A power below 1 states that
        only so large a share of the pixels is independent, so the spread is larger by its root. Replicated
        images are missing where the observed one is.
        """
        every = np.ones(self.camera.height * self.camera.width, dtype=bool)
        shown = np.zeros_like(every)
        shown[self._hits(every).pixel] = True
        if self.region is not None:
            shown &= np.asarray(self.region, dtype=bool).reshape(-1)
        if not shown.any():
            return Check(1.0, "image", 0.0)
        power = float(self.observed(value).power.mean())
        # The image is copied, for the densities of all its pixels are cached with it.
        region, image = shown.reshape(self.camera.height, self.camera.width), value.clone()
        many, observed = replace(replicas(), region=region), -replace(self, region=region).log_prob(image)
        replicated = -many.log_prob(self._replicated(value, many)).reshape(len(observed), -1)
        # One spread for all: that of a sum over pixels hardly depends on the pose.
        spread = float(replicated.var(dim=1).mean().sqrt())
        if not spread > 0.0:  # no pixel of the part counts
            return Check(1.0, "image", 0.0)
        excess = math.sqrt(power) * (observed - replicated.mean(dim=1)) / spread
        return Check(float(ndtr(-excess.numpy()).mean()), "image", float(excess.mean()))

    def _replicated(self, value: Tensor, many: Any) -> Tensor:
        missing = torch.from_numpy(~self.observed(value).valid.any(axis=0)).reshape(value.shape)
        return torch.where(missing, torch.nan, many.sample())

    def _uniform(self, like: Tensor) -> Tensor:
        return self.camera.near + (self.camera.far - self.camera.near) * torch.rand_like(like)

    def observed(self, value: Tensor) -> Observed:
        """The densities of a depth image (H, W), or of one for each particle (N, H, W), without any part.

        They are cached with the image for as long as image, background and region are unchanged. Warns if no
        pixel counts, since the image then does not inform the pose.
        """
        given = [_numbers(each) for each in (value, self.background, self.region)]
        cached: Observed | None = CACHE.get(value)
        if cached is not None and cached.matches(self._settings, given):
            return cached
        self._check_image(value)
        copies = [None if each is None else np.array(each) for each in given]
        depth = np.asarray(copies[0], dtype=np.float64).reshape(-1, self.event_shape.numel())
        valid = np.isfinite(depth) & (depth > 0.0) & (depth >= self.camera.near) & (depth <= self.camera.far)
        if self.region is not None:
            valid &= np.asarray(self.region, dtype=bool).reshape(-1)
        if not valid.any():
            name, near, far = self.camera.name, self.camera.near, self.camera.far
            warnings.warn(
                f"no pixel of a depth image of camera {name!r} counts: it does not inform the pose, as all "
                f"are missing, out of its range of {near:.4g} to {far:.4g} m (millimetres?), or outside "
                "the region.",
                stacklevel=3,
            )
        behind = self._behind
        known = np.isfinite(behind)
        rendered = np.broadcast_to(np.where(known, behind, 0.0), depth.shape)
        shown = log_densities(depth.ravel(), rendered.ravel(), self._law).reshape(depth.shape)
        without = np.where(valid, np.where(known, shown, self._log_uniform), 0.0)
        power = np.ones(len(depth))
        if self.effective_pixels is not None:
            power = np.minimum(1.0, self.effective_pixels / np.maximum(valid.sum(axis=1), 1))
        elif self.temperature is not None:
            power = power / self.temperature
        observed = CACHE[value] = Observed(self._settings, copies, behind, depth, valid, without, power)
        return observed


def _numbers(values: npt.NDArray[Any] | Tensor | None) -> npt.NDArray[Any] | None:
    """The numbers of a tensor, not copied."""
    return numbers(values.detach()) if isinstance(values, Tensor) else values

"""What a depth camera measures of a part at a pose: likelihoods over whole depth images.

A pixel's density hangs on what is rendered there: the depth of the part, or of the static background where
that is nearer or the ray misses the part; where nothing is known to stand, the sensor's whole range. Missing
pixels (0, NaN, out of range) never count, and which are missing depends on the observation only.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.simulators.camera import Camera

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


class PixelHits(Protocol):
    """The pixels that see a part, for N particles: one entry for each (particle, pixel)."""

    @property
    def particle(self) -> npt.NDArray[np.int64]:
        """(M,) which particle."""

    @property
    def pixel(self) -> npt.NDArray[np.int64]:
        """(M,) which pixel, v * width + u."""

    @property
    def depth(self) -> Array:
        """(M,) depth along the optical axis, metres."""


class RendersDepth(Protocol):
    """A simulator of depth images, such as `bcppl.simulators.renderer.DepthRenderer`."""

    def hits(self, camera: Camera, world_from_part: Tensor, counted: Mask | None = None) -> PixelHits:
        """What the camera sees of the part at poses (N, 7), at the counted pixels (H * W,) only."""

    def images(self, camera: Camera, world_from_part: Tensor) -> Array:
        """Depth images (N, H, W) in metres, +inf where a pixel does not see the part."""


class Observed(NamedTuple):
    """What an observation alone says, computed once for all particles.

    Attributes:
        version: of the observation, (H, W) or (N, H, W); changes when the tensor is written to.
        parameters, background, region: those of the distribution that read it.
        behind: the depth of the background, +inf where unknown, (H * W,).
        depth: its pixels, (1 or N, H * W).
        valid: which of them count, (1 or N, H * W).
        empty: their log-density where no ray meets the part, 0 where they do not count, (1 or N, H * W).
        power: what the log-likelihood is multiplied by, (1 or N,).
    """

    version: int
    parameters: tuple[Any, ...]
    background: Array | Tensor | None
    region: Mask | Tensor | None
    behind: Array
    depth: Array
    valid: Mask
    empty: Array
    power: Array


# Every run of a program makes its distributions anew, at other poses: what an image says is kept with it.
_OBSERVED: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


class _Depth(LazyDistribution):
    """A depth image whose pixels are independent given the pose: all but the density of one pixel."""

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
    ) -> None:
        shape = (camera.height, camera.width)
        if pose.ndim != 2 or pose.shape[-1] != 7:
            raise InputError(
                f"the pose of a depth image has shape {tuple(pose.shape)}; "
                "give (N, 7), one world_from_part per particle."
            )
        if not (math.isfinite(scale) and scale > 0.0):
            raise InputError(f"the scale of the depth noise is {scale}; give a positive length in metres.")
        if effective_pixels is not None and not effective_pixels > 0.0:
            raise InputError(
                f"effective_pixels is {effective_pixels}; give a positive number, or None for all."
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
        super().__init__(len(pose), shape, inputs=(pose,))
        self.renderer = renderer
        self.camera = camera
        self.pose = pose
        self.scale = float(scale)
        self.effective_pixels = effective_pixels
        self.background = background
        self.region = region
        self._log_uniform = -math.log(camera.far - camera.near)

    @cached_property
    def _behind(self) -> Array:
        """The depth of the background, (H * W,): +inf where unknown, so that the nearer is the minimum."""
        if self.background is None:
            return np.full(self.camera.height * self.camera.width, np.inf)
        behind = np.asarray(self.background, dtype=np.float64).reshape(-1)
        return np.where(np.isfinite(behind) & (behind > 0.0), behind, np.inf)

    @property
    def _parameters(self) -> tuple[Any, ...]:
        """All that the density of a pixel hangs on beside what is observed and rendered there."""
        camera = self.camera
        return (type(self), camera.near, camera.far, self.scale, self.effective_pixels)

    def _log_density(self, residual: Tensor) -> Tensor:
        """Log-density of pixels, given how far they are from the depth rendered there, metres."""
        raise NotImplementedError

    def _noisy(self, rendered: Tensor) -> Tensor:
        """Draws of pixels at which the depth `rendered` is known, metres."""
        return torch.distributions.Laplace(rendered, self.scale).sample()

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of a depth image (H, W), or of one for each particle (N, H, W).

        Raises:
            InputError: a pose is not finite, or the image has another shape.
        """
        self._check_pose()
        seen = self.observed(value)
        hits = self.renderer.hits(self.camera, self.pose.detach(), counted=np.asarray(seen.valid.any(axis=0)))
        pixel = hits.pixel
        rendered = np.minimum(hits.depth, seen.behind.take(pixel))
        if len(seen.depth) > 1:
            pixel = pixel + hits.particle * seen.depth.shape[1]
        gain = self._log_density(torch.from_numpy(seen.depth.take(pixel) - rendered)).numpy()
        gain -= seen.empty.take(pixel)
        if len(seen.depth) > 1:
            gain = np.where(seen.valid.take(pixel), gain, 0.0)
        gains = np.bincount(hits.particle, weights=gain, minlength=len(self.pose))
        return torch.from_numpy(seen.power * (seen.empty.sum(axis=1) + gains))

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One depth image for each particle, (N, H, W), metres, with no pixel missing.

        Where the ray misses the part and the background is unknown, the pixel is uniform over the sensor's
        range. Noise may push a pixel out of the range, where `log_prob` takes it for missing. A power
        (`effective_pixels`) does not change the draws.

        Raises:
            InputError: a pose is not finite, or a sample_shape was asked for.
        """
        if torch.Size(sample_shape) != torch.Size():
            raise InputError(
                f"{type(self).__name__} draws one image for each particle; ask for no sample_shape, "
                "or make it with more particles."
            )
        self._check_pose()
        images = torch.from_numpy(self.renderer.images(self.camera, self.pose.detach()))
        rendered = torch.minimum(images, torch.from_numpy(self._behind).reshape(self.event_shape))
        unknown = torch.isinf(rendered)
        noisy = self._noisy(torch.where(unknown, 0.0, rendered))
        return torch.where(unknown, self._uniform(rendered), noisy)

    def _uniform(self, like: Tensor) -> Tensor:
        return self.camera.near + (self.camera.far - self.camera.near) * torch.rand_like(like)

    def observed(self, value: Tensor) -> Observed:
        """What a depth image (H, W), or one for each particle (N, H, W), says without any pose.

        Raises:
            InputError: the image has another shape.
        """
        cached: Observed | None = _OBSERVED.get(value)
        if (
            cached is not None
            and cached.version == value._version
            and cached.parameters == self._parameters
            and cached.background is self.background
            and cached.region is self.region
        ):
            return cached
        batch = (self.batch_shape[0], *self.event_shape)
        if value.shape not in (self.event_shape, torch.Size(batch)):
            raise InputError(
                f"a depth image of camera {self.camera.name!r} has shape {tuple(value.shape)}; "
                f"give {tuple(self.event_shape)}, or {batch} for one image per particle."
            )
        depth = value.detach().to(torch.float64).reshape(-1, self._behind.size).numpy()
        valid = np.isfinite(depth) & (depth > 0.0) & (depth >= self.camera.near) & (depth <= self.camera.far)
        if self.region is not None:
            valid &= np.asarray(self.region, dtype=bool).reshape(-1)
        known = np.isfinite(self._behind)
        shown = self._log_density(torch.from_numpy(depth - np.where(known, self._behind, 0.0))).numpy()
        empty = np.where(valid, np.where(known, shown, self._log_uniform), 0.0)
        power = np.ones(len(depth))
        if self.effective_pixels is not None:
            power = np.minimum(1.0, self.effective_pixels / np.maximum(valid.sum(axis=1), 1))
        read = (self._parameters, self.background, self.region)
        observed = Observed(value._version, *read, self._behind, depth, valid, empty, power)
        _OBSERVED[value] = observed
        return observed

    def _check_pose(self) -> None:
        bad = torch.nonzero(~torch.isfinite(self.pose).all(dim=-1)).flatten().tolist()
        if bad:
            shown = ", ".join(map(str, bad[:10])) + (", ..." if len(bad) > 10 else "")
            raise InputError(
                f"{len(bad)} of {len(self.pose)} particles have a pose that is not finite "
                f"(particles {shown}) and cannot be seen by camera {self.camera.name!r}; "
                "look at what proposed them."
            )


class LaplaceDepth(_Depth):
    """Independent Laplace noise on every pixel.

    log p(o | q) = sum over the valid pixels u of -|o(u) - r(u)| / b - log 2b, with r rendered at pose q and
    b the scale. Where the ray misses the part, r is the background; where that is unknown, the pixel's
    density is uniform over the sensor's range. A wrong pixel costs without bound: see `RobustDepth`.

    Neighbouring pixels err together. With `effective_pixels` the likelihood is raised to the power
    min(1, effective_pixels / number of valid pixels in the region), the same for all particles. A power other
    than 1 makes it a power likelihood: no density of the image, and evidence containing it is a surrogate's.

    Args:
        renderer: renders the part.
        camera: where the image is taken; its range says which pixels are missing.
        pose: (N, 7) `world_from_part`.
        scale: b, metres.
        background: (H, W) metres, depth of what else stands in view; NaN, 0 or None where unknown.
        effective_pixels: how many independent pixels the image is worth; None for all.
        region: (H, W) pixels that count at all; None for all.

    Raises:
        InputError: a shape does not fit, or the scale, effective_pixels or sensor's range is not positive.
    """

    def _log_density(self, residual: Tensor) -> Tensor:
        return -residual.abs() / self.scale - math.log(2.0 * self.scale)


class RobustDepth(_Depth):
    """Laplace noise on every pixel, or, with probability `outlier`, any depth within the sensor's range.

    p(o(u) | q) = (1 - outlier) exp(-|o(u) - r(u)| / b) / 2b + outlier / (far - near), so that what the model
    does not know (clutter, flying pixels) costs a bounded amount. Where the ray misses the part and the
    background is unknown, the uniform alone. The rest is as in `LaplaceDepth`, also that a power other than 1
    (`effective_pixels`) makes the evidence a surrogate's. Beam models of range finders mix the same way:
    Thrun, Burgard and Fox, Probabilistic Robotics, 6.3.

    Args:
        renderer: renders the part.
        camera: where the image is taken; its range says which pixels are missing.
        pose: (N, 7) `world_from_part`.
        scale: b, metres.
        background: (H, W) metres, depth of what else stands in view; NaN, 0 or None where unknown.
        effective_pixels: how many independent pixels the image is worth; None for all.
        region: (H, W) pixels that count at all; None for all.
        outlier: the probability of an outlier, between 0 and 1.

    Raises:
        InputError: as `LaplaceDepth`, or the outlier's probability is not between 0 and 1.
    """

    def __init__(
        self,
        renderer: RendersDepth,
        camera: Camera,
        pose: Tensor,
        scale: float,
        background: Array | Tensor | None = None,
        effective_pixels: float | None = None,
        region: Mask | Tensor | None = None,
        outlier: float = 0.1,
    ) -> None:
        if not 0.0 < outlier < 1.0:
            raise InputError(f"the probability of an outlier is {outlier}; give a number between 0 and 1.")
        self.outlier = float(outlier)
        super().__init__(renderer, camera, pose, scale, background, effective_pixels, region)

    @property
    def _parameters(self) -> tuple[Any, ...]:
        return (*super()._parameters, self.outlier)

    def _log_density(self, residual: Tensor) -> Tensor:
        inlier = torch.exp(-residual.abs() / self.scale) * ((1.0 - self.outlier) / (2.0 * self.scale))
        return torch.log(inlier + self.outlier * math.exp(self._log_uniform))

    def _noisy(self, rendered: Tensor) -> Tensor:
        return torch.where(
            torch.rand_like(rendered) < self.outlier, self._uniform(rendered), super()._noisy(rendered)
        )

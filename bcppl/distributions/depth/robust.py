"""A depth image with Laplace noise and outliers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.depth.rendering import Array, Mask, RendersDepth
from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.geometry.camera import Camera


class RobustDepth(DepthDistribution):
    """Laplace noise on every pixel, or, with probability `outlier`, any depth within the sensor's range.

    p(o(u) | q) = (1 - outlier) exp(-|o(u) - r(u)| / b) / 2b + outlier / (far - near), so that what the model
    does not know (clutter, flying pixels) costs a bounded amount. Where the ray misses the part and the
    background is unknown, the uniform alone. The rest is as in `LaplaceDepth`. Beam models of range finders
    mix the same way: Thrun, Burgard and Fox, Probabilistic Robotics, 6.3.

    Args:
        outlier: the probability of an outlier, between 0 and 1.
        **others: those of `DepthDistribution`.

    Raises:
        InputError: as `DepthDistribution`, or the outlier's probability is not between 0 and 1.
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
        **others: Any,
    ) -> None:
        if not 0.0 < outlier < 1.0:
            raise InputError(f"the probability of an outlier is {outlier}; give a number between 0 and 1.")
        self.outlier = float(outlier)
        super().__init__(renderer, camera, pose, scale, background, effective_pixels, region, **others)

    @property
    def _parameters(self) -> tuple[Any, ...]:
        return (*super()._parameters, self.outlier)

    def _log_density(self, depth: Tensor, rendered: Tensor) -> Tensor:
        residual = (depth - rendered).abs_()
        inlier = residual.mul_(-1.0 / self.scale).exp_().mul_((1.0 - self.outlier) / (2.0 * self.scale))
        return inlier.add_(self.outlier * math.exp(self._log_uniform)).log_()

    def _noisy(self, rendered: Tensor) -> Tensor:
        return torch.where(
            torch.rand_like(rendered) < self.outlier, self._uniform(rendered), super()._noisy(rendered)
        )

"""A depth image with Laplace noise and outliers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.depth.rendering import RendersDepth
from bcppl.distributions.parameters import PROBABILITY

if TYPE_CHECKING:
    from bcppl.geometry.camera import Camera


class RobustDepth(DepthDistribution):
    """Laplace noise on every pixel, or, with probability `outlier`, any depth within the sensor's range.

    p(o(u) | q) = (1 - outlier) exp(-|o(u) - r(u)| / b) / 2b + outlier / (far - near), so that the cost of
    what is not modelled (clutter, flying pixels) is bounded. Where the ray misses the part and the background
    is unknown, the uniform alone. The rest is as in `LaplaceDepth`. Beam models of range finders are such
    mixtures: Thrun, Burgard and Fox, Probabilistic Robotics, 6.3.

    Args:
        outlier: the probability of an outlier, above 0 and below 1.
        *others: those of `DepthDistribution`, in its order.
        **named: those of `DepthDistribution`, by name.

    Raises:
        InputError: as `DepthDistribution`, or the outlier's probability is out of range.
    """

    parameters = DepthDistribution.parameters | {"outlier": PROBABILITY}

    def __init__(
        self,
        renderer: RendersDepth,
        camera: Camera,
        pose: Tensor,
        scale: float,
        *others: Any,
        outlier: float = 0.1,
        **named: Any,
    ) -> None:
        self.outlier = outlier
        super().__init__(renderer, camera, pose, scale, *others, **named)

    def _log_density(self, depth: Tensor, rendered: Tensor) -> Tensor:
        residual = (depth - rendered).abs_()
        inlier = residual.mul_(-1.0 / self.scale).exp_().mul_((1.0 - self.outlier) / (2.0 * self.scale))
        return inlier.add_(self.outlier * math.exp(self._log_uniform)).log_()

    def _noisy(self, rendered: Tensor) -> Tensor:
        return torch.where(
            torch.rand_like(rendered) < self.outlier, self._uniform(rendered), super()._noisy(rendered)
        )

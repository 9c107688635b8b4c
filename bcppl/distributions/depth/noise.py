"""Depth images with independent noise on every pixel: Laplace, with outliers."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.depth.pixels import PixelLaw
from bcppl.distributions.parameters import PROBABILITY


class LaplaceDepth(DepthDistribution):
    """Independent Laplace noise on every pixel.

    log p(o | q) = sum over the valid pixels u of -|o(u) - r(u)| / b - log 2b, with r rendered at pose q and
    b the scale. Where the ray misses the part, r is the background; where that is unknown, the pixel's
    density is uniform over the sensor's range. A wrong pixel costs without bound: see `RobustDepth`.

    Arguments are those of `DepthDistribution`.
    """


@dataclass(eq=False, repr=False)
class RobustDepth(DepthDistribution):
    """Laplace noise on every pixel, or, with probability `outlier`, any depth within the sensor's range.

    p(o(u) | q) = (1 - outlier) exp(-|o(u) - r(u)| / b) / 2b + outlier / (far - near), so that the cost of
    unmodelled pixels (clutter, flying pixels) is bounded. Where the ray misses the part and the background
    is unknown, the uniform alone. The rest is as in `LaplaceDepth`. Beam models of range finders are such
    mixtures: Thrun, Burgard and Fox, Probabilistic Robotics, 6.3.

    Arguments are those of `DepthDistribution`, and `outlier`, the probability of an outlier.
    """

    outlier: float = field(default=0.1, kw_only=True, metadata=PROBABILITY)

    @property
    def _law(self) -> PixelLaw:
        return super()._law._replace(outlier=self.outlier)

    def _noisy(self, rendered: Tensor) -> Tensor:
        return torch.where(
            torch.rand_like(rendered) < self.outlier, self._uniform(rendered), super()._noisy(rendered)
        )

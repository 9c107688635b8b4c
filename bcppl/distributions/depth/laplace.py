"""A depth image with Laplace noise."""

from __future__ import annotations

import math

from torch import Tensor

from bcppl.distributions.depth.image import DepthDistribution


class LaplaceDepth(DepthDistribution):
    """Independent Laplace noise on every pixel.

    log p(o | q) = sum over the valid pixels u of -|o(u) - r(u)| / b - log 2b, with r rendered at pose q and
    b the scale. Where the ray misses the part, r is the background; where that is unknown, the pixel's
    density is uniform over the sensor's range. A wrong pixel costs without bound: see `RobustDepth`.

    Arguments and errors are those of `DepthDistribution`.
    """

    def _log_density(self, depth: Tensor, rendered: Tensor) -> Tensor:
        return -(depth - rendered).abs() / self.scale - math.log(2.0 * self.scale)

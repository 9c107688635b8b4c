"""A depth image before which something unknown may stand."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.depth.rendering import RendersDepth
from bcppl.distributions.parameters import PROBABILITY
from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.geometry.camera import Camera


class OccludedDepth(DepthDistribution):
    """Laplace noise, or an occluder in front, or any depth within the sensor's range.

    p(o(u) | q) = (1 - occluder - outlier) exp(-|o(u) - r(u)| / b) / 2b
    + occluder [near < o(u) < r(u)] / (r(u) - near) + outlier / (far - near),

    so that a hand, a cable or a bin's wall before the part costs little, and seeing through the part costs
    more. It is the beam model of range finders with uniform short readings (Thrun, Burgard and Fox,
    Probabilistic Robotics, 6.3.1, has them decay with range: there people stand near the robot). Where the
    surface is nearer to the sensor's limit than b, so that no occluder fits in between, its share goes to the
    outliers; a surface beyond the range may be hidden within all of it. Where the ray misses the part and the
    background is unknown, the uniform alone. It integrates to one over all depths, and over the sensor's
    range but for the Laplace noise beyond it, as `LaplaceDepth` does.

    Args:
        occluder: the probability of an occluder in front, above 0 and below 1.
        outlier: the probability of any other depth, above 0 and below 1; their sum is below 1.
        *others: those of `DepthDistribution`, in its order.
        **named: those of `DepthDistribution`, by name.

    Raises:
        InputError: as `DepthDistribution`, or a probability is out of range, or their sum is 1 or more.
    """

    parameters = DepthDistribution.parameters | {"occluder": PROBABILITY, "outlier": PROBABILITY}

    def __init__(
        self,
        renderer: RendersDepth,
        camera: Camera,
        pose: Tensor,
        scale: float,
        *others: Any,
        occluder: float = 0.1,
        outlier: float = 0.05,
        **named: Any,
    ) -> None:
        self.occluder, self.outlier = occluder, outlier
        super().__init__(renderer, camera, pose, scale, *others, **named)
        if occluder + outlier >= 1.0:
            raise InputError(
                f"OccludedDepth has occluder = {occluder} and outlier = {outlier}; "
                "give probabilities that add up to less than 1."
            )

    def _room(self, rendered: Tensor) -> Tensor:
        """The part of the sensor's range before the surface, metres; 0 where no occluder fits in."""
        room = rendered.clamp(max=self.camera.far) - self.camera.near
        return torch.where(room > self.scale, room, 0.0)

    def _log_density(self, depth: Tensor, rendered: Tensor) -> Tensor:
        inlier = torch.exp((depth - rendered).abs_().mul_(-1.0 / self.scale))
        inlier.mul_((1.0 - self.occluder - self.outlier) / (2.0 * self.scale))
        room = self._room(rendered)
        uniform = math.exp(self._log_uniform)
        before = (depth > self.camera.near) & (depth < self.camera.near + room)
        hidden = torch.where(before, self.occluder / room, 0.0)
        spread = torch.where(room > 0.0, self.outlier * uniform, (self.occluder + self.outlier) * uniform)
        return torch.log(inlier + hidden + spread)

    def _noisy(self, rendered: Tensor) -> Tensor:
        chance, room = torch.rand_like(rendered), self._room(rendered)
        hidden = self.camera.near + room * torch.rand_like(rendered)
        hidden = torch.where(room > 0.0, hidden, self._uniform(rendered))
        noisy = torch.where(chance < self.occluder, hidden, super()._noisy(rendered))
        return torch.where(chance > 1.0 - self.outlier, self._uniform(rendered), noisy)

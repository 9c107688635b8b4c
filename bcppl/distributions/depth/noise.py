"""Depth images with independent noise on every pixel: Laplace, with outliers, with occluders."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from bcppl.distributions.depth.image import DepthDistribution
from bcppl.distributions.depth.pixels import PixelLaw
from bcppl.distributions.parameters import PROBABILITY
from bcppl.errors import InputError


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


@dataclass(eq=False, repr=False)
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

    Arguments are those of `DepthDistribution`, and the probabilities of an occluder in front, `occluder`, and
    of any other depth, `outlier`, whose sum is below 1.
    """

    occluder: float = field(default=0.1, kw_only=True, metadata=PROBABILITY)
    outlier: float = field(default=0.05, kw_only=True, metadata=PROBABILITY)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.occluder + self.outlier >= 1.0:
            raise InputError(
                f"OccludedDepth has occluder = {self.occluder} and outlier = {self.outlier}; "
                "give probabilities that add up to less than 1."
            )

    def _room(self, rendered: Tensor) -> Tensor:
        """The part of the sensor's range before the surface, metres; 0 where no occluder fits in."""
        room = rendered.clamp(max=self.camera.far) - self.camera.near
        return torch.where(room > self.scale, room, 0.0)

    @property
    def _law(self) -> PixelLaw:
        return super()._law._replace(occluder=self.occluder, outlier=self.outlier)

    def _noisy(self, rendered: Tensor) -> Tensor:
        chance, room = torch.rand_like(rendered), self._room(rendered)
        hidden = self.camera.near + room * torch.rand_like(rendered)
        hidden = torch.where(room > 0.0, hidden, self._uniform(rendered))
        noisy = torch.where(chance < self.occluder, hidden, super()._noisy(rendered))
        return torch.where(chance > 1.0 - self.outlier, self._uniform(rendered), noisy)

"""How far a camera may err, and the noise of its pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from bcppl.devices import on_device_of, on_host
from bcppl.distributions.parameters import COUNT, IF_GIVEN, POSITIVE, PROBABILITY, check_parameters, within
from bcppl.sensors.likelihoods.viewpoints import Sighting


@dataclass(frozen=True)
class CameraSettings:
    """Prior standard deviations of a camera's errors, and the noise of its pixels.

    Attributes:
        camera_shift, camera_turn: standard deviations of the error of a camera's stated pose, along and about
            each of its axes, metres and radians: those that an extrinsic calibration reports.
        bias: standard deviation of the bias of a camera's range, metres.
        viewpoint: the share of these that is each viewpoint's own, of a camera on a wrist: by 0.15 the arm
            places it .3 mm and .08 degrees off, and its range is .3 mm off in addition.
        scale: of the Laplace noise of a pixel, metres.
        outlier: the probability that a pixel does not show the part that is rendered there.
        bins: the side of the square of pixels that is replaced by its median.
        effective_pixels: number of independent pixels that an image is worth; None for all of them. The
            errors carry what all pixels have in common, not what neighbours at an edge have.
        temperature: the divisor of an image's log-likelihood, instead of `effective_pixels`.
    """

    camera_shift: float = field(default=0.002, metadata=POSITIVE)
    camera_turn: float = field(default=math.radians(0.5), metadata=POSITIVE)
    bias: float = field(default=0.002, metadata=POSITIVE)
    viewpoint: float = field(default=0.15, metadata=within(above=0.0, most=1.0))
    scale: float = field(default=0.002, metadata=POSITIVE)
    outlier: float = field(default=0.1, metadata=PROBABILITY)
    bins: int = field(default=3, metadata=COUNT)
    effective_pixels: float | None = field(default=100.0, metadata=IF_GIVEN)
    temperature: float | None = field(default=None, metadata=IF_GIVEN)

    def __post_init__(self) -> None:
        check_parameters(self)

    def pixel_weight(self, valid: int) -> float:
        """The Fisher information about its depth of one of so many pixels of an image that count, 1/m^2.

        That of the Laplace law where the part is seen, by the power to which the likelihood is raised.
        """
        power = 1.0 / (self.temperature or 1.0)
        if self.effective_pixels is not None:
            power = min(1.0, self.effective_pixels / max(valid, 1))
        return power * (1.0 - self.outlier) / self.scale**2

    def bias_covariance(self, count: int) -> Tensor:
        """The covariance (K, K) of the biases at K viewpoints of one instrument, m^2."""
        common = 1.0 - self.viewpoint**2
        return self.bias**2 * (common + (1.0 - common) * torch.eye(count, dtype=torch.float64))

    def expected_bias(self, before: Sequence[Sighting]) -> tuple[Tensor, float]:
        """Mean (N,) and standard deviation of a viewpoint's bias, given those of its instrument's others."""
        if not before:
            return torch.zeros((), dtype=torch.float64), self.bias
        with on_host():
            whole = self.bias_covariance(len(before) + 1)
            gain = torch.linalg.solve(whole[:-1, :-1], whole[:-1, -1])
        biases = torch.stack([torch.as_tensor(each.bias) for each in before], dim=-1)
        return biases @ on_device_of(gain, biases), math.sqrt(whole[-1, -1] - gain @ whole[:-1, -1])

"""How far a camera may err, and the noise of its pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.sensors.likelihoods.viewpoints import Sighting
from bcppl.sensors.scene import require_positive


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

    camera_shift: float = 0.002
    camera_turn: float = math.radians(0.5)
    bias: float = 0.002
    viewpoint: float = 0.15
    scale: float = 0.002
    outlier: float = 0.1
    bins: int = 3
    effective_pixels: float | None = 100.0
    temperature: float | None = None

    def __post_init__(self) -> None:
        require_positive(self, "camera_shift", "camera_turn", "bias", "scale")
        number_within("each viewpoint's own share of the errors is {}", self.viewpoint, above=0.0, most=1.0)
        whole_number("a camera's images are read with bins {}", self.bins)

    def bias_covariance(self, count: int) -> Tensor:
        """The covariance (K, K) of the biases at K viewpoints of one instrument, m^2."""
        common = 1.0 - self.viewpoint**2
        return self.bias**2 * (common + (1.0 - common) * torch.eye(count, dtype=torch.float64))

    def expected_bias(self, before: Sequence[Sighting]) -> tuple[Tensor, float]:
        """Mean (N,) and standard deviation of a viewpoint's bias, given those of its instrument's others."""
        if not before:
            return torch.zeros((), dtype=torch.float64), self.bias
        whole = self.bias_covariance(len(before) + 1)
        gain = torch.linalg.solve(whole[:-1, :-1], whole[:-1, -1])
        biases = torch.stack([torch.as_tensor(each.bias) for each in before], dim=-1)
        return biases @ gain, math.sqrt(whole[-1, -1] - gain @ whole[:-1, -1])

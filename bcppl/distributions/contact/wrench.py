"""The likelihood of the wrench itself, of which contact locations are one function."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.contact.track import WIDER, TrackDistribution, contaminated
from bcppl.distributions.parameters import COUNT, NONNEGATIVE, POSITIVE, PROBABILITY, check_shape


@dataclass(eq=False, repr=False)
class Wrench(TrackDistribution):
    """The wrench on the held peg at every `every`-th stamp of `first` to `last` of a probe: normalised.

    At each stamp the errors of force and torque are independent, each a mixture of an isotropic Gaussian and,
    with weight `outlier`, of one ten times as wide, for the moments at which the simulated peg comes into
    contact or slips a little earlier or later than the real one. The scale of the narrow one grows with the
    simulated force F and torque M, since errors of friction and stiffness are proportional to them:

        sqrt(force_scale^2 + (relative F)^2)   and   sqrt(torque_scale^2 + (relative M)^2).

    It is as sharp as the physics is trusted. On the simulated probe, with the world's friction and stiffness,
    the truth explains the wrench better than any pose around it; with a friction of 0.3 where the world has
    0.2, poses that are 1 mm and 2 degrees off explain it better by 30 nats (median of five seeds,
    `benchmarks/wrench.py`). Where friction and stiffness are unknown, make them latent, or omit the wrench.

    The density is with respect to Lebesgue measure on R^6 (N and N m) at each stamp that enters it.

    The event is (last - first, 6): force and torque of the environment on the peg, in the peg's frame about
    its origin, tared and free of the tool's weight, as the simulated one is, and not filtered: a filter would
    correlate the errors of neighbouring stamps. A row that is not finite is missing and does not count.

    Args:
        track, first, last: as for `TrackDistribution`.
        force_scale: newtons, along each axis.
        torque_scale: newton metres, about each axis.
        relative: standard deviation of force and torque as a share of the simulated ones.
        outlier: weight of the wide component.
        every: as for `TrackDistribution`.
        bias: (N, 6) the sensor's reading without contact; None for zero. It may be latent, and differ from
            window to window where the sensor drifts.
    """

    broadcasts = True
    entries = 6

    force_scale: float = field(metadata=POSITIVE)
    torque_scale: float = field(metadata=POSITIVE)
    relative: float = field(default=0.15, metadata=NONNEGATIVE)
    outlier: float = field(default=0.1, metadata=PROBABILITY)
    every: int = field(default=10, metadata=COUNT)
    bias: Tensor | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_shape("Wrench", "a bias", self.bias, (len(self.track), 6))

    @property
    def log_prob_bound(self) -> float:
        """Its value at a simulated and measured wrench of zero, where the scales are smallest."""
        stamps = len(range(self.first, self.last)[self.thinned])
        none, force, torque = torch.zeros(3, dtype=torch.float64), self.force_scale, self.torque_scale
        most = float(self._log_density(none, none.new_tensor(force)))
        most += float(self._log_density(none, none.new_tensor(torque)))
        # A row that is missing counts 0, which is more where the density's peak is below 1.
        return stamps * max(most, 0.0)

    def _simulated(self) -> tuple[Tensor, Tensor, Tensor]:
        """The expected reading (N, T, 6), and the narrow scales (N, T) of force and torque."""
        wrench = self.track.wrench(self.first, self.last).to(torch.float64)
        wrench = torch.where(self.track.diverged[:, None, None], 0.0, wrench)
        force = torch.hypot(self.relative * wrench[..., :3].norm(dim=-1), wrench.new_tensor(self.force_scale))
        torque = torch.hypot(
            self.relative * wrench[..., 3:].norm(dim=-1), wrench.new_tensor(self.torque_scale)
        )
        return wrench if self.bias is None else wrench + self.bias[:, None], force, torque

    def _log_density(self, error: Tensor, scale: Tensor) -> Tensor:
        """Log-density (...,) of errors (..., 3), at narrow scales (...)."""

        def gaussian(width: Tensor) -> Tensor:
            squared = (error / width[..., None]).square().sum(dim=-1)
            return -0.5 * squared - 3.0 * width.log() - 1.5 * math.log(2.0 * math.pi)

        return contaminated(gaussian, scale, self.outlier)

    def _log_prob(self, value: Tensor) -> Tensor:
        expected, force, torque = (each[:, self.thinned] for each in self._simulated())
        measured = torch.isfinite(value).all(dim=-1)
        error = torch.where(measured[..., None], value, 0.0) - expected
        terms = self._log_density(error[..., :3], force) + self._log_density(error[..., 3:], torque)
        return torch.where(measured, terms, 0.0).sum(dim=-1)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Wrenches (N, T, 6), NaN where the physics diverged; the errors of all stamps are independent."""
        expected, *scales = self._simulated()
        errors = []
        for scale in scales:
            wide = torch.rand(scale.shape, dtype=torch.float64) < self.outlier
            width = torch.where(wide, WIDER * scale, scale)
            errors.append(width[..., None] * torch.randn(*scale.shape, 3, dtype=torch.float64))
        drawn = expected + torch.cat(errors, dim=-1)
        return torch.where(self.track.diverged[:, None, None], torch.nan, drawn)

"""Distributions over values of any shape, one for each particle."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution


class NormalStep(LazyDistribution):
    """Normal about a value: its covariance has one shape for all particles, and a size for each.

    The density is that of a `MultivariateNormal` with `size * factor`, which solves a linear system for every
    particle where this one solves one.

    Args:
        at: (N, ...) the value from which each particle steps.
        factor: (d, d) lower Cholesky factor of the covariance of a step over the d entries of the value.
        size: (N,) positive factor of each particle's step.
    """

    def __init__(self, at: Tensor, factor: Tensor, size: Tensor) -> None:
        self.at, self.factor, self.size = at, factor, size
        super().__init__(len(at), tuple(at.shape[1:]))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) w.r.t. Lebesgue on the value's entries."""
        off = (value - self.at).reshape(len(self.at), -1)
        white = torch.linalg.solve_triangular(self.factor, off.mT, upper=False)
        entries = len(self.factor)
        volume = self.factor.diagonal().log().sum() + 0.5 * entries * math.log(2.0 * math.pi)
        return -0.5 * white.square().sum(0) / self.size.square() - entries * self.size.log() - volume

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One value for each particle, of the shape of `at`."""
        noise = torch.randn(len(self.at), len(self.factor), dtype=self.at.dtype, device=self.at.device)
        return self.at + (self.size[:, None] * (noise @ self.factor.mT)).reshape(self.at.shape)

"""Distributions over values of any shape, one for each particle."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.shortcuts import centred_normals


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
        noise = centred_normals((len(self.at), len(self.factor)))
        return self.at + (self.size[:, None] * (noise @ self.factor.mT)).reshape(self.at.shape)


class NormalMixture(LazyDistribution):
    """A mixture of normals for each of N particles; components share their covariances among particles.

    The density is that of a `MixtureSameFamily` of `MultivariateNormal`, which expands every factor to all
    particles and draws from all components to keep one.

    Args:
        particles: how many.
        log_weights: (K,) or (N, K) log weights, of any sum.
        centers: (K, d) or (N, K, d).
        factors: (d, d), or (K, d, d) for each component, lower Cholesky factors of the covariances.
    """

    def __init__(self, particles: int, log_weights: Tensor, centers: Tensor, factors: Tensor) -> None:
        self.log_weights, self.centers, self.factors = log_weights.log_softmax(-1), centers, factors
        super().__init__(particles, (centers.shape[-1],))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) w.r.t. Lebesgue of the values (N, d)."""
        off = (value[:, None] - self.centers).permute(1, 2, 0)
        white = torch.linalg.solve_triangular(self.factors, off, upper=False)
        entries = self.factors.shape[-1]
        volume = self.factors.diagonal(dim1=-2, dim2=-1).log().sum(-1) + 0.5 * entries * math.log(2 * math.pi)
        return (self.log_weights - 0.5 * white.square().sum(1).mT - volume).logsumexp(-1)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One value (N, d) for each particle."""
        chances = self.log_weights.exp().expand(*self.batch_shape, -1)
        which = torch.searchsorted(chances.cumsum(-1), torch.rand_like(chances[:, :1])).squeeze(-1)
        which = which.clamp_(max=chances.shape[-1] - 1)
        centers = self.centers.expand(*chances.shape, -1)[torch.arange(len(which)), which]
        noise = centred_normals(centers.shape)
        if self.factors.ndim == 2:
            return centers + noise @ self.factors.mT
        for component in which.unique().tolist():
            drawn = which == component
            noise[drawn] = noise[drawn] @ self.factors[component].mT
        return centers + noise

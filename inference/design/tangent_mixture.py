"""A belief over a pose as a mixture of Gaussians, one in the tangent space at each of its modes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief, effective_sample_size
from bcppl.inference.design.distinct import DistinctParticles, separate_modes
from bcppl.inference.design.weighted_mixtures import cholesky_factor
from bcppl.inference.population import Population
from bcppl.inference.summaries import weighted_covariance
from bcppl.poses import Freedom


@dataclass(frozen=True, eq=False)
class TangentMixture:
    """A Gaussian for each of K modes."""

    freedom: Freedom  # the d free axes
    label: Tensor  # (N,) the mode of each particle; -1 without weight
    mean: Tensor  # (K, 7) world_from_part
    mass: Tensor  # (K,) probabilities of the modes
    factor: Tensor  # (K, d, d) lower Cholesky factors of the covariances
    log_base: Tensor  # (K,) the mean log-density of the base measure

    def __len__(self) -> int:
        return len(self.mean)

    @classmethod
    def fit(
        cls, population: Population, address: str, translation: float = 0.01, rotation: float = 0.2
    ) -> TangentMixture:
        """The Gaussians of `mixture_entropy`: copies are merged, each mode has its particles' covariance."""
        freedom = population.belief(address).freedom
        particles = DistinctParticles.of(population, address)
        distinct, share = particles.values, particles.weights
        own, _ = separate_modes(distinct, translation, rotation)
        label = torch.full((len(population),), -1)
        label[particles.particles] = own[particles.index]
        means, covariances, masses, bases, sizes = [], [], [], [], []
        for mode in range(int(own.max()) + 1):
            inside = own == mode
            mass = share[inside].sum()
            weights = share[inside] / mass
            mean = Belief(distinct[inside], weights.log()).mean
            tangent = poses.local(mean, distinct[inside])
            means.append(mean)
            masses.append(mass)
            covariances.append(weighted_covariance(freedom.coordinates(tangent), weights))
            bases.append(weights @ freedom.log_base_density(tangent[:, 3:].norm(dim=-1)))
            sizes.append(1.0 / weights.square().sum())
        mass, covariance = torch.stack(masses), torch.stack(covariances)
        within = (mass[:, None, None] * covariance).sum(dim=0)
        cholesky_factor(address, within)
        floor = within * effective_sample_size(share.log()) ** (-2.0 / freedom.dimension)
        factor = [cholesky_factor(address, c + floor / n) for c, n in zip(covariance, sizes, strict=True)]
        return cls(freedom, label, torch.stack(means), mass, torch.stack(factor), torch.stack(bases))

    def tangent_of(self, world_from_part: Tensor, mode: Tensor) -> Tensor:
        """Derivatives (S, 6, d) in the tangent space at poses (S, 7), by free coordinates at modes' means."""
        turn = poses.local(self.mean[mode], world_from_part)[:, 3:]
        jacobian = torch.eye(6, dtype=torch.float64).repeat(len(turn), 1, 1)
        jacobian[:, 3:, 3:] = poses.right_jacobian(turn)
        return jacobian[:, :, list(self.freedom.axes)]

    def white_coordinates(self, world_from_part: Tensor, mode: Tensor) -> Tensor:
        """The whitened tangent coordinates (S, d) of poses (S, 7) at the means of modes (S,)."""
        away = self.freedom.coordinates(poses.local(self.mean[mode], world_from_part))
        return torch.linalg.solve_triangular(self.factor[mode], away[..., None], upper=False)[..., 0]

"""A belief over a pose as a mixture of Gaussians, one in the tangent space at each of its modes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief, effective_sample_size
from bcppl.beliefs.merged import distinct_poses
from bcppl.errors import InputError
from bcppl.inference.design.entropies import parted, refuse_collapsed
from bcppl.inference.design.mixtures import spanning_factor
from bcppl.inference.population import Population
from bcppl.inference.summaries import is_pose
from bcppl.poses import Freedom


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Modes of a belief.

    Attributes:
        freedom: the d axes that are free.
        label: (N,) the mode that each particle is in; -1 where it has no weight.
        center: (K, 7) world_from_part.
        mass: (K,).
        factor: (K, d, d) the lower Cholesky factor of each one's covariance.
        log_base: (K,) the mean log-density of the base measure.
    """

    freedom: Freedom
    label: Tensor
    center: Tensor
    mass: Tensor
    factor: Tensor
    log_base: Tensor

    def __len__(self) -> int:
        return len(self.center)

    @classmethod
    def fitted(
        cls, population: Population, address: str, translation: float = 0.01, rotation: float = 0.2
    ) -> Gaussians:
        """The Gaussians of `mode_entropy`: of copies merged, each with the covariance of its particles.

        Raises:
            InputError: the address is of no pose, all particles are the same, or they do not span its axes.
        """
        if not is_pose(population, address):
            raise InputError(
                f"{address!r} holds no poses, in whose tangent space information would be added up; "
                "use expected_information_gain."
            )
        whole = torch.softmax(population.log_weights, 0)
        carrying = whole > 0
        freedom = population.belief(address).freedom
        distinct, which = distinct_poses(population[address][carrying])
        refuse_collapsed(address, len(distinct))
        share = torch.zeros(len(distinct), dtype=torch.float64).index_add_(0, which, whole[carrying])
        own, _ = parted(distinct, translation, rotation)
        label = torch.full((len(whole),), -1)
        label[carrying] = own[which]
        centers, spreads, masses, bases, left = [], [], [], [], []
        for mode in range(int(own.max()) + 1):
            inside = own == mode
            mass = share[inside].sum()
            weights = share[inside] / mass
            center = Belief(distinct[inside], weights.log()).mean
            tangent = poses.local(center, distinct[inside])
            coordinates = freedom.coordinates(tangent)
            off = coordinates - weights @ coordinates
            centers.append(center)
            masses.append(mass)
            spreads.append((weights[:, None] * off).T @ off)
            bases.append(weights @ freedom.log_base_density(tangent[:, 3:].norm(dim=-1)))
            left.append(1.0 / weights.square().sum())
        mass, spread = torch.stack(masses), torch.stack(spreads)
        within = (mass[:, None, None] * spread).sum(dim=0)
        spanning_factor(address, within)
        floor = within * effective_sample_size(share.log()) ** (-2.0 / freedom.dimension)
        factor = [spanning_factor(address, s + floor / n) for s, n in zip(spread, left, strict=True)]
        return cls(freedom, label, torch.stack(centers), mass, torch.stack(factor), torch.stack(bases))

    @property
    def entropies(self) -> Tensor:
        """(K,) nats of each mode against the base measure."""
        sizes = self.factor.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
        return 0.5 * self.freedom.dimension * math.log(2.0 * math.pi * math.e) + sizes + self.log_base

    @property
    def entropy(self) -> float:
        """Of the mixture, nats: exact where modes do not overlap."""
        return float(torch.special.entr(self.mass).sum() + self.mass @ self.entropies)

    def carried(self, information: Tensor, world_from_part: Tensor, mode: Tensor) -> Tensor:
        """Informations (H, d, d) in the white coordinates of modes (H,), of (H, 6, 6) at poses (H, 7)."""
        turn = poses.local(self.center[mode], world_from_part)[:, 3:]
        jacobian = torch.eye(6, dtype=torch.float64).repeat(len(turn), 1, 1)
        jacobian[:, 3:, 3:] = right_jacobian(turn)
        white = jacobian[:, :, list(self.freedom.axes)] @ self.factor[mode]
        return white.transpose(-1, -2) @ information @ white


def nats(white: Tensor) -> Tensor:
    """By how much (...) an information (..., d, d) in white coordinates lets a Gaussian's entropy fall."""
    eye = torch.eye(white.shape[-1], dtype=torch.float64)
    lost = ~torch.isfinite(white).all(dim=-1).all(dim=-1)
    sound = torch.where(lost[..., None, None], 0.0, white)
    return torch.where(lost, torch.nan, 0.5 * torch.linalg.slogdet(eye + sound).logabsdet)


def right_jacobian(turn: Tensor) -> Tensor:
    """The right Jacobian (..., 3, 3) of SO(3) at rotation vectors (..., 3): Exp(w + d) = Exp(w) Exp(J d).

    Chirikjian, Stochastic Models, Information Theory, and Lie Groups, vol. 2, 10.86.
    """
    angle = turn.norm(dim=-1)[..., None, None].clamp(min=1e-6)
    x, y, z = turn.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*turn.shape, 3)
    first, second = (1.0 - angle.cos()) / angle**2, (angle - angle.sin()) / angle**3
    return torch.eye(3, dtype=torch.float64) - first * cross + second * (cross @ cross)

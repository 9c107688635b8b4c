"""A belief over a pose as seen from a held peg: Gaussians over the pose and the errors that touches share.

An insertion needs the part's pose relative to the peg. What all touches share (the grasp, the arm) moves both
along, so that touches hardly inform the pose in the world any more where they still inform the relative one.
Each mode is Gaussian over both, in the tangent space: the errors given each particle's pose are, and their
means are linear in the pose, by regression over the mode's particles.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.episodes.linear_errors import LinearErrors
from bcppl.distributions.episodes.rows import COLUMNS
from bcppl.inference.design.tangent_mixture import TangentMixture
from bcppl.inference.population import Population
from bcppl.inference.summaries import weighted_covariance


class HeldPeg(NamedTuple):
    """A peg from which a part's pose is seen.

    Attributes:
        errors: that all its touches share.
        inserted: its measured pose (7,), without a force, where it is to hold a part that is at a pose (7,);
            None for the part's pose in the world.
        prior: mean (M,) and covariance (M, M) of the errors before any touch, where these are not `errors`'
            own (hypotheses may widen them).
    """

    errors: LinearErrors
    inserted: Callable[[Tensor], Tensor] | None = None
    prior: tuple[Tensor, Tensor] | None = None


@dataclass(frozen=True, eq=False)
class RelativeMixture:
    """A Gaussian for each of K modes over the pose relative to a held peg, and the errors that it shares.

    Of a pose in the world, where touches share no errors, M is 0.
    """

    pose: TangentMixture
    factor: Tensor  # (K, d + M, d + M) L of the covariance L L' of pose and shared errors
    errors: Tensor  # (K, M) means of the shared errors
    standard: Tensor  # (K, d, d + M) the relative pose in its own standard axes, by those of the factor
    log_volume: Tensor  # (K,) log of the product of its standard deviations

    @classmethod
    def alone(cls, pose: TangentMixture) -> RelativeMixture:
        """That of the pose in the world, without errors."""
        modes, d = pose.factor.shape[:2]
        standard = torch.eye(d, dtype=torch.float64).expand(modes, d, d)
        log_volume = pose.factor.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)
        return cls(pose, pose.factor, pose.factor.new_zeros(modes, 0), standard, log_volume)

    @classmethod
    def fit(cls, population: Population, address: str, pose: TangentMixture, peg: HeldPeg) -> RelativeMixture:
        """That of a population's modes, given the Gaussians of their poses."""
        given = population.shared_errors(address)
        if given is None:  # nothing was touched: as a priori, whatever the pose
            errors, count = peg.errors, len(population)
            own_mean, own_covariance = peg.prior or (errors.means, torch.diag(errors.variances))
            given = own_mean.expand(count, -1), own_covariance.expand(count, -1, -1)
        mean, covariance = given
        weights, values = torch.softmax(population.log_weights, 0), population.trace[address]
        factors, means, standards, volumes = [], [], [], []
        for mode in range(len(pose)):
            inside = pose.label == mode
            share = weights[inside] / weights[inside].sum()
            own = pose.freedom.coordinates(poses.local(pose.mean[mode], values[inside]))
            means.append(share @ mean[inside])
            own, errors_of = own - share @ own, mean[inside] - means[-1]
            spread = pose.factor[mode]
            slope = torch.cholesky_solve((own * share[:, None]).T @ errors_of, spread).T  # (M, d)
            left = weighted_covariance(errors_of - own @ slope.T, share)
            left = left + (share[:, None, None] * covariance[inside]).sum(dim=0)
            variances, axes = torch.linalg.eigh(left)
            root = axes * variances.clamp(min=0.0).sqrt()
            upper = torch.cat([spread, spread.new_zeros(len(spread), len(root))], dim=1)
            factor = torch.cat([upper, torch.cat([slope @ spread, root], dim=1)])
            seen = factor[: len(spread)] + _motion(pose, mode, peg) @ factor[len(spread) :]
            relative = torch.linalg.cholesky(seen @ seen.T)
            factors.append(factor)
            standards.append(torch.linalg.solve_triangular(relative, seen, upper=False))
            volumes.append(relative.diagonal().log().sum())
        each = (torch.stack(parts) for parts in (factors, means, standards, volumes))
        return cls(pose, *each)

    @property
    def shared(self) -> int:
        """M."""
        return self.factor.shape[-1] - self.pose.freedom.dimension

    @property
    def entropies(self) -> Tensor:
        """(K,) nats of each Gaussian with respect to the base measure."""
        normal = 0.5 * self.pose.freedom.dimension * math.log(2.0 * math.pi * math.e)
        return normal + self.log_volume + self.pose.log_base

    @property
    def entropy(self) -> float:
        """Nats of the mixture: exact where modes do not overlap."""
        return float(torch.special.entr(self.pose.mass).sum() + self.pose.mass @ self.entropies)

    def whiten(self, information: Tensor, world_from_part: Tensor, mode: Tensor) -> Tensor:
        """Information matrices (S, 6 + M, 6 + M) at poses (S, 7), as (S, d + M, d + M)."""
        own, count = self.pose.tangent_of(world_from_part, mode), self.shared
        d = own.shape[-1]
        jacobian = own.new_zeros(len(own), 6 + count, d + count)
        jacobian[:, :6, :d], jacobian[:, 6:, d:] = own, torch.eye(count, dtype=torch.float64)
        white = jacobian @ self.factor[mode]
        return white.transpose(-1, -2) @ information @ white

    def reduction(self, white: Tensor, mode: Tensor) -> Tensor:
        """Entropy reductions (S,) of the relative pose by whitened information, nats; NaN if not finite."""
        failed = ~torch.isfinite(white).all(dim=-1).all(dim=-1)
        known = torch.where(failed[:, None, None], 0.0, white)
        eye = torch.eye(white.shape[-1], dtype=torch.float64)
        standard = self.standard[mode]
        covariance = standard @ torch.linalg.solve(eye + known, standard.transpose(-1, -2))
        return torch.where(failed, torch.nan, -0.5 * torch.linalg.slogdet(covariance).logabsdet)


def entropy_reduction(information: Tensor) -> Tensor:
    """The entropy reduction (...) of a standard normal by information matrices (..., d, d), nats.

    NaN where the information is not finite.
    """
    eye = torch.eye(information.shape[-1], dtype=torch.float64)
    failed = ~torch.isfinite(information).all(dim=-1).all(dim=-1)
    valid = torch.where(failed[..., None, None], 0.0, information)
    return torch.where(failed, torch.nan, 0.5 * torch.linalg.slogdet(eye + valid).logabsdet)


def _motion(pose: TangentMixture, mode: int, peg: HeldPeg) -> Tensor:
    """Derivatives (d, M) of the relative pose's free coordinates by the shared errors, at a mode's mean."""
    part = pose.mean[mode]
    if peg.inserted is None:
        return part.new_zeros(pose.freedom.dimension, len(peg.errors.means))
    measured = peg.inserted(part)
    row = part.new_zeros(1, COLUMNS)
    row[0, :7] = measured
    turn = poses.rotation_matrix(measured)
    moved, turned = (turn @ each for each in peg.errors.effect(row).twist[0].split(3))
    away = (part[:3] - measured[:3])[:, None].expand_as(turned)
    # A peg that is ahead of where it is measured sees the part behind.
    seen = torch.cat(
        [-moved - torch.linalg.cross(turned, away, dim=0), -poses.rotation_matrix(part).T @ turned]
    )
    return seen[list(pose.freedom.axes)]

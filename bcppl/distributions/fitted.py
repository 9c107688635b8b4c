"""Normals, and mixtures of them, that resemble a density which can only be evaluated."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

_WIDTHS = (1.2, 3.0)  # of the normals that are drawn from, in deviations of the draws before
_SHARES = (0.85, 0.15)
_LEAST = 0.15  # of the draws: their effective number, which bounds how sharp the density may become
_ROUNDS = 80  # at most: of two modes that look alike it may take forty until one is left
_FASTER = 1.1  # by how much sharper it becomes at least
_ENOUGH = 0.3  # of the draws: so many effective, and the fit is good
# Of the images of a fit under near symmetries: nats within which one is followed further, and nats within
# which the weight of a mode is kept; squared standard deviations within which two modes are one.
_NEAR, _FAINT, _SAME = 30.0, 10.0, 12.0
_LOCAL = 0.5  # exponent from which an image is followed: with smaller ones its fit would leave the mode


class FittedNormal(NamedTuple):
    """A normal in d dimensions: mean (d,) and covariance (d, d)."""

    mean: Tensor
    covariance: Tensor

    def sigma_points(self) -> Tensor:
        """The mean, then a deviation up and down each column of a root of the covariance: (1 + 2 d, d).

        Half the sum of the squares of the deviations is the covariance, and remains so where they are mapped
        by something linear.
        """
        columns = torch.linalg.cholesky(self.covariance).T
        return torch.cat([self.mean[None], self.mean + columns, self.mean - columns])


class FittedMixture(NamedTuple):
    """A mixture of M normals: means (M, d), covariances (M, d, d), log-weights (M,), the largest first."""

    means: Tensor
    covariances: Tensor
    log_weights: Tensor

    @classmethod
    def of(cls, normals: Sequence[FittedNormal], log_weights: Tensor) -> FittedMixture:
        """The mixture of normals with unnormalised log-weights (M,)."""
        order = log_weights.argsort(descending=True)
        return cls(
            torch.stack([normals[k].mean for k in order]),
            torch.stack([normals[k].covariance for k in order]),
            log_weights[order].log_softmax(dim=0),
        )

    @property
    def components(self) -> list[FittedNormal]:
        """The normals."""
        return [FittedNormal(*each) for each in zip(self.means, self.covariances, strict=True)]

    def chosen(self, index: Tensor) -> FittedMixture:
        """The components at an index (C,), with their weights as they are."""
        return FittedMixture(*(each[index] for each in self))


def fitted_mixture(
    log_density: Callable[[Tensor], Tensor],
    start: Tensor,
    least: Tensor,
    alike: Callable[[Tensor], Tensor],
) -> FittedMixture:
    """`fitted_normal`, and the other modes that are its images under near symmetries of the density.

    Each image is followed by a fit of its own where one of its sigma points is nearly as probable as here.
    Weights are estimates of each mode's mass by importance sampling.

    Args:
        log_density: as for `fitted_normal`, as are the next two.
        start: (d,).
        least: (d,).
        alike: of points (P, d), their images (K, P, d) under K transformations; K may be 0.
    """
    prior = _Prior(start)
    normal, mass = _population_monte_carlo(log_density, prior, prior.draws(400), least, 200)
    normals, masses = [normal], [mass]
    tried = normal.sigma_points()
    images = alike(tried)
    if len(images):
        here, best = log_density(tried).max(), torch.stack([log_density(image).max() for image in images])
        for k in best.argsort(descending=True).tolist():
            if not best[k] > here - _NEAR:
                break
            away = images[k][1:] - images[k][0]
            there = FittedNormal(images[k][0], 0.5 * away.T @ away)
            if _is_among(there, normals):
                continue
            other, mass = _population_monte_carlo(log_density, prior, _drawn(there, 200), least, 200, _LOCAL)
            if not _is_among(other, normals):
                normals.append(other)
                masses.append(mass)
    weights = torch.tensor(masses, dtype=torch.float64)
    kept = (weights > weights.max() - _FAINT).nonzero()[:, 0]
    return FittedMixture.of([normals[k] for k in kept], weights[kept])


def _is_among(normal: FittedNormal, others: Sequence[FittedNormal]) -> bool:
    away = [(normal.mean - other.mean, other.covariance) for other in others]
    return any(float(off @ torch.linalg.solve(covariance, off)) < _SAME for off, covariance in away)


def fitted_normal(
    log_density: Callable[[Tensor], Tensor],
    start: Tensor,
    least: Tensor,
    *,
    draws: int = 200,
    first: int = 400,
) -> FittedNormal:
    """The normal after a density times a normal about zero, near its highest mass.

    Population Monte Carlo (Cappe, Guillin, Marin and Robert, JCGS 13, 2004) with a tempered target: each
    round draws from a normal, a share of it three times as wide, fitted to the weighted draws before, and
    raises the density to the power at which 15 % of the draws stay effective. Of several modes one is left in
    the end. It draws from torch's generator.

    Args:
        log_density: of points (M, d), unnormalised: (M,).
        start: (d,) standard deviations of the normal about zero, of which the first draws are.
        least: (d,) standard deviations below which no fit goes.
        draws: points in each round.
        first: points in the first.
    """
    prior = _Prior(start)
    return _population_monte_carlo(log_density, prior, prior.draws(first), least, draws)[0]


class _Prior:
    """A normal about zero with standard deviations (d,)."""

    def __init__(self, start: Tensor) -> None:
        zero = torch.zeros_like(start)
        self.normal = MultivariateNormal(zero, torch.diag(start**2), validate_args=False)

    def draws(self, count: int) -> tuple[Tensor, Tensor]:
        """Points (count, d) and their log-density."""
        point = self.normal.sample((count,))
        return point, self.normal.log_prob(point)


def _population_monte_carlo(
    log_density: Callable[[Tensor], Tensor],
    prior: _Prior,
    first: tuple[Tensor, Tensor],
    least: Tensor,
    draws: int,
    exponent: float = 0.0,
) -> tuple[FittedNormal, float]:
    """The fit from the first draws and their log-density on, and the log of the mass that it covers."""
    point, log_proposal = first
    for _ in range(_ROUNDS):
        target, correction = log_density(point), prior.normal.log_prob(point) - log_proposal
        exponent = _exponent(target, correction, exponent)
        log_weights = exponent * target + correction
        fit = _moments(point, torch.softmax(log_weights, dim=0), least)
        if exponent == 1.0 and _effective(log_weights) >= _ENOUGH * len(point):
            break
        point, log_proposal = _drawn(fit, draws)
    return fit, float(torch.logsumexp(target + correction, dim=0)) - math.log(len(target))


def _drawn(fit: FittedNormal, draws: int) -> tuple[Tensor, Tensor]:
    """Points (M, d) of the fit, some of them wide, and the log-density of having drawn them."""
    shares = torch.tensor(_SHARES, dtype=torch.float64)
    normals = [MultivariateNormal(fit.mean, w**2 * fit.covariance, validate_args=False) for w in _WIDTHS]
    which = torch.multinomial(shares, draws, replacement=True)
    point = torch.stack([normal.sample((draws,)) for normal in normals])[which, torch.arange(draws)]
    each = torch.stack([normal.log_prob(point) for normal in normals])
    return point, torch.logsumexp(each + shares.log()[:, None], dim=0)


def _effective(log_weights: Tensor) -> float:
    weights = torch.softmax(log_weights, dim=0)
    return float(1.0 / (weights**2).sum())


def _exponent(log_density: Tensor, correction: Tensor, reached: float) -> float:
    """The largest exponent up to 1 that leaves enough draws effective, no smaller than what is reached."""
    goal = _LEAST * len(log_density)
    if _effective(log_density + correction) >= goal:
        return 1.0
    low, high = reached, 1.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _effective(middle * log_density + correction) >= goal else (low, middle)
    # Draws of a normal about two modes would never become effective: sooner or later one is left.
    return min(1.0, max(low, _FASTER * reached, 1e-9))


def _moments(point: Tensor, weights: Tensor, least: Tensor) -> FittedNormal:
    mean = weights @ point
    away = point - mean
    return FittedNormal(mean, away.T @ (weights[:, None] * away) + torch.diag(least**2))

"""A normal that resembles a density which can only be evaluated."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

_WIDTHS = (1.2, 3.0)  # of the normals that are drawn from, in deviations of the draws before
_SHARES = (0.85, 0.15)
_LEAST = 0.15  # of the draws: their effective number, which bounds how sharp the density may become
_ROUNDS = 30  # at most
_FASTER = 1.1  # by how much sharper it becomes at least
_ENOUGH = 0.3  # of the draws: so many effective, and the fit is good


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
    prior = MultivariateNormal(torch.zeros_like(start), torch.diag(start**2), validate_args=False)
    fit = FittedNormal(torch.zeros_like(start), torch.diag(start**2))
    point = prior.sample((first,))
    log_proposal = prior.log_prob(point)
    exponent = 0.0
    for _ in range(_ROUNDS):
        target, correction = log_density(point), prior.log_prob(point) - log_proposal
        exponent = _exponent(target, correction, exponent)
        log_weights = exponent * target + correction
        fit = _moments(point, torch.softmax(log_weights, dim=0), least)
        if exponent == 1.0 and _effective(log_weights) >= _ENOUGH * len(point):
            break
        point, log_proposal = _drawn(fit, draws)
    return fit


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

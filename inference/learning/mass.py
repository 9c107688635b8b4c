"""Inverse mass matrices from particles and the gradients of their log-density."""

from __future__ import annotations

import torch
from torch import Tensor

from bcppl.distributions.pose_normals import symmetric_root
from bcppl.inference.summaries import weighted_covariance

# The least product of the variances of an axis's particles and of its scores, which is 1 for a normal: of a
# density without slope the scores bound nothing.
FLATTEST = 1e-6


def fisher_covariance(
    position: Tensor, score: Tensor, weights: Tensor, unlearned: Tensor | None = None
) -> Tensor:
    """The inverse mass matrix (D, D) in which particles and scores have the same covariance.

    With S the covariance of the particles and G that of their scores, the gradients of their log-density, it
    is the geometric mean of S and the inverse of G, the solution of M G M = S: it minimises the Fisher
    divergence between the target and a normal of that covariance (Seyboldt, Carlson and Carpenter,
    Preconditioning Hamiltonian Monte Carlo by minimizing Fisher divergence, 2026). For a normal target it is
    the target's covariance, whichever more than D particles it is computed from, but for the regularisation;
    the covariance of N particles alone is off by a factor of about (1 + sqrt(D / N))^2 along some axes. Both
    covariances are regularised by their diagonals, so that fewer particles than D serve too.

    Args:
        position: (N, D).
        score: (N, D) gradients of the log-density at the positions; rows that are not finite are left out.
        weights: (N,) normalised.
        unlearned: (D,) variances of the prior on axes on which no two particles differ, 0 on the others.
    """
    finite = (torch.isfinite(position) & torch.isfinite(score)).all(dim=1)
    weights = torch.where(finite, weights, 0.0)
    total = weights.sum()
    if not bool(total > 0.0):
        return torch.eye(position.shape[1], dtype=torch.float64)
    weights = weights / total
    size = float(1.0 / weights.square().sum())
    spread, bend = (
        weighted_covariance(torch.nan_to_num(each, 0.0, 0.0, 0.0), weights) for each in (position, score)
    )
    if unlearned is not None and bool((unlearned > 0.0).any()):
        # The scores there, of one point, are at least those of the prior.
        spread = spread + torch.diag(unlearned)
        least = torch.where(unlearned > 0.0, 1.0 / unlearned, 0.0)
        bend = bend + torch.diag((least - bend.diagonal()).clamp_min(0.0))
    of_particles, of_scores = spread.diagonal().clone(), bend.diagonal().clone()
    of_particles[of_particles == 0.0] = 1.0  # no two particles differ, nor do draws of the prior
    of_scores = torch.maximum(of_scores, FLATTEST / of_particles)
    # In units in which each axis's particles and scores have the same standard deviation.
    unit = (of_particles / of_scores) ** 0.25
    # Both covariances are regularised as by so many particles of their diagonals, few where N is large.
    prior = min(1.0, (len(unit) / size) ** 2)
    spread = (size * spread + prior * torch.diag(of_particles)) / (size + prior) / unit[:, None] / unit
    bend = (size * bend + prior * torch.diag(of_scores)) / (size + prior) * unit[:, None] * unit
    factor = torch.linalg.cholesky(bend)
    # M = F^-T (F^T S F)^(1/2) F^-1 with G = F F^T.
    inner = symmetric_root(factor.T @ spread @ factor)
    half = torch.linalg.solve_triangular(factor.T, inner, upper=True)
    mean = torch.linalg.solve_triangular(factor.T, half.T, upper=True)
    return 0.5 * (mean + mean.T) * unit[:, None] * unit

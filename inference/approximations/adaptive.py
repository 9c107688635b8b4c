"""Gaussian components that are adapted to a posterior by importance sampling.

The curvature at a mode says how far a pose may move only where the likelihood is smooth there. Contacts have
edges: which corner touches changes along the way, and what a wedged peg leaves is a bent ridge several times
as long as its curvature has it. So draws are weighted by the posterior itself, and the components take the
moments of the weighted draws: population Monte Carlo for mixtures (Cappe, Douc, Guillin, Marin and Robert,
Adaptive importance sampling in general mixture classes, Statistics and Computing 18, 2008, section 3), all
rounds weighted together (Cornuet, Marin, Mira and Robert, Adaptive multiple importance sampling, Scandinavian
Journal of Statistics 39, 2012). Draws have random numbers of their own, the same in every run.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bcppl import poses
from bcppl.devices import same_random_state, seed_here
from bcppl.distributions.pose_normals import GaussianMixture, widened_mixture
from bcppl.distributions.poses import MixturePose, NormalTwist
from bcppl.inference.approximations.laplace import Normal, QuadraticApproximation, Sites

FIRST, MORE, ROUNDS = 64, 256, 6  # draws of the first round and of each further one; rounds at most
# The curvature is good enough if this share of the first round's draws is effective, and these are no further
# from the modes than so many squared standard deviations on average (six for a Gaussian).
GOOD, FAR = 0.2, 9.0
ENOUGH = 100.0  # effective draws that moments of six axes are taken from
_OLD = 6.0  # draws that the covariance of the round before counts for
_MOST, _LEAST = 4, 0.01  # components that are kept: at most so many, of at least this share


def adapted(
    sites: Sites, prior: Normal, modes: QuadraticApproximation, before: GaussianMixture | None = None
) -> QuadraticApproximation:
    """The quadratic approximation whose posterior, under the prior, has the adapted moments.

    Components start at the modes, and where the posterior `before` the newest measurement had them: it was
    wider. It is around the components' means; the modes as they are where their curvature is good enough.
    """
    alone = NormalTwist(prior.center[0], torch.linalg.inv(prior.precision[0]))
    curved = GaussianMixture(*(values[0] for values in modes.posterior(*prior)))
    mixture = curved if before is None else _both(curved, before)
    drawn, target, proposals = list[Tensor](), list[Tensor](), list[MixturePose]()
    with same_random_state():
        seed_here(0)
        for number in range(ROUNDS):
            proposals.append(widened_mixture(mixture))
            drawn.append(proposals[-1].sample((MORE if number else FIRST,)))
            reached = alone.log_prob(drawn[-1])
            for site, value in sites(drawn[-1], 0.0):
                reached = reached + site.log_prob(value)
            target.append(reached)
            pose = torch.cat(drawn)
            shares = torch.tensor([len(each) / len(pose) for each in drawn], dtype=torch.float64).log()
            density = torch.stack([each.log_prob(pose) for each in proposals], dim=1)
            log_weights = torch.cat(target) - (density + shares).logsumexp(dim=1)
            weights = log_weights.softmax(dim=0)
            effective = float(1.0 / weights.square().sum())
            if not math.isfinite(effective):
                return modes  # no draw has any weight
            if number == 0 and effective > GOOD * FIRST:
                away = curved.squared_deviations(pose).amin(dim=1)
                if float(weights @ away) < FAR:
                    return modes
            log_evidence = float(log_weights.logsumexp(dim=0)) - math.log(len(pose))
            mixture = _moments(mixture, pose, weights, log_evidence)
            if effective > ENOUGH:
                break
    return _as_likelihood(mixture, prior)


def _moments(mixture: GaussianMixture, pose: Tensor, weights: Tensor, log_evidence: float) -> GaussianMixture:
    """The components with the moments of weighted draws (S,), each of those that are its own."""
    each = NormalTwist(mixture.centers, mixture.covariances).log_prob(pose[:, None])
    shares = weights[:, None] * (mixture.log_weights + each).softmax(dim=1)
    kept = shares.sum(dim=0).topk(min(_MOST, shares.shape[1])).indices
    kept = kept[shares[:, kept].sum(dim=0) > _LEAST]
    mixture, shares = GaussianMixture(*(values[kept] for values in mixture)), shares[:, kept]
    mass = shares.sum(dim=0)
    within = shares / mass
    effective = (1.0 / within.square().sum(dim=0))[:, None, None]
    away = poses.log(mixture.centers, pose[:, None])  # (S, M, 6)
    step = torch.einsum("sm,smi->mi", within, away)
    centers = poses.exp(mixture.centers, step)
    away = poses.log(centers, pose[:, None])
    spread = torch.einsum("sm,smi,smj->mij", within, away, away)
    covariances = (effective * spread + _OLD * mixture.covariances) / (effective + _OLD)
    return GaussianMixture(centers, covariances, mass.log() + log_evidence)


def _both(one: GaussianMixture, other: GaussianMixture) -> GaussianMixture:
    """Two mixtures of equal weight."""
    log_weights = [each.log_weights.log_softmax(dim=0) for each in (one, other)]
    return GaussianMixture(
        torch.cat([one.centers, other.centers]),
        torch.cat([one.covariances, other.covariances]),
        torch.cat(log_weights),
    )


def _as_likelihood(posterior: GaussianMixture, prior: Normal) -> QuadraticApproximation:
    """The quadratic approximation of a likelihood that leaves a posterior.

    Where a component is wider than the prior along an axis, by the few draws, nothing is measured there.
    """
    center, precision = prior
    root = torch.linalg.cholesky(precision[0])
    inverse = torch.linalg.inv(root)
    values, axes = torch.linalg.eigh(inverse @ torch.linalg.inv(posterior.covariances) @ inverse.T)
    learned = (values - 1.0).clamp_min(0.0)
    information = root @ (axes * learned[:, None, :]) @ axes.mT @ root.T
    away = poses.log(posterior.centers, center)
    pull = (precision @ away[..., None])[..., 0]
    sizes = torch.linalg.slogdet(precision)[1] - torch.linalg.slogdet(precision + information)[1]
    log_likelihood = posterior.log_weights + 0.5 * ((away * pull).sum(dim=-1) - sizes)
    return QuadraticApproximation(posterior.centers, pull, information, log_likelihood)

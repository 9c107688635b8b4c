"""Gaussians over poses as proposals need them: mixtures, products, truncation, optimal transport.

A `GaussianMixture` is of normals over twists (`NormalTwist`): contacts leave posteriors that turn about a
place afar. Of factors of images, and of priors with limits along axes, the product is in `NormalPose`'s
coordinates; the two are the same to first order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.devices import is_on_host
from bcppl.distributions.poses import BoxedNormal, MixturePose, NormalPose, NormalTwist
from bcppl.distributions.poses.boxed import log_mass

# Proposals are mixtures of a Gaussian's copies: one as it is but for a little, one that is wider in all
# directions, and one for each principal axis that is wider along it. Where a posterior is a bent ridge its
# curvature at one place says too little of how long it is, and all wide at once hardly ever hits it.
WIDTHS = (1.1, 3.0, 3.0)  # standard deviations
SHARES = (0.6, 0.1, 0.3)  # probabilities, the last of all six axes together
COPIES = 8
_TOGETHER = 4096  # eigenvalue problems that a GPU is given at a time
_LEVER = 0.02  # m: a rotation is as long as the displacement that it gives there

_SWEEPS = 3  # of expectation propagation over the axes
_NARROWEST = 1e-3  # share of a variance that a truncation leaves, at least: beyond, rounding dominates


class GaussianMixture(NamedTuple):
    """A mixture of M Gaussians: centres (..., M, 7), covariances (..., M, 6, 6), log-weights (..., M)."""

    centers: Tensor
    covariances: Tensor
    log_weights: Tensor

    def component(self, pose: Tensor) -> Tensor:
        """The most probable component of each of the poses (N, 7), (N,) int64."""
        if self.log_weights.shape[-1] == 1:
            return torch.zeros(len(pose), dtype=torch.int64, device=pose.device)
        log_prob = NormalTwist(self.centers, self.covariances).log_prob(pose[:, None])
        return (self.log_weights + log_prob).argmax(dim=1)

    def squared_deviations(self, pose: Tensor) -> Tensor:
        """The squared standard deviations (N, M) of poses (N, 7) from each of the components."""
        away = poses.log(self.centers, pose[:, None])
        return torch.einsum("nmi,mij,nmj->nm", away, torch.linalg.inv(self.covariances), away)

    def times(self, factor: NormalPose) -> GaussianMixture:
        """The mixture that approximates its product with a Gaussian (...,)."""
        center, second = factor.center[..., None, :], factor.covariance[..., None, :, :]
        own, other = torch.linalg.inv(self.covariances), torch.linalg.inv(second)
        covariance = torch.linalg.inv(own + other)
        away = poses.log(self.centers, center)[..., None]
        both = self.covariances + second
        squared = (away[..., 0] * torch.linalg.solve(both, away)[..., 0]).sum(dim=-1)
        overlap = -0.5 * (squared + torch.linalg.slogdet(both)[1])
        return GaussianMixture(
            poses.exp(self.centers, (covariance @ other @ away)[..., 0]),
            0.5 * (covariance + covariance.transpose(-1, -2)),
            self.log_weights + overlap,
        )


class PoseFactor(NamedTuple):
    """A Gaussian factor over a part's pose."""

    pose: Tensor  # (N, 7) its mean
    covariance: Callable[[Tensor], Tensor]  # (N, 6, 6) in the tangent space at a centre (N, 7)
    log_weight: Tensor | float = 0.0  # (N,)


def product_of_factors(prior: Any, factors: Sequence[PoseFactor]) -> NormalPose:
    """The Gaussian that approximates a product of factors, on the axes that a prior leaves free.

    Each factor is taken as normal in the tangent space about the product's mean.
    """
    free = prior.freedom
    axes = list(free.axes)
    start = free.coordinates(poses.local(prior.center, factors[0].pose))
    center = poses.retract(prior.center, free.embed(start))
    for _ in range(2):  # the first centre is a few millimetres off, which changes the covariances by 1 %
        precision: Any = 0.0
        pull: Any = 0.0
        for pose, covariance_at, _ in factors:
            own = torch.linalg.inv(covariance_at(center))[..., axes, :]
            precision = precision + own[..., axes]
            pull = pull + own @ poses.local(center, pose)[..., None]
        covariance = torch.linalg.inv(precision)
        center = poses.retract(center, free.embed((covariance @ pull)[..., 0]))
    return NormalPose(center, 0.5 * (covariance + covariance.transpose(-1, -2)), free)


def log_overlap(product: NormalPose, factors: Sequence[PoseFactor]) -> Tensor:
    """The log of the integral (N,) of factors' product, given the Gaussian that it is, but for a constant."""
    log_mass = 0.5 * torch.linalg.slogdet(product.covariance)[1]
    for pose, covariance_at, log_weight in factors:
        own = covariance_at(product.center)
        away = poses.local(product.center, pose)
        squared = (away * torch.linalg.solve(own, away[..., None])[..., 0]).sum(dim=-1)
        log_mass = log_mass + log_weight - 0.5 * (squared + torch.linalg.slogdet(own)[1])
    return log_mass


def mixture_of(mixture: GaussianMixture) -> NormalTwist | MixturePose:
    """A mixture of M Gaussians for each of N particles; the Gaussian where M is 1."""
    if mixture.log_weights.shape[-1] == 1:
        return NormalTwist(mixture.centers[..., 0, :], mixture.covariances[..., 0, :, :])
    return MixturePose(mixture.log_weights, mixture.centers, mixture.covariances, twists=True)


def widened(center: Tensor, covariance: Tensor) -> MixturePose:
    """A Gaussian with centres (N, 7) and covariances (N, 6, 6), mixed with wider ones (`WIDTHS`)."""
    alone = torch.zeros(1, dtype=torch.float64)
    return widened_mixture(GaussianMixture(center[..., None, :], covariance[..., None, :, :], alone))


def widened_mixture(mixture: GaussianMixture) -> MixturePose:
    """A mixture of M Gaussians for each of N particles, each mixed with wider ones (`WIDTHS`)."""
    centers, covariances = mixture.centers, mixture.covariances
    same, every, along = (width**2 for width in WIDTHS)
    units = covariances.new_tensor([1.0] * 3 + [1.0 / _LEVER] * 3)
    values, axes = _eigh(covariances / (units[:, None] * units))
    longest = units[:, None] * axes * values.clamp(min=0.0).sqrt()[..., None, :]  # (..., 6, 6), by column
    wider = (along - same) * longest.mT[..., :, None] * longest.mT[..., None, :]
    wide = torch.cat(
        [
            torch.stack([same * covariances, every * covariances], dim=-3),
            same * covariances[..., None, :, :] + wider,
        ],
        dim=-3,
    )
    shares = covariances.new_tensor([*SHARES[:2], *[SHARES[2] / 6.0] * 6])
    log_weights = mixture.log_weights.log_softmax(dim=-1)[..., None] + shares.log()
    return MixturePose(
        log_weights.flatten(-2),
        centers[..., None, :].expand(*centers.shape[:-1], COPIES, 7).flatten(-3, -2),
        wide.flatten(-4, -3),
        twists=True,
    )


def _eigh(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues and eigenvectors of symmetric matrices (..., d, d)."""
    flat = matrices.reshape(-1, *matrices.shape[-2:])
    if is_on_host(matrices) or len(flat) <= _TOGETHER:
        return torch.linalg.eigh(matrices)
    # CUDA's solver takes half a megabyte of memory for each, and fails with 100,000.
    each = [torch.linalg.eigh(some) for some in flat.split(_TOGETHER)]
    values, axes = (torch.cat(parts) for parts in zip(*each, strict=True))
    return values.reshape(matrices.shape[:-1]), axes.reshape(matrices.shape)


def matched(mixture: MixturePose) -> NormalTwist:
    """The Gaussian with the mean and covariance of a `widened_mixture`, its wider copies aside."""
    every = COPIES
    probabilities = mixture.log_weights[..., ::every].softmax(dim=-1)
    centers = mixture.components.center[..., ::every, :]
    covariances = mixture.components.covariance[..., ::every, :, :]
    away = poses.log(centers[..., :1, :], centers)
    mean = (probabilities[..., None] * away).sum(dim=-2)
    off = away - mean[..., None, :]
    covariance = covariances + off[..., :, None] * off[..., None, :]
    return NormalTwist(
        poses.exp(centers[..., 0, :], mean), (probabilities[..., None, None] * covariance).sum(dim=-3)
    )


def truncated(prior: Any, normal: NormalPose) -> NormalPose | BoxedNormal:
    """A Gaussian (N,) times a prior's density along each axis; near its border few draws would lie within."""
    if not bool((prior.widths > 0.0).all()):
        return normal
    limits, log_steps = prior.steps
    return BoxedNormal(normal.center, normal.covariance, prior.center[:3] + limits, log_steps)


def moments_within(prior: Any, normal: NormalPose) -> NormalPose:
    """The Gaussian with about the moments of a Gaussian (N,) times a prior's density along each axis.

    Expectation propagation with a factor for each axis (Cunningham, Hennig and Lacoste-Julien, Gaussian
    probabilities and expectation propagation, arXiv 1111.6832).
    """
    if not bool((prior.widths > 0.0).all()):
        return normal
    covariance, center = normal.covariance.clone(), normal.center
    off = center[..., :3] - prior.center[:3]
    mean = torch.zeros_like(covariance[..., 0])
    steps, log_steps = prior.steps
    precision, pull = torch.zeros_like(off), torch.zeros_like(off)
    for axis in list(range(3)) * _SWEEPS:
        column = covariance[..., axis].clone()
        own, here = column[..., axis].clone(), mean[..., axis]
        # The marginal without the factor's own share, truncated, gives the share.
        free = 1.0 / (1.0 / own - precision[..., axis])
        middle = free * (here / own - pull[..., axis])
        limits = steps[:, axis] - off[..., axis, None]
        inside, spread = _stepped_moments(middle, free, limits, log_steps)
        change = 1.0 / spread - 1.0 / free - precision[..., axis]
        pulled = inside / spread - middle / free - pull[..., axis]
        precision[..., axis] += change
        pull[..., axis] += pulled
        gain = column / (1.0 + change * own)[..., None]
        mean = mean + (pulled - change * here)[..., None] * gain
        covariance = covariance - change[..., None, None] * gain[..., :, None] * column[..., None, :]
    symmetric = 0.5 * (covariance + covariance.transpose(-1, -2))
    return NormalPose(poses.retract(center, mean), symmetric, normal.freedom)


def _stepped_moments(
    mean: Tensor, variance: Tensor, limits: Tensor, log_steps: Tensor
) -> tuple[Tensor, Tensor]:
    """Mean and variance (N,) of a normal times a density that is constant between limits (N, K + 1)."""
    deviation = variance.sqrt()
    ends = (limits - mean[..., None]) / deviation[..., None]
    first, last = ends[..., :-1], ends[..., 1:]
    flip = first + last > 0.0  # as in a right tail, where the distribution function would round to 1
    first, last = torch.where(flip, -last, first), torch.where(flip, -first, last)
    log_masses = log_mass(first, last)
    at_first, at_last = (
        torch.exp(-0.5 * x**2 - 0.5 * math.log(2.0 * math.pi) - log_masses) for x in (first, last)
    )
    away = at_first - at_last
    share = (1.0 + first * at_first - last * at_last - away**2).clamp(_NARROWEST, 1.0)
    away = torch.where(flip, -away, away)
    # An interval that is so far away that its mass is no number has none.
    weight = (log_masses + log_steps).nan_to_num(nan=-torch.inf, neginf=-torch.inf).softmax(dim=-1)
    away, share = (torch.where(weight > 0.0, each, 0.0) for each in (away, share))
    middle = (weight * away).sum(dim=-1)
    spread = (weight * (share + (away - middle[..., None]) ** 2)).sum(dim=-1)
    return mean + deviation * middle, variance * spread.clamp(_NARROWEST, 1.0)


def transport(first: Tensor, second: Tensor) -> Tensor:
    """The optimal transport map (d, d) between zero-mean Gaussians with two covariances.

    Deviations (..., d) from the mean are multiplied by it. Source: Olkin and Pukelsheim, The
    distance between two random vectors with given dispersion matrices, Linear Algebra and its Applications
    48, 1982.
    """
    root = symmetric_root(first)
    back = torch.linalg.inv(root)
    return back @ symmetric_root(root @ second @ root) @ back


def symmetric_root(matrix: Tensor) -> Tensor:
    """The symmetric root of a symmetric positive matrix."""
    values, vectors = torch.linalg.eigh(0.5 * (matrix + matrix.T))
    return vectors @ torch.diag(values.clamp(min=0.0).sqrt()) @ vectors.T


def normal_like(prior: Any) -> NormalPose:
    """A Gaussian with about the spread of a prior that is uniform within limits."""
    return NormalPose(prior.center, 0.6 * _limits(prior).clamp(min=1e-4))


def allowed(prior: Any, there: Tensor, margin: Tensor) -> Tensor:
    """Whether poses (M, 7) lie in a prior's support, its limits widened by `margin` (6,), m and radians."""
    limits = _limits(prior)
    inwards = limits / (limits + margin) * poses.local(prior.center, there)
    return prior.log_prob(poses.retract(prior.center, inwards)) > -torch.inf


def _limits(prior: Any) -> Tensor:
    """The largest deviations (6,) of a prior along and about its axes, metres and radians."""
    angle = getattr(prior, "angle", None)
    turns = [angle] * 3 if angle is not None else [prior.tilt, prior.tilt, prior.yaw]
    return torch.cat(
        [torch.as_tensor(prior.widths), torch.tensor(turns, dtype=torch.float64, device=prior.widths.device)]
    )

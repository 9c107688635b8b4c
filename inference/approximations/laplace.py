"""Quadratic approximations of a likelihood around its modes, located by Gauss-Newton from several starts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.checks import Checked
from bcppl.distributions.pose_normals import GaussianMixture
from bcppl.sensors.capabilities import InHole

# Standard deviations (m) that are added to the errors, one for each Gauss-Newton step: of starts about the
# prior mean, from outside the part, from many places, and from modes.
BLURS = (0.003, 0.002, 0.001, 0.0005, 0.0002, 0.0, 0.0, 0.0)
SHARP = (0.0005, 0.0005, 0.0002, 0.0, 0.0, 0.0, 0.0)
FINE = (0.0002, 0.0002, 0.0001, 0.00005, 0.0, 0.0, 0.0)
NEAR = (0.0001, 0.0, 0.0, 0.0)  # of modes that were reached without the newest measurement
_AHEAD = torch.tensor([0.0, 0.003, 0.006, 0.01], dtype=torch.float64)  # m
_STEP_LENGTHS = torch.tensor([0.15, 0.5, 1.0], dtype=torch.float64)
# Starts of Gauss-Newton, in prior standard deviations; they are the same in every run.
_STARTS = torch.randn(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
_PLACES = torch.randn(16, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
# The same in standard deviations of the posterior before, which are taken to be so many times as large.
_NEAR, _WIDE = torch.randn(32, 6, generator=torch.Generator().manual_seed(5), dtype=torch.float64), 3.0
# Modes that are kept: at most so many, of weights within so many nats of the largest, and at least so many
# squared standard deviations apart.
_MODES, _FAINT, _SAME = 4, 6.0, 12.0
_REFUTED = 10.0  # nats by which a mode that started at another component of the prior is less probable
# Starts from many places that are followed to the end: of 12 none reached the narrow mode that held the
# truth of scene 20108 of the accuracy bench.
_LEFT = 20
# Squared standard deviations within which two starts have come together, and lead to the same mode.
_MET = 0.01
# Squared prior standard deviations beyond which a hole is not entered: 1e-6 of six degrees of freedom.
_FARTHEST = 40.0
_REPLICAS = 16  # of the best mode, for a site whose check draws them

# The sites of the likelihood at poses (S, 7), errors `blur` metres wider, each with its observed value.
Sites = Callable[[Tensor, float], Iterable[tuple[Any, Tensor]]]


class Normal(NamedTuple):
    """A Gaussian prior of a pose: its mean (1, 7), and a precision (1, 6, 6) in its tangent space."""

    center: Tensor
    precision: Tensor


def component_of(prior: GaussianMixture, component: int) -> Normal:
    """One of a prior's components."""
    return Normal(prior.centers[component, None], torch.linalg.inv(prior.covariances[component])[None])


def within_component(
    prior: GaussianMixture, component: int, mixture: GaussianMixture | None
) -> GaussianMixture | None:
    """Those of a mixture's components that are within one of a prior's; None for none."""
    if mixture is None:
        return None
    own = prior.component(mixture.centers) == component
    return GaussianMixture(*(values[own] for values in mixture)) if bool(own.any()) else None


class QuadraticApproximation(NamedTuple):
    """A log-likelihood to second order around each of its M modes, the one of largest weight first."""

    around: Tensor  # (M, 7) the modes
    gradient: Tensor  # (M, 6) of minus the log-likelihood in the tangent space at the modes
    information: Tensor  # (M, 6, 6) Gauss-Newton approximation of its Hessian
    log_likelihood: Tensor  # (M,) at the modes

    def posterior(self, center: Tensor, precision: Tensor) -> GaussianMixture:
        """The posterior, M components, under Gaussian priors: means (..., 7), precisions (..., 6, 6)."""
        return self.posterior_each(center[..., None, :], precision[..., None, :, :])

    def posterior_each(self, center: Tensor, precision: Tensor) -> GaussianMixture:
        """The posterior under a prior for each mode: means (..., M, 7), precisions (..., M, 6, 6)."""
        away = poses.log(self.around, center)
        pull = (precision @ away[..., None])[..., 0]
        covariance = torch.linalg.inv(precision + self.information)
        step = (covariance @ (pull - self.gradient)[..., None])[..., 0]
        # The integral of prior times likelihood over all poses, by completing the square.
        squares = (step * (pull - self.gradient)).sum(dim=-1) - (away * pull).sum(dim=-1)
        sizes = torch.linalg.slogdet(covariance)[1] + torch.linalg.slogdet(precision)[1]
        return GaussianMixture(
            poses.exp(self.around, step),
            0.5 * (covariance + covariance.transpose(-1, -2)),
            self.log_likelihood + 0.5 * (squares + sizes),
        )


class Search(NamedTuple):
    """Where to start from.

    Attributes:
        heading: (3,) the direction of motion at the last contact; None for none.
        everywhere: whether to search for all modes.
        entries: each from poses (M, 7) makes others, from which a hole is entered.
        near: (K, 7) poses to start from as well; None for none.
    """

    heading: Tensor | None = None
    everywhere: bool = False
    entries: tuple[Callable[[Tensor], Tensor], ...] = ()
    near: Tensor | None = None


def quadratic_approximation(
    sites: Sites,
    prior: Normal,
    before: GaussianMixture | None = None,
    search: Search | None = None,
    inside: Sequence[InHole] = (),
    nearby: bool = False,
) -> QuadraticApproximation:
    """The quadratic approximation around the posterior modes that Gauss-Newton reaches.

    Where the modes are `nearby` those of fewer measurements, it starts from these, and from nowhere else
    unless the best of what it reaches explains the measurements badly.

    Otherwise it starts from the prior mean and from places around it, at first with errors of millimetres.
    Where a part is estimated too near, a peg penetrates it deeply, and would leave a thin wall on the wrong
    side; so it starts from outside as well, the part displaced along the direction of the last contact.
    Errors of millimetres lead all starts to one mode, and which corner or edge was touched may be ambiguous:
    `everywhere` starts from many places with small errors too, under the prior, around what fewer
    measurements have left, and with the peg in the mouth of a hole, each of which leads to the nearest mode.

    Args:
        sites: the likelihood.
        prior: of the pose.
        before: the posterior given fewer measurements, M components; None for none.
        search: where to start from; around the prior mean and the modes of `before` unless given.
        inside: poses that have the peg in a hole, of which each leads to a mode.
        nearby: whether the modes of `before` hardly move.
    """
    modes = None
    if nearby and before is not None:
        reached, _ = gauss_newton(sites, before.centers, prior, NEAR, len(before.centers))
        modes = _quadratic(sites, reached) if _explains(sites, reached[:1]) else None
    if modes is None:
        modes = _quadratic(sites, _searched(sites, prior, before, search or Search()))
    each = [modes, *(_in_hole(sites, one, prior) for one in inside)]
    return _distinct(concatenated_modes(each), prior)


def _searched(sites: Sites, prior: Normal, before: GaussianMixture | None, search: Search) -> Tensor:
    """The modes (M, 7) that are reached from all starts."""
    center, precision = prior
    scale = torch.linalg.cholesky(torch.linalg.inv(precision[0]))
    earlier = [] if before is None else [before.centers[:1]]
    starts = [center, poses.exp(center, _STARTS @ scale.T), *earlier]
    reached = [gauss_newton(sites, torch.cat(starts), prior, BLURS)]
    if search.heading is not None:
        ahead = torch.cat([center, center if before is None else before.centers[:1]]).repeat_interleave(
            len(_AHEAD), 0
        )
        ahead[:, :3] += _AHEAD.repeat(2)[:, None] * search.heading
        reached.append(gauss_newton(sites, ahead, prior, SHARP))
    best, _ = max(reached, key=lambda fit: float(fit[1][0]))
    others = [] if before is None or len(before.centers) == 1 else [before.centers]
    others += [] if search.near is None else [search.near]
    if search.everywhere:
        places = poses.exp(center, _PLACES @ scale.T)
        entered = torch.cat([places[:0], *(entry(places) for entry in search.entries)])
        away = poses.log(center, entered)
        entered = entered[((away @ precision[0]) * away).sum(dim=-1) < _FARTHEST]
        if len(entered):
            # By themselves: they begin less probable than others, as a needle does.
            best = torch.cat([best, gauss_newton(sites, entered, prior, FINE, _MODES)[0]])
        others.append(places)
        if before is not None:
            of = torch.arange(len(_NEAR)) % len(before.centers)
            away = torch.linalg.cholesky(before.covariances)[of] @ _NEAR[..., None]
            others.append(poses.exp(before.centers[of], _WIDE * away[..., 0]))
    if others:
        each, _ = gauss_newton(sites, torch.cat(others), prior, FINE, _LEFT)
        best = torch.cat([best, each])
    return best


def _explains(sites: Sites, pose: Tensor) -> bool:
    """Whether no site would be warned of at a pose (1, 7)."""

    def replicas(number: int) -> Any:
        return list(sites(pose.repeat(_REPLICAS, 1), 0.0))[number][0]

    for k, (site, value) in enumerate(sites(pose, 0.0)):
        check = site.predictive_check(value, partial(replicas, k)) if isinstance(site, Checked) else None
        if check is not None and check.surprising:
            return False
    return True


def _in_hole(sites: Sites, inside: InHole, prior: Normal) -> QuadraticApproximation:
    """The modes that have the peg in a hole, within which a likelihood without contact is flat."""
    there, _ = gauss_newton(sites, inside.part, prior, FINE, len(inside.part))
    found = _quadratic(sites, there)
    # Gauss-Newton orders what it reaches, and moves it by no more than the hole's room: any of them will do.
    return found._replace(information=found.information + inside.information[:1])


def together(each: Sequence[QuadraticApproximation], prior: GaussianMixture) -> QuadraticApproximation:
    """The modes reached from each of a prior's components, without those that hardly weigh beside others."""
    modes = concatenated_modes(each)
    own = torch.arange(len(each)).repeat_interleave(torch.tensor([len(one.around) for one in each]))
    weight = modes.posterior_each(prior.centers[own], torch.linalg.inv(prior.covariances[own])).log_weights
    weight = weight + prior.log_weights[own]
    order = weight.argsort(descending=True)
    kept = order[weight[order] > weight[order[0]] - _REFUTED]
    return QuadraticApproximation(*(values[kept] for values in modes))


def concatenated_modes(each: Sequence[QuadraticApproximation]) -> QuadraticApproximation:
    """The modes of all."""
    return QuadraticApproximation(*(torch.cat(values) for values in zip(*each, strict=True)))


def gauss_newton(
    sites: Sites, starts: Tensor, prior: Normal, blurs: Sequence[float], least: int = 1
) -> tuple[Tensor, Tensor]:
    """The poses (M, 7) of highest posterior density that are reached, and their log-densities (M,).

    Each step adds one of `blurs` (m) to the errors, 0 in the end, and keeps half of the starts (S, 7), but at
    least so many; of those that have come together it keeps the best.
    """
    center, precision = prior
    pose, density = starts, torch.zeros(len(starts))
    for blur in blurs:
        quadratic = _quadratic(sites, pose, blur)
        pull = (precision @ poses.log(pose, center)[..., None])[..., 0] - quadratic.gradient
        step = torch.linalg.solve(precision + quadratic.information, pull[..., None])
        # Which corner touches changes along the step: it is made only as long as it gains.
        ahead = poses.exp(pose[:, None], _STEP_LENGTHS[:, None] * step[:, None, :, 0])
        log_likelihood = pose.new_zeros(ahead.shape[:2])
        for site, value in sites(ahead.reshape(-1, 7), blur):
            log_likelihood = log_likelihood + site.log_prob(value).reshape(ahead.shape[:2])
        tried = torch.cat([pose[:, None], ahead], dim=1)
        total = torch.cat([quadratic.log_likelihood[:, None], log_likelihood], dim=1)
        away = poses.log(center, tried)
        total = total - 0.5 * ((away @ precision[0]) * away).sum(dim=-1)
        density, farthest = total.max(dim=1)
        kept = density.topk(min(len(pose), max(least, len(pose) // 2))).indices
        pose, density = tried[kept, farthest[kept]], density[kept]
        apart = _apart(pose, (precision + quadratic.information)[kept])
        pose, density = pose[apart], density[apart]
    return pose[:least], density[:least]


def _apart(pose: Tensor, precision: Tensor) -> Tensor:
    """Which of some poses (S, 7), the best first, have not come together with a better one (S,)."""
    away = poses.log(pose[:, None], pose)
    squared = torch.einsum("sri,sij,srj->sr", away, precision, away)
    return ~(squared < _MET).triu(diagonal=1).any(dim=0)


def _quadratic(sites: Sites, pose: Tensor, blur: float = 0.0) -> QuadraticApproximation:
    """The sum of all sites' quadratic approximations around poses (S, 7)."""
    gradient, information = pose.new_zeros(len(pose), 6), pose.new_zeros(len(pose), 6, 6)
    log_likelihood = pose.new_zeros(len(pose))
    for site, value in sites(pose, blur):
        own = site.quadratic(value)
        gradient, information = gradient + own.gradient, information + own.information
        log_likelihood = log_likelihood + site.log_prob(value)
    return QuadraticApproximation(pose, gradient, information, log_likelihood)


def _distinct(modes: QuadraticApproximation, prior: Normal) -> QuadraticApproximation:
    """The modes that carry weight, of those that coincide the one with the largest."""
    if len(modes.around) == 1:
        return modes
    away = poses.log(modes.around, prior.center)
    covariance = torch.linalg.inv(prior.precision + modes.information)
    # Laplace's weights at the poses themselves: Gauss-Newton has not converged at some.
    weight = modes.log_likelihood - 0.5 * ((away @ prior.precision[0]) * away).sum(dim=-1)
    weight = weight + 0.5 * torch.linalg.slogdet(covariance)[1]
    kept: list[int] = []
    for one in weight.argsort(descending=True).tolist():
        if kept and (len(kept) == _MODES or weight[one] < weight[kept[0]] - _FAINT):
            break
        off = poses.log(modes.around[kept], modes.around[one])
        squared = (off * torch.linalg.solve(covariance[kept], off[..., None])[..., 0]).sum(dim=-1)
        if not bool((squared < _SAME).any()):
            kept.append(one)
    return QuadraticApproximation(*(each[kept] for each in modes))

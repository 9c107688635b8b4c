"""Components adapted by importance sampling have the moments and the evidence of posteriors known exactly."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.pose_normals import GaussianMixture
from bcppl.inference.approximations.adaptive import _as_likelihood, adapted
from bcppl.inference.approximations.laplace import Normal, QuadraticApproximation

WIDE, NARROW = 0.002, 0.0002  # m: standard deviations of a likelihood's two parts along x
CENTER = poses.retract(poses.identity(), torch.tensor([0.1, 0.2, 0.3, 0.4, -0.3, 0.2], dtype=torch.float64))
PRIOR_SD = torch.tensor([0.003, 0.003, 0.003, 0.05, 0.05, 0.05], dtype=torch.float64)
PRIOR = Normal(CENTER[None], torch.diag(PRIOR_SD**-2)[None])


@dataclass(frozen=True)
class Peaked:
    """A likelihood of the displacement along x from the prior's mean: two zero-mean normals, half each.

    Curvature at the mode knows the narrow one alone.
    """

    pose: Tensor
    narrow: float

    def log_prob(self, value: Tensor) -> Tensor:
        x = poses.log(CENTER, self.pose)[:, 0]
        both = torch.stack([self._normal(x, self.narrow), self._normal(x, WIDE)])
        return both.logsumexp(dim=0) - math.log(2.0)

    @staticmethod
    def _normal(x: Tensor, scale: float) -> Tensor:
        return -0.5 * (x / scale) ** 2 - math.log(scale * math.sqrt(2.0 * math.pi))


def sites(narrow: float) -> Any:
    def each(pose: Tensor, blur: float) -> Iterator[tuple[Peaked, Tensor]]:
        yield Peaked(pose, narrow), torch.zeros(())

    return each


def at_mode(narrow: float) -> QuadraticApproximation:
    """Laplace's approximation at the mode."""
    weights = torch.tensor([1.0 / narrow, 1.0 / WIDE], dtype=torch.float64)
    curvature = (weights @ torch.tensor([narrow**-2, WIDE**-2], dtype=torch.float64)) / weights.sum()
    information = torch.zeros(1, 6, 6, dtype=torch.float64)
    information[0, 0, 0] = curvature
    height = Peaked(CENTER[None], narrow).log_prob(torch.zeros(()))
    return QuadraticApproximation(CENTER[None], torch.zeros(1, 6, dtype=torch.float64), information, height)


def exact(narrow: float) -> tuple[float, float]:
    """The posterior's variance along x, and the log-evidence."""
    scales = torch.tensor([narrow, WIDE], dtype=torch.float64)
    prior = float(PRIOR_SD[0])
    evidence = 0.5 / (2.0 * math.pi * (scales**2 + prior**2)).sqrt()
    variances = 1.0 / (scales**-2 + prior**-2)
    return float((evidence / evidence.sum()) @ variances), math.log(float(evidence.sum()))


def moments(quadratic: QuadraticApproximation) -> GaussianMixture:
    return GaussianMixture(*(values[0] for values in quadratic.posterior(*PRIOR)))


def test_moments_and_evidence_where_curvature_says_a_fifth_of_the_width() -> None:
    modes = at_mode(NARROW)
    posterior = moments(adapted(sites(NARROW), PRIOR, modes))
    variance, log_evidence = exact(NARROW)
    assert float(moments(modes).covariances[0, 0, 0]) < 0.05 * variance
    # From 100 effective draws or more a variance is accurate to 15 %.
    assert float(posterior.covariances[0, 0, 0]) == pytest.approx(variance, rel=0.45)
    others = posterior.covariances[0].diagonal()[1:] / PRIOR_SD[1:] ** 2
    assert bool((others > 0.6).all()) and bool((others < 1.2).all())
    assert float(posterior.log_weights.logsumexp(0)) == pytest.approx(log_evidence, abs=0.3)
    off = poses.log(CENTER, posterior.centers[0]) / PRIOR_SD
    assert float(off.abs().max()) < 0.4


def test_a_normal_likelihood_keeps_its_curvature() -> None:
    modes = at_mode(WIDE)  # both parts are the same
    assert adapted(sites(WIDE), PRIOR, modes) is modes


def test_the_posterior_before_is_where_draws_begin_too() -> None:
    """A second peak that no mode was found at is found where the posterior before had it."""
    offset = 0.006

    @dataclass(frozen=True)
    class Two:
        pose: Tensor

        def log_prob(self, value: Tensor) -> Tensor:
            x = poses.log(CENTER, self.pose)[:, 0]
            peaks = [Peaked._normal(x - place, NARROW) for place in (0.0, offset)]
            return torch.stack(peaks).logsumexp(dim=0)

    def each(pose: Tensor, blur: float) -> Iterator[tuple[Two, Tensor]]:
        yield Two(pose), torch.zeros(())

    away = torch.tensor([offset, 0, 0, 0, 0, 0], dtype=torch.float64)
    covariance = torch.diag(torch.tensor([0.001, *PRIOR_SD[1:].tolist()], dtype=torch.float64) ** 2)
    before = GaussianMixture(poses.exp(CENTER, away)[None], covariance[None], torch.zeros(1).double())
    modes = at_mode(NARROW)
    for one, found in ((None, False), (before, True)):
        posterior = moments(adapted(each, PRIOR, modes, one))
        shares = posterior.log_weights.softmax(0)
        far = poses.log(CENTER, posterior.centers)[:, 0] > 0.5 * offset
        # The prior has it less probable by exp(-2), but for the narrow peaks' own widths.
        expected = math.exp(-0.5 * (offset / 0.003) ** 2)
        share = float(shares[far].sum())
        assert (share == pytest.approx(expected / (1.0 + expected), abs=0.06)) is found


def test_modes_stay_where_no_draw_has_weight() -> None:
    @dataclass(frozen=True)
    class Nowhere:
        pose: Tensor

        def log_prob(self, value: Tensor) -> Tensor:
            return torch.full((len(self.pose),), -torch.inf, dtype=torch.float64)

    modes = at_mode(NARROW)
    assert adapted(lambda pose, blur: [(Nowhere(pose), torch.zeros(()))], PRIOR, modes) is modes


def test_components_are_a_likelihood_that_leaves_them() -> None:
    spread = torch.diag(torch.tensor([1e-4, 5e-4, 2e-3, 0.01, 0.03, 0.02], dtype=torch.float64) ** 2)
    away = torch.tensor([[1e-3, 0, 0, 0.02, 0, 0], [0, -2e-3, 0, 0, 0, 0.03]], dtype=torch.float64)
    mixture = GaussianMixture(
        poses.exp(CENTER, away), torch.stack([spread, 0.5 * spread]), torch.tensor([-1.0, -2.0]).double()
    )
    back = moments(_as_likelihood(mixture, PRIOR))
    torch.testing.assert_close(back.log_weights, mixture.log_weights)
    torch.testing.assert_close(back.covariances, mixture.covariances)
    torch.testing.assert_close(poses.log(mixture.centers, back.centers), torch.zeros(2, 6).double())


def test_the_random_state_is_left_alone_and_the_draws_are_the_same() -> None:
    torch.manual_seed(3)
    first = adapted(sites(NARROW), PRIOR, at_mode(NARROW))
    drawn = torch.rand(3)
    torch.manual_seed(3)
    assert torch.equal(drawn, torch.rand(3))
    second = adapted(sites(NARROW), PRIOR, at_mode(NARROW))
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))

"""A normal over poses cut off at a box: its draws lie within, and its density is theirs."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import norm
from torch import Tensor
from torch.distributions import MultivariateNormal

from bcppl import poses
from bcppl.distributions.poses import BoxedNormal

LIMIT = torch.full((3,), 0.01, dtype=torch.float64)


def correlated() -> Tensor:
    mixed = torch.randn(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    scale = torch.diag(torch.tensor([0.004] * 3 + [0.02] * 3, dtype=torch.float64))
    return scale @ mixed @ mixed.T @ scale


@pytest.mark.long
@pytest.mark.parametrize("shift", [0.0, 0.012, -0.03])
def test_its_density_is_that_of_its_draws(shift: float) -> None:
    """Reweighed to the normal, draws in the box give the normal's chance of lying in it, also far out."""
    torch.manual_seed(1)
    count, covariance = 100_000, correlated()
    center = poses.identity(count)
    center[:, 0] += shift
    center[:, 2] -= shift
    boxed = BoxedNormal(center, covariance, torch.stack([-LIMIT, LIMIT]))
    drawn = boxed.sample()
    assert bool((drawn[:, :3].abs() <= LIMIT).all())
    share = torch.exp(boxed.normal.log_prob(drawn) - boxed.log_prob(drawn))
    tangent = MultivariateNormal(torch.zeros(6, dtype=torch.float64), covariance).sample((1_000_000,))
    inside = (tangent[:, :3] + center[0, :3]).abs() <= LIMIT
    chance = inside.all(dim=1).double()
    error = float(torch.hypot(share.std() / count**0.5, chance.std() / 1e3))
    assert float(share.mean()) == pytest.approx(float(chance.mean()), abs=4.0 * error)


@pytest.mark.parametrize("far", [6.0, 8.5, 40.0, 1000.0])
def test_draws_of_a_normal_far_outside_the_box_lie_as_close_to_its_border_as_is_exact(far: float) -> None:
    """Also where the normal's distribution function at the border, and its density there, round to 0."""
    torch.manual_seed(2)
    deviation, count = 2e-4, 20_000
    center = poses.identity(count)
    center[:, 0] = 0.01 + far * deviation
    center[:, 1] = -center[:, 0]
    covariance = torch.diag(torch.tensor([deviation] * 3 + [0.02] * 3, dtype=torch.float64) ** 2)
    boxed = BoxedNormal(center, covariance, torch.stack([-LIMIT, LIMIT]))
    drawn = boxed.sample()
    assert bool(torch.isfinite(boxed.log_prob(drawn)).all())
    exact = math.exp(norm.logpdf(far) - norm.logsf(far)) - far  # standard deviations
    within = (0.01 - drawn[:, :2].abs()) / deviation
    assert within.mean(dim=0).tolist() == pytest.approx([exact] * 2, rel=4.0 / count**0.5)


def test_outside_it_has_no_density() -> None:
    boxed = BoxedNormal(poses.identity(2), correlated(), torch.stack([-LIMIT, LIMIT]))
    outside = poses.identity(2)
    outside[1, 1] = 0.011
    assert torch.isfinite(boxed.log_prob(outside)).tolist() == [True, False]

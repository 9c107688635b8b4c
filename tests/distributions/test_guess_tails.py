"""Tails of a guess: their mass, draws and density, and the proposals that follow them."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import MultivariateNormal

from bcppl import poses
from bcppl.distributions.pose_normals import moments_within, truncated
from bcppl.distributions.poses import NormalPose, SwingTwistPose, UniformPose, prior_from_guess
from bcppl.geometry.parts import Guess

WIDTH, TAIL = 0.02, 0.05


def box(tail: float = TAIL) -> SwingTwistPose:
    return SwingTwistPose(poses.identity(), WIDTH, 0.3, 0.5, tail=tail)


def at(*shift: float) -> torch.Tensor:
    pose = poses.identity(1)
    pose[0, : len(shift)] = torch.tensor(shift, dtype=torch.float64)
    return pose


@pytest.mark.parametrize("prior", [box(), UniformPose(poses.identity(), WIDTH, 0.3, tail=TAIL)])
def test_draws_have_the_density_in_the_tails_and_in_the_box(prior: UniformPose | SwingTwistPose) -> None:
    torch.manual_seed(0)
    count = 100_000
    drawn = prior.sample((count,))[:, 0].abs() / WIDTH
    error = math.sqrt(TAIL / count)
    assert float((drawn > 1.0 - TAIL).double().mean()) == pytest.approx(TAIL, abs=4.0 * error)
    # Of the tails from 0.95 to 3 half widths, half is beyond their middle.
    beyond = drawn[drawn > 1.0 - TAIL]
    assert float((beyond > 0.5 * (4.0 - TAIL)).double().mean()) == pytest.approx(0.5, abs=0.03)
    ratio = float((prior.log_prob(at(2.0 * WIDTH)) - prior.log_prob(at(0.0))).exp())
    assert ratio * (2.0 + TAIL) == pytest.approx(TAIL)  # a mass of TAIL over 2.05 half widths on each side
    corner = float(prior.log_prob(at(2.0 * WIDTH, 0.0, -2.0 * WIDTH)) - prior.log_prob(at(0.0)))
    assert corner == pytest.approx(2.0 * math.log(ratio))
    assert float(prior.log_prob(at(3.01 * WIDTH))) == -math.inf


def test_within_the_box_nothing_changes_to_the_bit() -> None:
    torch.manual_seed(1)
    alone = box(0.0).sample((1000,))
    torch.manual_seed(1)
    tailed = box().sample((1000,))
    inside = (tailed[:, :3].abs() <= (1.0 - TAIL) * WIDTH).all(dim=1)
    assert 0.8 < float(inside.double().mean()) < 0.9
    assert torch.equal(alone[inside], tailed[inside])
    assert torch.equal(box(0.0).log_prob(alone[inside]), box().log_prob(alone[inside]))


def test_held_axes_have_no_tail() -> None:
    prior = SwingTwistPose(poses.identity(), [WIDTH, 0.0, 0.0], 0.0, 0.5, tail=TAIL)
    drawn = prior.sample((1000,))
    assert float(drawn[:, 1:3].abs().max()) == 0.0 and bool(torch.isfinite(prior.log_prob(drawn)).all())


def test_a_recording_s_guess_has_tails() -> None:
    prior = prior_from_guess(Guess(poses.identity().numpy(), torch.full((3,), WIDTH).numpy(), 0.3, 0.5))
    outside = prior.log_prob(at(2.0 * WIDTH)) - prior.log_prob(at(0.0))
    assert -7.0 < float(outside) < -4.0


@pytest.mark.long
@pytest.mark.parametrize("beside", [0.0, 0.019, 0.024, 0.04])
def test_proposals_are_the_normal_times_the_prior(beside: float) -> None:
    """Their density, reweighed to normal times prior, integrates to what draws of the normal give."""
    torch.manual_seed(2)
    count, prior = 100_000, box()
    root = torch.randn(6, 6, dtype=torch.float64)
    covariance = 0.003**2 * (root @ root.T / 6.0 + 0.3 * torch.eye(6))
    center = at(beside, -0.017)
    normal = NormalPose(center, covariance[None])
    proposal = truncated(prior, normal).expand((count,))
    drawn = proposal.sample()
    factor = prior.log_prob(drawn) - prior.log_prob(poses.identity())
    weight = torch.exp(normal.log_prob(drawn) + factor - proposal.log_prob(drawn))
    tangent = MultivariateNormal(torch.zeros(6).double(), covariance).sample((1_000_000,))
    limits, log_steps = prior.steps
    place = ((tangent[:, None, :3] + center[:, None, :3]) > limits[1:-1]).sum(dim=1)
    share = log_steps[place].sum(dim=1).exp()
    error = math.hypot(float(weight.std()) / count**0.5, float(share.std()) / 1e3)
    assert float(weight.mean()) == pytest.approx(float(share.mean()), abs=4.0 * error + 1e-9)
    # Expectation propagation is good to a few percent where the product has one mode.
    inside = moments_within(prior, normal)
    mean = (share[:, None] * tangent).sum(dim=0) / share.sum()
    scale = covariance.diagonal().sqrt()
    assert float(((poses.local(center, inside.center)[0] - mean) / scale).abs().max()) < 0.1


@pytest.mark.parametrize("bounds", [{"tilt": 0.3, "yaw": 0.5}, {"angle": 0.4}, {"tilt": 0.0, "yaw": math.pi}])
def test_a_guess_allows_what_its_prior_does(bounds: dict[str, float]) -> None:
    center = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
    guess = Guess(center.numpy(), [0.02, 0.01, 0.0], **bounds)
    away = torch.randn(400, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    away = away * torch.tensor([0.03, 0.015, 0.0, 0.2, 0.2, 0.3], dtype=torch.float64)
    away[::2, 3:5] = 0.0
    there = poses.retract(center, away)
    possible = torch.isfinite(prior_from_guess(guess).log_prob(there))
    assert possible.any() and not possible.all()
    assert [guess.allows(each) for each in there.numpy()] == possible.tolist()

"""The exponential map of poses, and normals over twists: exact motions, densities that are normalised."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import MixturePose, NormalPose, NormalTwist
from bcppl.poses import Freedom

TWISTS = torch.tensor(
    [
        [0.01, -0.02, 0.03, 0.3, -0.5, 0.7],
        [0.2, 0.1, -0.3, 1.5, 2.0, -1.0],
        [0.1, 0.2, 0.3, 1e-6, -2e-6, 3e-6],
        [0.1, 0.2, 0.3, 0.0, 0.0, 0.0],
    ],
    dtype=torch.float64,
)


def start() -> Tensor:
    return poses.as_pose([0.4, -0.1, 0.2, 0.5, 0.5, -0.5, 0.5], "the start")


def test_it_is_the_exponential_of_a_matrix() -> None:
    turn, origin = poses.rotation_matrix(start()).numpy(), start()[:3].numpy()
    for twist in TWISTS:
        x, y, z = twist[3:].numpy()
        rate = np.zeros((4, 4))  # in the pose's own frame
        rate[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        rate[:3, 3] = turn.T @ twist[:3].numpy()
        before = np.eye(4)
        before[:3, :3], before[:3, 3] = turn, origin
        after = before @ expm(rate)
        moved = poses.exp(start(), twist)
        np.testing.assert_allclose(poses.rotation_matrix(moved), after[:3, :3], atol=1e-12)
        np.testing.assert_allclose(moved[:3], after[:3, 3], atol=1e-12)


@pytest.mark.parametrize("differentiable", [False, True])
def test_there_and_back(differentiable: bool) -> None:
    twists = TWISTS.clone().requires_grad_(differentiable)
    there = poses.exp(start(), twists)
    torch.testing.assert_close(poses.log(start(), there).detach(), TWISTS, atol=1e-10, rtol=0.0)
    torch.testing.assert_close(there.detach(), poses.exp(start(), TWISTS), atol=1e-12, rtol=0.0)


def test_a_turn_about_a_place_afar_is_a_straight_line_of_twists() -> None:
    place = torch.tensor([0.6, 0.2, 0.1], dtype=torch.float64)
    turn = torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64)
    outer = poses.rotation_matrix(start()) @ turn
    twist = torch.cat([torch.linalg.cross(outer, start()[:3] - place), turn])
    seen = poses.transform(poses.inverse(start()), place[None])[0]
    for share in (0.1, 1.0, 2.5):
        moved = poses.exp(start(), share * twist)
        torch.testing.assert_close(poses.transform(moved, seen[None])[0], place, atol=1e-12, rtol=0.0)
    assert float((poses.transform(poses.retract(start(), twist), seen[None])[0] - place).norm()) > 0.05


def covariance(turn: float) -> Tensor:
    root = torch.randn(6, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    scale = torch.tensor([0.02, 0.03, 0.02, turn, 0.7 * turn, 1.2 * turn], dtype=torch.float64)
    return scale[:, None] * (0.3 * root @ root.T + torch.eye(6, dtype=torch.float64)) * scale


@pytest.mark.long
@pytest.mark.parametrize("turn", [0.05, 0.4, 1.0])  # radians; of the last, turns beyond pi count
def test_the_density_is_normalised_and_that_of_its_draws(turn: float) -> None:
    torch.manual_seed(0)
    mine = NormalTwist(start(), covariance(turn))
    wide = NormalPose(
        start(), 1.5 * covariance(turn) + torch.diag(torch.tensor([1e-3] * 3 + [1e-3] * 3).double())
    )
    drawn = wide.expand((200_000,)).sample()
    weights = (mine.log_prob(drawn) - wide.log_prob(drawn)).exp()
    error = float(weights.std()) / math.sqrt(len(weights))
    assert float(weights.mean()) == pytest.approx(1.0, abs=5.0 * error) and error < 0.01
    # Expectations by weight are those of its own draws.
    own = mine.expand((200_000,)).sample()
    for measure in (lambda p: p[:, :3], lambda p: poses.rotation_matrix(p).flatten(1)):
        by_weight = (weights[:, None] * measure(drawn)).mean(dim=0)
        spread = (weights[:, None] * measure(drawn)).std(dim=0) + measure(own).std(dim=0)
        off = (by_weight - measure(own).mean(dim=0)).abs()
        assert bool((off <= 6.0 * spread / math.sqrt(len(own)) + 1e-12).all())


def test_what_is_known_of_a_contact_and_hardly_of_a_turn_about_it_is_normal_over_twists() -> None:
    """A point of the part stays within 20 um while the part may turn about it by ten degrees."""
    torch.manual_seed(1)
    seen = torch.tensor([0.03, 0.0, 0.01], dtype=torch.float64)  # of the part, held at its place
    place = poses.transform(start(), seen[None])[0]

    def log_density(pose: Tensor) -> Tensor:
        off = (poses.transform(pose, seen[None])[:, 0] - place) / 2e-5
        turned = poses.local(start(), pose)[:, 3:] / math.radians(10.0)
        base = poses.log_haar_density_of_rotation_vector(poses.local(start(), pose)[:, 3:].norm(dim=1))
        return -0.5 * (off.square().sum(dim=1) + turned.square().sum(dim=1)) - base

    # To second order at the mode: d(place) = shift + turn x (place - origin), along the outer axes.
    turn = poses.rotation_matrix(start())
    arm = place - start()[:3]
    cross = torch.linalg.cross(turn.T, arm.expand(3, 3), dim=-1).T
    jacobian = torch.cat([torch.eye(3, dtype=torch.float64), cross], dim=1) / 2e-5
    rest = torch.diag(torch.tensor([0.0] * 3 + [math.radians(10.0) ** -2] * 3, dtype=torch.float64))
    spread = torch.linalg.inv(jacobian.T @ jacobian + rest)

    def effective(proposal: NormalPose) -> float:
        drawn = proposal.expand((2000,)).sample()
        weights = torch.softmax(log_density(drawn) - proposal.log_prob(drawn), dim=0)
        return float(1.0 / weights.square().sum()) / len(weights)

    assert effective(NormalTwist(start(), spread)) > 0.9
    assert effective(NormalPose(start(), spread)) < 0.05


def test_its_coordinates_are_twists() -> None:
    there = poses.exp(start(), TWISTS[:2])
    mine = NormalTwist(start(), covariance(0.1))
    torch.testing.assert_close(mine.coordinates(there), TWISTS[:2], atol=1e-10, rtol=0.0)


def test_a_mixture_of_twists_has_their_density() -> None:
    centers = torch.stack([start(), poses.exp(start(), TWISTS[0])])
    weights = torch.tensor([0.3, 0.7], dtype=torch.float64)
    mixture = MixturePose(weights.log(), centers, covariance(0.1), twists=True)
    at = poses.exp(start(), 0.5 * TWISTS[:2])
    each = torch.stack([NormalTwist(center, covariance(0.1)).log_prob(at) for center in centers])
    expected = torch.logsumexp(weights.log()[:, None] + each, dim=0)
    torch.testing.assert_close(mixture.log_prob(at), expected)


@pytest.mark.parametrize("deviation", [0.3, 1.0, 2.0, 5.0])
def test_densities_of_wide_rotations_are_normalised(deviation: float) -> None:
    """Over a whole turn about one axis, by the normalised Haar measure."""
    angle = torch.linspace(-math.pi, math.pi, 4001, dtype=torch.float64)
    turned = torch.zeros(4001, 6, dtype=torch.float64)
    turned[:, 5] = angle
    normal = NormalPose(
        poses.identity(), torch.tensor([[deviation**2]], dtype=torch.float64), Freedom("", "z")
    )
    density = normal.log_prob(poses.retract(poses.identity(), turned)).exp()
    assert float(torch.trapezoid(density, angle)) / (2.0 * math.pi) == pytest.approx(1.0, abs=1e-4)

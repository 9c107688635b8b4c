"""Beliefs: moments and distances of weighted poses, against small cases done by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import (
    Belief,
    average_distance,
    average_nearest_distance,
    effective_sample_size,
    normalised,
)
from bcppl.errors import InferenceError, InputError
from bcppl.poses import identity


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> Tensor:
    """A pose turned about z."""
    return torch.tensor([x, y, z, math.cos(turn / 2), 0, 0, math.sin(turn / 2)], dtype=torch.float64)


def weights(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64).log() + 123.0


CORNERS = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=torch.float64)


def test_mean_and_covariance_by_hand() -> None:
    belief = Belief(torch.stack([pose(0.0, turn=-0.2), pose(4.0, turn=0.6)]), weights(3, 1))
    torch.testing.assert_close(belief.weights, torch.tensor([0.75, 0.25], dtype=torch.float64))
    # The chordal mean of turns about one axis is the angle of the weighted mean of the doubled quaternion.
    angle = math.atan2(
        0.75 * math.sin(-0.2) + 0.25 * math.sin(0.6), 0.75 * math.cos(-0.2) + 0.25 * math.cos(0.6)
    )
    assert float(poses.local(belief.mean, pose(1.0, turn=angle)).norm()) < 1e-9
    covariance = torch.zeros(6, 6, dtype=torch.float64)
    covariance[0, 0], covariance[5, 5] = 3.0, 0.12
    covariance[0, 5] = covariance[5, 0] = 0.6
    torch.testing.assert_close(belief.covariance, covariance, atol=1e-9, rtol=0)
    torch.testing.assert_close(belief.spread, covariance.diagonal().sqrt(), atol=1e-9, rtol=0)
    assert belief.effective_sample_size == pytest.approx(1 / (0.75**2 + 0.25**2))


def test_antipodal_quaternions_are_one_pose() -> None:
    first = torch.stack([pose(0.1, turn=0.3), pose(-0.2, turn=0.9), pose(0.3, turn=2.9)])
    other = first.clone()
    other[1:, 3:] *= -1
    one, two = Belief(first, weights(1, 2, 3)), Belief(other, weights(1, 2, 3))
    assert float(poses.local(one.mean, two.mean).norm()) < 1e-9
    torch.testing.assert_close(one.covariance, two.covariance)
    torch.testing.assert_close(one.add(CORNERS, pose()), two.add(CORNERS, pose()))
    same = torch.stack([pose(turn=1.0), pose(turn=1.0) * torch.tensor([1, 1, 1, -1, -1, -1, -1])])
    assert float(Belief(same, weights(1, 1)).covariance.abs().max()) < 1e-15


def test_add_by_hand() -> None:
    turned = pose(turn=math.pi / 2)
    # A quarter turn moves each corner by sqrt 2, onto where another was.
    assert float(average_distance(turned, CORNERS, identity())) == pytest.approx(math.sqrt(2))
    assert float(average_nearest_distance(turned, CORNERS, identity())) == pytest.approx(0.0, abs=1e-12)
    assert float(average_distance(pose(0.3, -0.4), CORNERS, identity())) == pytest.approx(0.5)
    # Moved by 1.8 along x: the corners at 2.8 .8 1.8 1.8 are nearest, from 1 -1 and twice 0, to .8 .8 .8.
    shifted = average_nearest_distance(pose(1.8), CORNERS, identity())
    assert float(shifted) == pytest.approx((0.2 + 1.8 + 2 * math.hypot(0.8, 1.0)) / 4)
    belief = Belief(torch.stack([turned, identity(), pose(0.3, -0.4)]), weights(1, 1, 2))
    assert belief.weighted_add(CORNERS, identity()) == pytest.approx((math.sqrt(2) + 2 * 0.5) / 4)
    assert belief.add(CORNERS.numpy(), identity().numpy()).shape == (3,)


def test_distances_do_not_hang_on_the_frame() -> None:
    torch.manual_seed(0)
    points = torch.randn(40, 3, dtype=torch.float64)
    quaternion = torch.randn(6, 4, dtype=torch.float64)
    particles = torch.cat(
        [torch.randn(6, 3, dtype=torch.float64), quaternion / quaternion.norm(dim=1, keepdim=True)], 1
    )
    truth, motion, others = particles[0], particles[1], particles[2:]
    moved = poses.compose(motion, others)
    for distance in (average_distance, average_nearest_distance):
        before = distance(others, points, truth)
        torch.testing.assert_close(distance(moved, points, poses.compose(motion, truth)), before)
        assert float((distance(others, points, poses.compose(motion, truth)) - before).abs().min()) > 1e-3
    # A motion in the part's frame is no common motion, unless the points go along.
    within = average_distance(
        poses.compose(others, motion),
        poses.transform(poses.inverse(motion), points),
        poses.compose(truth, motion),
    )
    torch.testing.assert_close(within, average_distance(others, points, truth))
    assert bool(
        (average_nearest_distance(others, points, truth) <= average_distance(others, points, truth)).all()
    )


def test_distinct_counts_particles_with_weight() -> None:
    particles = torch.stack([pose(1.0), pose(1.0), pose(2.0), pose(3.0)])
    assert Belief(particles, weights(1, 1, 1, 1)).distinct == 3
    assert Belief(particles, weights(1, 1, 1, 0)).distinct == 2


def test_weights_of_any_size_are_normalised_and_none_is_an_error() -> None:
    far = torch.tensor([-1e5, -1e5 - math.log(3), -torch.inf], dtype=torch.float64)
    torch.testing.assert_close(normalised(far), torch.tensor([0.75, 0.25, 0.0], dtype=torch.float64))
    assert effective_sample_size(far) == pytest.approx(1.6)
    with pytest.raises(InferenceError, match="no particle has any weight left"):
        normalised(torch.full((3,), -torch.inf, dtype=torch.float64))


@pytest.mark.parametrize(
    ("poses_given", "weights_given", "message"),
    [
        ((4, 7), (3,), r"log weights of shape \(3,\); give \(N, 7\)"),
        ((4, 7), (4, 1), r"log weights of shape \(4, 1\)"),
        ((4, 3), (4,), r"poses of shape \(4, 3\)"),
        ((7,), (1,), r"poses of shape \(7,\)"),
    ],
)
def test_poses_and_weights_that_do_not_fit(poses_given: Any, weights_given: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Belief(torch.zeros(poses_given), torch.zeros(weights_given))


def test_a_belief_of_single_precision_is_made_double_and_one_that_is_not_finite_refused() -> None:
    particles = torch.stack([pose(1.0), pose(2.0), pose(3.0)])
    single = Belief(particles.float(), weights(1, 1, 2).float())
    torch.testing.assert_close(single.mean, Belief(particles, weights(1, 1, 2)).mean, atol=1e-6, rtol=0.0)
    assert single.world_from_part.dtype == single.log_weights.dtype == torch.float64
    particles[1, 0] = math.nan
    with pytest.raises(InputError, match="pose 1 of a belief is not finite"):
        Belief(particles, weights(1, 1, 2))
    with pytest.raises(InputError, match="world_from_part as a ndarray; give a tensor"):
        Belief(particles.numpy(), weights(1, 1, 2))  # type: ignore[arg-type]


def test_points_in_single_precision_and_poses_of_another_length() -> None:
    around = poses.identity(3)
    points = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    belief = Belief(around, torch.zeros(3, dtype=torch.float64))
    assert belief.add(points, around[0].numpy()).abs().max() == 0.0
    with pytest.raises(InputError, match="a pose of a belief has a quaternion of length 2;"):
        Belief(2.0 * around, torch.zeros(3, dtype=torch.float64))

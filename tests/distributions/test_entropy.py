"""Entropies against the base measure of poses: exact answers, and what must not change them."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.distributions.poses import UniformPose
from bcppl.errors import InputError
from bcppl.poses import FREE, Freedom

CENTER = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])
SPREAD = torch.tensor([3e-3, 1e-3, 2e-3, 0.005, 0.002, 0.01], dtype=torch.float64)


def gaussian(count: int, freedom: Freedom, seed: int = 0) -> tuple[Belief, Tensor]:
    """Draws from a Gaussian over the free tangent coordinates, and its covariance (d, d)."""
    torch.manual_seed(seed)
    size = freedom.dimension
    mix = freedom.coordinates(SPREAD)[:, None] * torch.randn(size, size, dtype=torch.float64)
    draws = torch.randn(count, size, dtype=torch.float64) @ mix.T
    particles = poses.retract(CENTER, freedom.embed(draws))
    return Belief(particles, torch.zeros(count, dtype=torch.float64), freedom), mix @ mix.T


# The base measure's log density on the tangent coordinates at no rotation: 1 / (8 pi^2), 1 / (2 pi), 1.
GAUSSIANS = [
    (FREE, -math.log(8 * math.pi**2)),
    (Freedom("xy", "z"), -math.log(2 * math.pi)),
    (Freedom("xyz", "none"), 0.0),
    (Freedom("", "all"), -math.log(8 * math.pi**2)),
]


@pytest.mark.parametrize(("freedom", "log_base"), GAUSSIANS)
def test_a_gaussian_has_the_entropy_of_a_gaussian(freedom: Freedom, log_base: float) -> None:
    belief, covariance = gaussian(3000, freedom)
    exact = 0.5 * float(torch.logdet(2 * math.pi * math.e * covariance)) + log_base
    # Standard errors: sqrt(d / 2n) for the Gaussian, about twice that for the neighbours.
    assert belief.gaussian_entropy == pytest.approx(exact, abs=4 * math.sqrt(freedom.dimension / 6000))
    assert belief.nearest_neighbour_entropy() == pytest.approx(exact, abs=0.2)
    assert belief.weight_entropy == pytest.approx(math.log(3000))


BOXES = [
    (UniformPose(CENTER, (0.02, 0.01, 0.0), 0.5, "z"), math.log(0.04 * 0.02 * 0.5 / math.pi)),
    (UniformPose(CENTER, (0.02, 0.01, 0.03), 0.0), math.log(0.04 * 0.02 * 0.06)),
    (UniformPose(CENTER, 0.0, 1.0), math.log((1.0 - math.sin(1.0)) / math.pi)),
    (UniformPose(CENTER, 0.0, 2.9), math.log((2.9 - math.sin(2.9)) / math.pi)),
    (UniformPose(CENTER, 0.0, math.pi), 0.0),
]


@pytest.mark.parametrize(("prior", "exact"), BOXES)
def test_a_uniform_belief_has_the_logarithm_of_its_measure(prior: UniformPose, exact: float) -> None:
    torch.manual_seed(0)
    count = 8000
    belief = Belief(prior.sample((count,)), torch.zeros(count, dtype=torch.float64), prior.freedom)
    found = belief.nearest_neighbour_entropy(1)
    # Near the walls a ball reaches outside, where nothing is: the estimate errs upwards.
    assert -0.05 < found - exact < 0.15
    assert belief.gaussian_entropy > found, "of one covariance the Gaussian has the largest entropy"
    # Importance weights say how the belief is spread, not where its particles happen to lie.
    tangent = prior.freedom.coordinates(poses.local(CENTER, belief.world_from_part))
    kept = tangent[:, 0] > tangent[:, 0].median()
    slope = torch.where(kept, torch.rand(count, dtype=torch.float64) < 0.25, True)
    thinned = Belief(
        belief.world_from_part[slope],
        torch.where(kept, math.log(4.0), 0.0).to(torch.float64)[slope],
        prior.freedom,
    )
    assert thinned.nearest_neighbour_entropy(4) == pytest.approx(exact, abs=0.25)


def test_the_measure_of_wide_rotations_is_not_that_of_narrow_ones() -> None:
    """A mutant without the base measure's own shape, 1 / 8 pi^2 everywhere, is off by its mean."""
    torch.manual_seed(0)
    prior = UniformPose(CENTER, 0.0, math.pi)
    belief = Belief(prior.sample((8000,)), torch.zeros(8000, dtype=torch.float64), prior.freedom)
    angle = belief.tangent[:, 3:].norm(dim=-1)
    shape = float(belief.freedom.log_base_density(angle).mean()) + math.log(8 * math.pi**2)
    assert abs(belief.nearest_neighbour_entropy(1)) < 0.15 < 0.3 < abs(shape)


def test_copies_signs_and_the_world_change_no_entropy() -> None:
    belief, _ = gaussian(80, FREE)
    belief = Belief(belief.world_from_part, torch.randn(80, dtype=torch.float64))
    opposite = belief.world_from_part * torch.tensor([1, 1, 1, -1, -1, -1, -1])
    motion = poses.as_pose([1.0, 2.0, -3.0, 0.1, -0.7, 0.7, 0.1])
    turn = poses.as_pose([0.0, 0.0, 0.0, 0.1, -0.7, 0.7, 0.1])
    same = [
        Belief(torch.cat([belief.world_from_part, opposite]), belief.log_weights.repeat(2)),
        Belief(opposite, belief.log_weights + 100.0),
        Belief(poses.compose(motion, belief.world_from_part), belief.log_weights),
        Belief(poses.compose(belief.world_from_part, turn), belief.log_weights),
    ]
    for other in same:
        assert other.weight_entropy == pytest.approx(belief.weight_entropy)
        assert other.gaussian_entropy == pytest.approx(belief.gaussian_entropy)
        assert other.nearest_neighbour_entropy() == pytest.approx(belief.nearest_neighbour_entropy())


def test_metres_twice_as_long_are_log_2_each() -> None:
    belief, _ = gaussian(80, Freedom("xy", "z"))
    wide = poses.retract(
        CENTER, poses.local(CENTER, belief.world_from_part) * torch.tensor([2, 2, 1, 1, 1, 1])
    )
    wider = Belief(wide, belief.log_weights, belief.freedom)
    assert wider.gaussian_entropy - belief.gaussian_entropy == pytest.approx(2 * math.log(2))
    gained = wider.nearest_neighbour_entropy() - belief.nearest_neighbour_entropy()
    assert gained == pytest.approx(2 * math.log(2))


def test_resampling_leaves_the_entropy_about_where_it_was() -> None:
    belief, covariance = gaussian(3000, FREE)
    exact = 0.5 * float(torch.logdet(2 * math.pi * math.e * covariance)) - math.log(8 * math.pi**2)
    copies = Belief(belief.world_from_part[torch.randint(3000, (3000,))], belief.log_weights)
    assert copies.distinct < 2000
    assert copies.nearest_neighbour_entropy() == pytest.approx(exact, abs=0.25)


def test_a_belief_that_spans_too_little_has_none() -> None:
    belief, _ = gaussian(80, FREE)
    for flat in (
        Belief(belief.world_from_part[:1].expand(5, 7), torch.zeros(5, dtype=torch.float64)),
        Belief(belief.world_from_part[:6], torch.zeros(6, dtype=torch.float64)),
    ):
        assert flat.gaussian_entropy == -math.inf and flat.nearest_neighbour_entropy() == -math.inf
    assert Belief(belief.world_from_part[:1], torch.zeros(1, dtype=torch.float64)).weight_entropy == 0.0
    with pytest.raises(InputError, match="give a whole number, 1 or more"):
        belief.nearest_neighbour_entropy(0)

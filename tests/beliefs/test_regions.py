"""Quantiles and credible regions: cases by hand, coverage of fresh draws, and what must not change them."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import (
    Belief,
    average_point_distance,
    pose_deviation,
    rotation_angle,
    rotation_deviation,
    translation_deviation,
    translation_distance,
    weighted_quantiles,
)
from bcppl.errors import InputError
from bcppl.poses import Freedom, identity

POINTS = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0.5]], dtype=torch.float64)
MEASURES = [
    pose_deviation,
    translation_deviation,
    rotation_deviation,
    translation_distance,
    rotation_angle,
    average_point_distance(POINTS),
]
SPREAD = torch.tensor([3e-3, 1e-3, 2e-3, 0.05, 0.02, 0.1], dtype=torch.float64)
CENTER = poses.as_pose([0.1, -0.2, 0.3, 0.5, 0.5, -0.5, 0.5])


def column(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def gaussian(count: int, freedom: Freedom = poses.FREE, seed: int = 0) -> Belief:
    torch.manual_seed(seed)
    draws = torch.randn(count, freedom.dimension, dtype=torch.float64) * freedom.coordinates(SPREAD)
    log_weights = torch.randn(count, dtype=torch.float64)
    return Belief(poses.retract(CENTER, freedom.embed(draws)), log_weights, freedom)


def test_quantiles_by_hand() -> None:
    values, weights = column(4, 1, 3, 2), column(0.1, 0.4, 0.25, 0.25)
    # The weight is 0.4 up to 1, 0.65 up to 2, 0.9 up to 3.
    found = weighted_quantiles(values, weights, [0.0, 0.2, 0.4, 0.5, 0.65, 0.95, 1.0])
    torch.testing.assert_close(found, column(1, 1, 1.5, 2, 2.5, 4, 4))
    assert float(weighted_quantiles(values, weights, 0.9)) == 3.5
    torch.testing.assert_close(
        weighted_quantiles(-values, weights, [0.1, 0.35, 0.5]),
        -weighted_quantiles(values, weights, [0.9, 0.65, 0.5]),
    )
    assert float(weighted_quantiles(column(9, 1, 2), column(0, 0.5, 0.5), 1.0)) == 2.0, "no weight, no say"
    for count in (10, 1000):
        even = torch.arange(1, count + 1, dtype=torch.float64)
        exact = weighted_quantiles(even, torch.full((count,), 1 / count, dtype=torch.float64), [0.3, 0.7])
        torch.testing.assert_close(exact, column(0.3 * count + 0.5, 0.7 * count + 0.5))
    with pytest.raises(InputError, match="give numbers from 0 to 1"):
        weighted_quantiles(values, weights, 1.2)


def test_quantiles_of_a_belief_are_of_the_tangent_coordinates_and_0_where_held() -> None:
    freedom = Freedom("xy", "z")
    belief = gaussian(4000, freedom)
    found = belief.quantiles([0.025, 0.5, 0.975])
    assert found.shape == (3, 6) and belief.quantiles(0.5).shape == (6,)
    held = [2, 3, 4]
    assert float(found[:, held].abs().max()) == 0 and float(belief.covariance[held].abs().max()) == 0
    free = list(freedom.axes)
    expected = torch.tensor([[-1.96], [0.0], [1.96]], dtype=torch.float64) * SPREAD[free]
    assert float(((found[:, free] - expected) / SPREAD[free]).abs().max()) < 0.2


def test_regions_by_hand() -> None:
    # Nine equal shifts along x around 0: with an effective size of 9, mass 0.6 asks for 0.6 * 10 / 9 = 2/3.
    shifts = torch.zeros(9, 6, dtype=torch.float64)
    shifts[:, 0] = 0.001 * torch.arange(-4, 5, dtype=torch.float64)
    belief = Belief(
        poses.retract(identity(), shifts), torch.zeros(9, dtype=torch.float64), Freedom("x", "none")
    )
    region = belief.credible_region(0.6, translation_distance)
    assert region.radius == pytest.approx(0.003) and region.weight == pytest.approx(7 / 9)
    assert region.mass == 0.6
    inside = region.contains(poses.retract(identity(), column(0.0029, 0, 0, 0, 0, 0)))
    assert bool(inside) and not bool(
        region.contains(poses.retract(identity(), column(0.0031, 0, 0, 0, 0, 0)))
    )
    # Without the particle at 3: the others' mean is -3/8 and their mean square 51/8.
    others = belief.credible_region(0.6)
    left_out = (3 + 3 / 8) / math.sqrt(51 / 8 - 9 / 64)
    assert others.radius == pytest.approx(left_out)
    whole = others.distance(poses.retract(identity(), column(0.003, 0, 0, 0, 0, 0)))
    assert float(whole) == pytest.approx(3 / math.sqrt(60 / 9))
    # Nine draws cannot say what holds 19 in 20.
    assert belief.credible_region(0.95).radius == math.inf
    with pytest.raises(InputError, match="every rotation is held"):
        belief.credible_region(0.5, rotation_deviation)
    with pytest.raises(InputError, match="above 0 and below 1"):
        belief.credible_region(1.0)


def test_a_region_is_as_flat_as_its_particles() -> None:
    belief = gaussian(75, Freedom("xy", "z"))
    region = belief.credible_region(0.8)
    assert bool(region.contains(belief.mean))
    # The deviation reads the free axes; where the particles do not span one of them, leaving it is refused.
    flat = belief.world_from_part.clone()
    flat[:, 1] = float(belief.mean[1])
    region = Belief(flat, belief.log_weights, belief.freedom).credible_region(0.8)
    assert math.isfinite(region.radius) and 0.8 < region.weight < 1
    assert bool(region.contains(region.center))
    assert not bool(region.contains(poses.retract(region.center, column(0, 1e-6, 0, 0, 0, 0))))


@pytest.mark.long
@pytest.mark.parametrize("weighted", [False, True])
def test_regions_hold_a_fresh_draw_as_often_as_they_say(weighted: bool) -> None:
    torch.manual_seed(3)
    mix = torch.randn(6, 6, dtype=torch.float64) * SPREAD[:, None]
    shift = column(0.5, 0, 0, 0.5, 0, 0) * weighted
    replicates, naive = 200, 0
    measures = MEASURES if weighted else MEASURES[:1]
    held = torch.zeros(len(measures))
    for _ in range(replicates):
        draws = torch.randn(76, 6, dtype=torch.float64)
        draws[:75] += shift
        log_weights = 0.5 * ((draws[:75] - shift) ** 2).sum(1) - 0.5 * (draws[:75] ** 2).sum(1)
        particles = poses.retract(CENTER, draws @ mix.T)
        belief, truth = Belief(particles[:75], log_weights), particles[75]
        held += torch.tensor([float(belief.credible_region(0.9, m).contains(truth)) for m in measures])
        # The mutant: the particles' own Mahalanobis distances, each with its share in mean and covariance.
        distance = belief.credible_region(0.9).distance
        naive += bool(
            distance(truth) <= weighted_quantiles(distance(belief.world_from_part), belief.weights, 0.9)
        )
    error = math.sqrt(0.9 * 0.1 / replicates)
    assert float((held / replicates - 0.905).abs().max()) < 3.5 * error
    assert naive / replicates < 0.9 - 2 * error


def doubled(belief: Belief) -> Belief:
    opposite = belief.world_from_part * column(1, 1, 1, -1, -1, -1, -1)
    return Belief(torch.cat([belief.world_from_part, opposite]), belief.log_weights.repeat(2), belief.freedom)


def shuffled(belief: Belief) -> Belief:
    order = torch.randperm(len(belief))
    return Belief(belief.world_from_part[order], belief.log_weights[order] + 7.0, belief.freedom)


@pytest.mark.parametrize("change", [doubled, shuffled])
def test_copies_signs_order_and_scale_of_weights_change_nothing(change: Callable[[Belief], Belief]) -> None:
    belief = gaussian(60)
    other = change(belief)
    assert belief.distinct == other.distinct == 60
    assert float(poses.local(belief.mean, other.mean).norm()) < 1e-9
    torch.testing.assert_close(other.quantiles([0.1, 0.5]), belief.quantiles([0.1, 0.5]), atol=1e-10, rtol=0)
    for measure in MEASURES:
        one, two = belief.credible_region(0.8, measure), other.credible_region(0.8, measure)
        assert one.radius == pytest.approx(two.radius, rel=1e-7)
        assert one.weight == pytest.approx(two.weight)


def test_regions_move_with_the_world() -> None:
    belief = gaussian(60)
    motion = poses.as_pose([1.0, 2.0, -3.0, 0.1, -0.7, 0.7, 0.1])
    moved = Belief(poses.compose(motion, belief.world_from_part), belief.log_weights)
    for measure in MEASURES:
        one, two = belief.credible_region(0.7, measure), moved.credible_region(0.7, measure)
        assert one.radius == pytest.approx(two.radius, rel=1e-6)
        assert torch.equal(one.contains(belief.world_from_part), two.contains(moved.world_from_part))
        assert not bool(two.contains(belief.world_from_part).any())

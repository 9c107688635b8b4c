"""Modes of a belief: who belongs together, with what mass, whatever the sign, the order, the symmetry."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief, entropy_of_modes
from bcppl.errors import InputError
from bcppl.poses import Freedom, identity


def tangents(*rows: list[float]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def two_places() -> Belief:
    """Forty particles around each of two places 50 mm apart, turned by half a radian: 3 to 1."""
    torch.manual_seed(0)
    noise = torch.randn(80, 6, dtype=torch.float64) * tangents([0.001, 0.001, 0.001, 0.01, 0.01, 0.01])
    places = poses.retract(identity(), tangents([0, 0, 0, 0, 0, 0.2], [0.05, 0, 0, 0, 0, 0.7]))
    log_weights = torch.tensor([math.log(3.0), 0.0], dtype=torch.float64).repeat_interleave(40)
    return Belief(poses.retract(places.repeat_interleave(40, dim=0), noise), log_weights)


def test_two_places_are_two_modes_with_their_mass_mean_and_spread() -> None:
    belief = two_places()
    heavy, light = belief.modes()
    assert (heavy.mass, light.mass) == (pytest.approx(0.75), pytest.approx(0.25))
    for mode, part in ((heavy, slice(40)), (light, slice(40, 80))):
        own = Belief(belief.world_from_part[part], belief.log_weights[part])
        assert float(poses.local(mode.mean, own.mean).norm()) < 1e-9
        torch.testing.assert_close(mode.spread, own.spread, atol=1e-9, rtol=0)
    assert len(belief.modes(translation=0.1, rotation=1.0)) == 1
    assert len(belief.modes(translation=0.1, rotation=0.3)) == 2, "the turn alone parts them"
    assert len(belief.modes(translation=0.03, rotation=10.0)) == 2, "the shift alone parts them"


def test_a_chain_of_small_gaps_is_one_mode() -> None:
    steps = torch.zeros(11, 6, dtype=torch.float64)
    steps[:, 1] = 0.009 * torch.arange(11)
    particles = poses.retract(identity(), steps)
    even = torch.zeros(11, dtype=torch.float64)
    assert len(Belief(particles, even).modes(0.0091, 0.1)) == 1
    assert len(Belief(particles, even).modes(0.0089, 0.1)) == 11
    turns = poses.retract(identity(), torch.roll(steps, 4, dims=1))
    assert len(Belief(turns, even).modes(1.0, 0.0091)) == 1
    assert len(Belief(turns, even).modes(1.0, 0.0089)) == 11


def test_signs_copies_and_the_world_do_not_matter() -> None:
    belief = two_places()
    opposite = belief.world_from_part * tangents([1, 1, 1, -1, -1, -1, -1])
    motion = poses.as_pose([1.0, 2.0, -3.0, 0.1, -0.7, 0.7, 0.1])
    for other in (
        Belief(torch.cat([belief.world_from_part, opposite]), belief.log_weights.repeat(2)),
        Belief(poses.compose(motion, belief.world_from_part), belief.log_weights),
    ):
        for one, two in zip(belief.modes(), other.modes(), strict=True):
            assert one.mass == pytest.approx(two.mass)
            assert len(one.belief) == len(two.belief) == 40
            assert one.belief.gaussian_entropy == pytest.approx(two.belief.gaussian_entropy)
    # Half a turn apart either way round is near: the rotation vectors differ by almost 2 pi.
    around = poses.retract(
        identity(), tangents([0, 0, 0, 0, 0, math.pi - 0.01], [0, 0, 0, 0, 0, 0.01 - math.pi])
    )
    assert len(Belief(around, torch.zeros(2, dtype=torch.float64)).modes()) == 1


def test_symmetric_copies_are_one_mode_gathered_around_its_heaviest_particle() -> None:
    torch.manual_seed(1)
    quarter = poses.retract(identity(), math.pi / 2 * torch.arange(4)[:, None] * tangents([0, 0, 0, 0, 0, 1]))
    center = poses.as_pose([0.1, 0.2, 0.3, 0.5, -0.5, 0.5, 0.5])
    noise = torch.randn(60, 6, dtype=torch.float64) * tangents([0.001, 0.001, 0.001, 0.01, 0.01, 0.01])
    tight = poses.retract(center, noise)
    turned = poses.compose(tight, quarter[torch.arange(60) % 4])
    log_weights = torch.randn(60, dtype=torch.float64)
    belief = Belief(turned, log_weights)
    assert len(belief.modes()) == 4
    (mode,) = belief.modes(symmetries=quarter[1:])
    assert mode.mass == pytest.approx(1.0)
    # Gathered around a copy that may stand a quarter turn further: the part's axes change places.
    assert mode.belief.gaussian_entropy == pytest.approx(Belief(tight, log_weights).gaussian_entropy)
    torch.testing.assert_close(
        mode.spread.sort().values, Belief(tight, log_weights).spread.sort().values, atol=1e-7, rtol=0
    )
    # A turn on the left is a motion in the world, and no symmetry of the part.
    other_side = Belief(poses.compose(quarter[torch.arange(60) % 4], tight), log_weights)
    assert len(other_side.modes(symmetries=quarter[1:])) == 4


def test_the_entropy_of_modes_far_apart_is_that_of_the_mixture() -> None:
    belief = two_places()
    heavy, light = belief.modes()
    mixed = 0.75 * heavy.belief.gaussian_entropy + 0.25 * light.belief.gaussian_entropy
    masses = -0.75 * math.log(0.75) - 0.25 * math.log(0.25)
    assert entropy_of_modes([heavy, light]) == pytest.approx(mixed + masses)
    assert entropy_of_modes([heavy, light]) < belief.gaussian_entropy - 2.0, "one Gaussian is wider by far"


def test_held_axes_and_bad_scales() -> None:
    freedom = Freedom("xy", "z")
    particles = poses.retract(identity(), tangents([0, 0, 0, 0, 0, 0], [0.02, 0, 0, 0, 0, 0.5]))
    modes = Belief(particles, torch.zeros(2, dtype=torch.float64), freedom).modes()
    assert [mode.mass for mode in modes] == [0.5, 0.5] and modes[0].belief.freedom == freedom
    assert entropy_of_modes(modes) == -math.inf
    with pytest.raises(InputError, match=r"modes are to be .* apart; give a finite number above 0"):
        Belief(particles, torch.zeros(2, dtype=torch.float64)).modes(translation=0.0)

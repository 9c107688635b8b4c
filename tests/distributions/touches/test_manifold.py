"""The contact manifold's likelihood against normals by hand, finite differences, motions, and mutants."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal
from torch.special import log_ndtr

from bcppl import poses
from bcppl.distributions.manifold import FARTHEST, ContactManifold
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, box_peg
from bcppl.geometry.gap import Gap, PegGap

NOISE, SHARED, SINK, OUTLIER = 8e-5, 3e-5, 2e-5, 1e-3
LENGTH = 0.05
NAN = math.nan


class Ledge(NamedTuple):
    """The gap of a peg's origin over a part's plane z = 0, in closed form."""

    distance: Tensor
    normal: Tensor
    place: Tensor

    def gradient(self, world_from_part: Tensor) -> Tensor:
        return Gap(self.distance, self.place, self.normal).gradient(world_from_part)


def ledge(world_from_part: Tensor, world_from_peg: Tensor) -> Ledge:
    place = poses.compose(poses.inverse(world_from_part)[:, None], world_from_peg)[..., :3]
    normal = torch.zeros_like(place)
    normal[..., 2] = 1.0
    return Ledge(place[..., 2], normal, place)


def inside_out(world_from_part: Tensor, world_from_peg: Tensor) -> Ledge:
    """Mutant: distances of the wrong sign."""
    right = ledge(world_from_part, world_from_peg)
    return Ledge(-right.distance, -right.normal, right.place)


class Sunk(ContactManifold):
    """Mutant: a sink of the wrong sign."""

    def _of_contacts(self, distance: Tensor, touching: Tensor) -> Tensor:
        return super()._of_contacts(distance - 2.0 * self.sink, touching)


def window(heights: list[float], felt: list[float], seed: int = 0) -> Tensor:
    """Stamps (T, 8) at heights over the plane, here and there on it."""
    rng = np.random.default_rng(seed)
    rows = torch.zeros(len(heights), 8, dtype=torch.float64)
    rows[:, :2] = torch.from_numpy(rng.uniform(-0.03, 0.03, (len(heights), 2)))
    rows[:, 2], rows[:, 3], rows[:, 7] = torch.tensor(heights), 1.0, torch.tensor(felt)
    return rows


def around(count: int, seed: int = 0, shift: float = 1e-4, turn: float = 2e-3) -> Tensor:
    torch.manual_seed(seed)
    spread = torch.tensor([shift] * 3 + [turn] * 3, dtype=torch.float64)
    return poses.retract(poses.identity(count), spread * torch.randn(count, 6, dtype=torch.float64))


def manifold(gap: Any, pose: Tensor, stamps: int, kind: type[ContactManifold] = ContactManifold) -> Any:
    return kind(gap, pose, stamps, NOISE, SHARED, SINK, OUTLIER)


MIXED = window([0.0, -5e-5, 1e-4, -2e-5, 0.003, 2e-4, 1e-4, -1e-4], [1, 1, 1, 1, 0, 0, NAN, 0])


def test_it_is_a_normal_of_all_contacts_and_a_probability_of_each_free_stamp() -> None:
    pose = around(50)
    found = manifold(ledge, pose, 8).log_prob(MIXED)
    distance = ledge(pose, MIXED[:, :7]).distance
    covariance = NOISE**2 * torch.eye(4).double() + SHARED**2
    contacts = MultivariateNormal(torch.full((4,), -SINK).double(), covariance).log_prob(distance[:, :4])
    stray = torch.full_like(contacts, math.log(OUTLIER) - 4 * math.log(FARTHEST))
    expected = torch.logaddexp(contacts + math.log1p(-OUTLIER), stray)
    for k in (4, 5, 7):
        free = log_ndtr(distance[:, k] / math.hypot(NOISE, SHARED)).exp()
        expected = expected + torch.log((1 - OUTLIER) * free + OUTLIER)
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-7)
    assert float(found.std()) > 1.0


def test_one_stamp_integrates_to_one_over_the_range_of_an_outlier() -> None:
    """Over where a contact may be found, and, of a free stamp, with its complement."""
    heights = torch.linspace(-0.5 * FARTHEST, 0.5 * FARTHEST, 20_001, dtype=torch.float64)
    pose = poses.identity(len(heights))
    pose[:, 2] = heights
    mass = manifold(ledge, pose, 1).log_prob(window([0.0], [1.0])).exp().sum() * (heights[1] - heights[0])
    assert float(mass) == pytest.approx(1.0, abs=1e-4)
    above, below = (manifold(ledge, p, 1).log_prob(window([0.0], [0.0])).exp() for p in (pose, pose.flip(0)))
    torch.testing.assert_close(above + below, torch.full_like(above, 1 + OUTLIER))


def differences(site: Any, value: Tensor, pose: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """Slope (6,) and curvature (6, 6) of minus the log-likelihood at a pose (1, 7)."""

    def here(*axes: tuple[int, float]) -> Tensor:
        away = torch.zeros(1, 6, dtype=torch.float64)
        for axis, sign in axes:
            away[0, axis] += sign * step[axis]
        return -site(poses.retract(pose, away)).log_prob(value)[0]

    gradient = torch.stack([(here((k, 1.0)) - here((k, -1.0))) / (2 * step[k]) for k in range(6)])
    bend = torch.stack(
        [
            torch.stack(
                [
                    (
                        here((i, 1), (j, 1))
                        - here((i, 1), (j, -1))
                        - here((i, -1), (j, 1))
                        + here((i, -1), (j, -1))
                    )
                    / (4 * step[i] * step[j])
                    for j in range(6)
                ]
            )
            for i in range(6)
        ]
    )
    return gradient, bend


def test_quadratic_is_its_gradient_and_curvature_near_the_truth() -> None:
    step = torch.tensor([1e-7] * 3 + [3e-6] * 3, dtype=torch.float64)
    scale = torch.tensor([1e-4] * 3 + [3e-3] * 3, dtype=torch.float64)
    value = window([-5e-5, 1e-5, -3e-5, 0.0, 3e-4, 1e-4, 1e-4], [1, 1, 1, 1, 0, 0, NAN])
    for seed in range(4):
        pose = around(1, seed, 2e-5, 2e-4)
        approximation = manifold(ledge, pose, 7).quadratic(value)
        gradient, bend = differences(lambda p: manifold(ledge, p, 7), value, pose, step)
        size = float((gradient * scale).abs().max())
        # What is far off counts for a little less than it would: up to one part in sixteen per variance.
        assert float(((approximation.gradient[0] - gradient) * scale).abs().max()) < 0.12 * size
        information = approximation.information[0] * scale[:, None] * scale
        curved = bend * scale[:, None] * scale
        assert float((information - curved).abs().max()) < 0.2 * float(curved.abs().max())
        assert float(torch.linalg.eigvalsh(information).min()) > -1e-9


def test_a_step_of_gauss_and_newton_leads_to_the_truth() -> None:
    """Touches on the top, a side and the next with a square peg: six axes from a millimetre away."""
    gap = PegGap(block((0.06, 0.06, 0.025)), box_peg(0.016, LENGTH))
    places = [
        (-0.02, -0.02, 0),
        (0.02, -0.02, 0),
        (0, 0.02, 0),
        (0.038, -0.015, -0.012),
        (0.038, 0.015, -0.012),
    ]
    places.append((0.0, 0.038, -0.012))
    peg = poses.identity(6)
    peg[:, :3] = torch.tensor(places, dtype=torch.float64) + torch.tensor([0, 0, LENGTH - SINK]).double()
    peg[3:, 2] += SINK
    peg[3:5, 0] -= SINK
    peg[5, 1] -= SINK
    turn = poses.as_pose([0.4, 0.1, 0.2, 0.5, 0.5, -0.5, 0.5])
    value = torch.cat([poses.compose(turn, peg), torch.ones(6, 1).double()], dim=1)
    pose = poses.retract(turn, torch.tensor([[8e-4, -5e-4, 6e-4, 0.01, -0.008, 0.012]]).double())
    for blur in (0.001, 0.0003, 0.0, 0.0, 0.0, 0.0):
        noise, shared = math.hypot(NOISE, blur), math.hypot(SHARED, blur)
        approximation = ContactManifold(gap, pose, 6, noise, shared, SINK, OUTLIER).quadratic(value)
        ridge = torch.diag(torch.tensor([1e4] * 3 + [1e1] * 3).double())
        pose = poses.retract(
            pose, -torch.linalg.solve(approximation.information + ridge, approximation.gradient)
        )
    off = poses.local(turn, pose)[0]
    assert float(off[:3].norm()) < 1e-4 and float(off[3:].norm()) < 2e-3
    assert float(manifold(gap, pose, 6).residual(value).abs().max()) < 3e-5


def test_moving_all_changes_nothing_and_what_cannot_be_told_tells_nothing() -> None:
    pose, motion = around(20), poses.as_pose([0.3, -0.2, 0.5, 0.5, 0.5, -0.5, 0.5])
    moved = MIXED.clone()
    moved[:, :7] = poses.compose(motion, MIXED[:, :7])
    here, there = manifold(ledge, pose, 8), manifold(ledge, poses.compose(motion, pose), 8)
    torch.testing.assert_close(there.log_prob(moved), here.log_prob(MIXED), rtol=0.0, atol=1e-6)
    torch.testing.assert_close(
        there.residual(moved), here.residual(MIXED), rtol=0, atol=1e-12, equal_nan=True
    )
    silent = MIXED.clone()
    silent[:, 7] = NAN
    approximation = here.quadratic(silent)
    assert torch.equal(here.log_prob(silent), torch.zeros(20).double())
    assert not bool(approximation.gradient.any()) and not bool(approximation.information.any())
    shuffled = MIXED[torch.randperm(8)]
    torch.testing.assert_close(here.log_prob(shuffled), here.log_prob(MIXED))


def highest(gap: Any, kind: type[ContactManifold]) -> float:
    """The height of the plane that explains best that a peg pressed on the plane z = 0, and was above it."""
    value = window([-SINK + 0.2 * e for e in (5e-5, -5e-5, 2e-5, -2e-5)] + [1e-3, 2e-3], [1, 1, 1, 1, 0, 0])
    pose = poses.identity(2001)
    pose[:, 2] = torch.linspace(-0.003, 0.003, 2001)
    return float(pose[manifold(gap, pose, 6, kind).log_prob(value).argmax(), 2])


def test_the_plane_is_found_where_it_is_and_mutants_find_it_elsewhere() -> None:
    assert abs(highest(ledge, ContactManifold)) < 5e-6
    assert abs(highest(ledge, Sunk)) > 1.5 * SINK
    # Inside out the free stamps are deep in the part, whatever the height of the plane.
    free = window([1e-3, 2e-3], [0, 0])
    right, wrong = (manifold(gap, poses.identity(1), 2).log_prob(free) for gap in (ledge, inside_out))
    assert float(right) > -0.01 and float(wrong) < 2 * math.log(2 * OUTLIER)
    assert abs(highest(inside_out, ContactManifold)) > 1.5 * SINK


def test_a_draw_without_a_motion_is_refused_in_a_sentence() -> None:
    with pytest.raises(InputError, match="simulate the probe"):
        manifold(ledge, poses.identity(2), 3).sample()

"""Gaps and likelihoods of touches are continuous in the part's pose: no micrometre is worth a nat."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.episodes import Grasp, LinearErrors, Size
from bcppl.distributions.episodes.displaced import lines_at
from bcppl.distributions.episodes.regressed import Spread, regressed
from bcppl.geometry.gap import PegGap
from bcppl.models import look_and_touch
from bcppl.models.worlds.bench.parts import bench_part
from tests.test_contact_episodes import probed, values_of
from tests.test_linear_errors import rows_with_wrenches
from tests.test_manifold import ledge

STEPS = 4001
PLACES = torch.tensor([[0, 0, -0.003], [0.006, 0, 0], [0.012, 0.004, 0]]).double()  # m, in the hole's frame
TIP_FROM_PEG = torch.tensor([0, 0, 0.08, 1, 0, 0, 0], dtype=torch.float64)


def path(start: Tensor, seed: int, shift: float, turn: float) -> Tensor:
    """Poses (STEPS, 7) along a straight way of the tangent space at one."""
    generator = torch.Generator().manual_seed(seed)
    tangent = torch.randn(6, generator=generator, dtype=torch.float64)
    tangent = tangent * torch.tensor([shift] * 3 + [turn] * 3, dtype=torch.float64)
    way = torch.linspace(-1.0, 1.0, STEPS, dtype=torch.float64)[:, None] * tangent
    return poses.retract(start.expand(STEPS, 7), way)


@pytest.mark.parametrize("shape", ["hexagon 12 mm", "D 10 mm", "round tray"])
@pytest.mark.parametrize("seed", range(6))
def test_a_gap_changes_no_faster_than_the_peg_moves(shape: str, seed: int) -> None:
    """Past edges and corners, in contact, beside it and in penetration."""
    kind, generator = bench_part(shape), torch.Generator().manual_seed(seed)
    hole = torch.from_numpy(kind.part_from_hole)
    away = torch.cat([PLACES[seed % len(PLACES)], torch.zeros(3).double()])
    away = away + torch.tensor([1e-3] * 3 + [0.05] * 3) * torch.randn(6, generator=generator).double()
    tip = poses.compose(hole, poses.retract(poses.identity(1), away))
    pegs = poses.compose(path(tip, seed + 100, 2e-3, 0.03), TIP_FROM_PEG)
    distance = PegGap(kind.part, kind.peg(0.0005))(poses.identity(1), pegs).distance[0]
    moved = poses.local(pegs[:-1], pegs[1:])[0]
    most = float(moved[:3].norm() + 0.09 * moved[3:].norm())  # no point of the peg is farther from its tip
    assert float((distance[1:] - distance[:-1]).abs().max()) < 1.5 * most
    assert float(distance.min()) < 2e-3, "edges count"


def test_along_a_plane_the_regression_is_the_derivative() -> None:
    rows = rows_with_wrenches([1, 1, 1, 0], [0, 0, 1, -1], seed=3)
    pose = poses.retract(poses.identity(5), 1e-3 * torch.randn(5, 6, dtype=torch.float64))
    bench = LinearErrors((Grasp(1e-3, 1e-9, 1e-9, slips=0.0), Size(1e-4)))
    count = len(bench.means)
    mean = torch.randn(5, count, dtype=torch.float64)
    spread = Spread(mean, torch.eye(count, dtype=torch.float64).expand(5, -1, -1))
    fitted = regressed(ledge, pose, rows, bench, spread)
    exact = lines_at(ledge(pose, rows[:, :7]), pose, rows, bench)
    torch.testing.assert_close(fitted.distance, exact.distance, rtol=0.0, atol=1e-7)
    torch.testing.assert_close(fitted.slope[..., :3], exact.slope[..., :3], rtol=0.0, atol=1e-5)
    torch.testing.assert_close(fitted.gradient[..., :3], exact.gradient[..., :3], rtol=0.0, atol=1e-5)
    assert float(fitted.residual.abs().max()) < 1e-7


def test_what_a_regression_leaves_over_is_what_a_kink_adds_to_the_spread() -> None:
    """A gap of |z|: mean and variance of a normal's modulus, whichever corner it is that touches."""

    def kinked(part: Tensor, peg: Tensor) -> object:
        gaps = ledge(part, peg)
        return gaps._replace(distance=gaps.distance.abs())

    rows = rows_with_wrenches([1], [0], seed=3)
    rows[:, :7] = poses.identity(1)
    bench = LinearErrors((Grasp(1e-3, 1e-9, 1e-9, slips=0.0),))
    spread = Spread(torch.zeros(1, 6).double(), torch.eye(6, dtype=torch.float64)[None])
    lines = regressed(kinked, poses.identity(1), rows, bench, spread)  # type: ignore[arg-type]
    assert float(lines.distance) == pytest.approx(0.798e-3, rel=0.2)
    assert float(lines.slope[..., :3].norm()) < 1e-6, "as often of one sign as of the other"
    assert 0.1e-6 < float(lines.residual.square().sum()) < 0.4e-6, "the variance of a normal's modulus is .36"


@pytest.mark.parametrize("seed", range(4))
def test_no_micrometre_is_worth_a_nat(seed: int) -> None:
    """Of a peg whose turn in the hand is not known, flat on a face: the corner that touches changes."""
    model = replace(look_and_touch.model, prepare=lambda r: look_and_touch.prepare(r, profile="ur5e"))
    sensor, values = values_of(probed(100), model)
    pose = path(poses.identity(1), seed, 1e-4, 5e-3)[::10]
    total = torch.stack([sensor.site(a, pose).log_prob(v) for a, v in values]).sum(dim=0)
    # 401 poses over .2 mm and .6 degrees in all: the slope alone gives a hundredth of a nat and more.
    bend = (total[1:-1] - 0.5 * (total[:-2] + total[2:])).abs()
    assert float(bend.max()) < 0.3

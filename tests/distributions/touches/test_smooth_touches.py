"""Gaps and likelihoods of touches are continuous in the part's pose: no micrometre is worth a nat."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from bcppl import poses
from bcppl.distributions.episodes import ContactEpisodes, Grasp, LinearErrors, Size
from bcppl.distributions.episodes.displaced import lines_at
from bcppl.distributions.episodes.filter.branches import begun
from bcppl.distributions.episodes.filter.row_errors import RowErrors
from bcppl.distributions.episodes.regressed import Spread, regressed
from bcppl.distributions.episodes.rows import EARLIER, FORCE
from bcppl.geometry.extrusion import block, box_peg
from bcppl.geometry.gap import PegGap
from bcppl.models import look_and_touch
from bcppl.models.worlds.bench.parts import bench_part
from tests.distributions.touches.episode_errors import factors
from tests.distributions.touches.test_linear_errors import ONE, OUTLIER, rows_with_wrenches
from tests.distributions.touches.test_manifold import ledge
from tests.sensors.test_probe_rows import probed, values_of

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


@pytest.mark.long
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


def test_away_from_kinks_the_regression_is_the_derivative_by_all_six() -> None:
    """Of a tilted peg, one corner of which touches the top; turns are about the peg's axes and the part's."""
    gap, pose = PegGap(block((0.06, 0.06, 0.025)), box_peg(0.016, 0.05)), poses.identity(3)
    pose = poses.retract(pose, torch.tensor([0.0, 0.0, 0.0, 0.01, -0.02, 0.3]).double())
    rows = rows_with_wrenches([1, 1], [0, 1], seed=3)
    tilt = torch.tensor([[0.0, 0.0, 0.05, 0.15, 0.1, 0.4], [0.005, -0.003, 0.05, -0.1, 0.15, -0.2]]).double()
    rows[:, :7] = poses.retract(poses.identity(2), tilt)
    bench = LinearErrors((Grasp(1e-6, 1e-6, 1e-6, slips=0.0),))
    none = Spread(torch.zeros(3, 6).double(), torch.zeros(3, 6, 6).double())
    fitted = regressed(gap, pose, rows, bench, none)
    exact = lines_at(gap(pose, rows[:, :7]), pose, rows, bench)
    torch.testing.assert_close(fitted.slope, exact.slope, rtol=0.0, atol=2e-5)
    torch.testing.assert_close(fitted.gradient, exact.gradient, rtol=0.0, atol=2e-5)
    assert float(exact.slope[..., 3:].abs().amax(dim=(0, 1)).min()) > 3e-4, "turns about all axes matter"


def test_a_square_peg_that_is_turned_in_the_hand_touches_with_another_corner() -> None:
    """Pressed at a side, measured as if its other corner touched: evidence by quadrature over the turn."""
    gap, pose = PegGap(block((0.06, 0.06, 0.025)), box_peg(0.016, 0.05)), poses.identity(1)
    yaw = Grasp(1e-9, 1e-9, math.radians(1.0), slips=0.0)
    rows = rows_with_wrenches([1] * 8, [0, 0, 1, 1, 2, 2, 3, 3], seed=4)
    rows[:, EARLIER], rows[:, 10] = 0.0, torch.tensor([0.1, 0.15, 0.6, 0.65, 1.1, 1.15, 1.6, 1.65])
    measured = torch.tensor([-0.8, -0.8, -0.4, -0.4, 0.4, 0.4, 1.0, 1.0]).double().deg2rad()
    at = torch.tensor([0.03, 0.0, 0.03, 1.0, 0, 0, 0], dtype=torch.float64).expand(8, 7)

    def turned(angle: Tensor) -> Tensor:
        zero = torch.zeros(len(angle), 5, dtype=torch.float64)
        return poses.compose(at, poses.retract(poses.identity(8), torch.cat([zero, angle[:, None]], dim=1)))

    true = turned(measured + math.radians(1.6))
    true[:, 0] += 0.02
    away = gap(pose, true).distance[0] + 5e-6 * rows[:, FORCE]
    rows[:, :7] = turned(measured)
    rows[:, 0] += 0.02 - away
    nodes = torch.linspace(-5.0, 5.0, 801, dtype=torch.float64)
    factor = factors(rows, RowErrors(0.0, 1e-5, 2e-5, 0.1, 0.6, 0.2), ONE[0])
    each = []
    for node in nodes:
        then = turned(measured + node * yaw.yaw)
        then[:, 0] = rows[:, 0]
        error = gap(pose, then).distance[0] + 5e-6 * rows[:, FORCE]
        blocks, pairs = factor.view(4, 2, 2), error.view(4, 2)
        each.append(MultivariateNormal(torch.zeros(2).double(), scale_tril=blocks).log_prob(pairs).sum())
    prior = -0.5 * nodes**2 - 0.5 * math.log(2.0 * math.pi) + math.log(float(nodes[1] - nodes[0]))
    exact = float(torch.logsumexp(torch.stack(each) + prior, dim=0))
    one = ContactEpisodes(gap, pose, 8, 6e-5, 1e-5, 2e-5, OUTLIER, bench=LinearErrors((yaw,)), hypotheses=ONE)
    # What lines leave over of a kink widens the errors, of the first four rows most.
    assert exact - 2.5 < float(one.log_prob(rows)[0]) < exact + 0.2
    (errors,) = one.shared_moments(rows).values()
    assert float(errors[0][0, 5]) == pytest.approx(1.6, abs=3.0 * float(errors[1][0, 5].sqrt()))
    none = Spread(torch.zeros(1, 6).double(), torch.zeros(1, 6, 6).double())
    about_none = one._filtered(begun(one._prior(0), 1), one._prior(0), rows, none)
    assert float(about_none.log_evidence[0]) < exact - 3.0, "linear about no turn"


@pytest.mark.long
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

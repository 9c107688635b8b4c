"""Gains about the pose as seen from a held peg: closed forms, finite differences, the belief's own draws."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pyro
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.distributions.episodes import ContactEpisodes, Grasp, KinematicError, LinearErrors, Size
from bcppl.distributions.episodes.displaced import by_shared_errors, lines_at
from bcppl.distributions.episodes.nuisances import ArmCompliance
from bcppl.distributions.episodes.rows import FELT, WRENCH
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.manifold import Quadratic
from bcppl.distributions.poses import MixturePose, NormalPose
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, box_peg
from bcppl.geometry.gap import PegGap
from bcppl.inference import importance_sampling
from bcppl.inference.design import linearised_information_gain
from bcppl.inference.design.relative_mixture import HeldPeg, RelativeMixture
from bcppl.inference.design.tangent_mixture import TangentMixture
from bcppl.inference.planning.candidate_layout import plan_candidates
from bcppl.inference.planning.metrology_parameters import ROCKED
from bcppl.inference.planning.motions import expected_contacts
from bcppl.inference.planning.touching import SurfacePoint, touch
from bcppl.inference.population import Population
from bcppl.inference.repetitions import Repeated
from bcppl.models import load_recording, look_and_touch
from bcppl.poses import FREE
from bcppl.robot.motion import ProbeWindow
from tests.distributions.touches.test_linear_errors import MIXED, rows_with_wrenches, site
from tests.distributions.touches.test_manifold import around

GRASP = Grasp(1e-3, 1e-9, 1e-9, slips=0.0)  # of 1 mm along each of the peg's axes
AT = torch.tensor([0.0, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
NOISE = 1e-4  # m


class Height(LazyDistribution):
    """The part's height, seen from the peg, with noise."""

    def __init__(self, pose: Tensor) -> None:
        self.pose = pose
        super().__init__(len(pose), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return -0.5 * ((value - self.pose[:, 2]) / NOISE) ** 2

    def sample(self, sample_shape: object = None) -> Tensor:
        return self.pose[:, 2] + NOISE * torch.randn(len(self.pose), dtype=torch.float64)

    def quadratic(self, value: Tensor) -> Quadratic:
        row = torch.eye(6, dtype=torch.float64)[2].expand(len(self.pose), 6) / NOISE
        return Quadratic(row * ((self.pose[:, 2] - value) / NOISE)[:, None], row[..., None] * row[:, None])

    # A peg that sits 1 mm higher in the hand sees the part 1 mm lower.
    def with_shared_errors(self, value: Tensor, errors: Tensor) -> Tensor:
        return value - 1e-3 * errors[:, 2]

    def joint_log_prob(self, value: Tensor, errors: Tensor) -> Tensor:
        return self.log_prob(value + 1e-3 * errors[:, 2])

    def joint_quadratic(self, value: Tensor, errors: Tensor) -> Quadratic:
        row = torch.zeros(len(self.pose), 12, dtype=torch.float64)
        row[:, 2], row[:, 8] = 1.0 / NOISE, -1e-3 / NOISE
        off = (self.pose[:, 2] - 1e-3 * errors[:, 2] - value) / NOISE
        return Quadratic(row * off[:, None], row[..., None] * row[:, None])


def heights(count: int) -> None:
    part = pyro.sample("part", NormalPose(poses.identity(), [1e-3] * 3 + [1e-2] * 3))
    for k in range(count):
        pyro.sample(f"height_{k}", Height(part))


@pytest.mark.long
def test_a_touch_informs_the_relative_pose_and_hardly_that_in_the_world() -> None:
    """Part and grasp are each 1 mm unsure along z: a sharp touch leaves 1/sqrt(2) mm in the world."""
    torch.manual_seed(0)
    population = importance_sampling(heights, (0,), {}, 4000)
    asked = {"perfect": None, "world": HeldPeg(LinearErrors((GRASP,)))}
    asked["relative"] = HeldPeg(LinearErrors((GRASP,)), lambda part: AT)
    found = {
        name: linearised_information_gain(
            population, [1], lambda count: (count,), outer_samples=8, peg=peg, seed=0, translation=1.0
        ).best
        for name, peg in asked.items()
    }
    exact = {
        "perfect": 0.5 * math.log1p(1e-6 / NOISE**2),
        "world": -0.5 * math.log(1.0 - 1e-6 / (2e-6 + NOISE**2)),
        "relative": 0.5 * math.log1p(2e-6 / NOISE**2),
    }
    for name, gain in exact.items():
        assert found[name].information_gain == pytest.approx(gain, abs=0.06), name
    # Three axes are twice as wide in variance as seen from the peg.
    wider = (found["relative"].entropy + exact["relative"]) - (found["world"].entropy + exact["world"])
    assert wider == pytest.approx(1.5 * math.log(2.0), abs=0.02)


def of_two_heights(apart: float, count: int) -> None:
    """A part at one of two places, whose tops differ in height by so many metres."""
    centers = poses.identity(2)
    centers[1, 0], centers[1, 2] = 0.03, apart
    spread = torch.diag(torch.tensor([1e-4] * 3 + [1e-3] * 3, dtype=torch.float64) ** 2).expand(2, 6, 6)
    part = pyro.sample("part", MixturePose(torch.full((2,), math.log(0.5)).double(), centers, spread, FREE))
    for k in range(count):
        pyro.sample(f"height_{k}", Height(part))


@pytest.mark.parametrize("apart", [8e-4, 3e-3])
def test_modes_that_the_grasp_can_explain_are_not_told_apart(apart: float) -> None:
    """A height that is off by the difference of the modes may as well be the peg's in the hand."""
    program = partial(of_two_heights, apart)
    torch.manual_seed(0)
    population = importance_sampling(program, (0,), {}, 1000)
    peg = HeldPeg(LinearErrors((GRASP,)))
    gain = linearised_information_gain(population, [1], lambda count: (count,), peg=peg, seed=0).best
    variance = 1e-6 + 1e-8 + NOISE**2
    read = np.random.default_rng(0).normal(0.0, math.sqrt(variance), 100_000)
    odds = np.exp(apart * (read - 0.5 * apart) / variance)  # of the other mode
    which = math.log(2.0) - float(np.mean(np.log1p(odds) - odds * np.log(odds) / (1.0 + odds)))
    within = -0.5 * math.log(1.0 - 1e-8 / variance)
    assert gain.information_gain == pytest.approx(which + within, abs=0.02)


@pytest.mark.long
def test_the_gaussian_is_that_of_the_belief_s_own_draws() -> None:
    """After presses along z, which make part and grasp depend on one another."""
    rows = MIXED[MIXED[:, FELT] == 1.0].clone()

    def pressed() -> None:
        part = pyro.sample("part", NormalPose(poses.identity(), [1e-3] * 3 + [2e-3] * 3))
        pyro.sample("touch", site(part, rows, Grasp(slips=0.0), Size()))

    torch.manual_seed(0)
    population = importance_sampling(pressed, (), {"touch": rows}, 4000)
    pose = TangentMixture.fit(population, "part", translation=1.0, rotation=10.0)
    peg = HeldPeg(LinearErrors((Grasp(slips=0.0), Size())), lambda part: AT)
    relative = RelativeMixture.fit(population, "part", pose, peg)
    drawn = population.belief("part").relative(AT, 16).covariance
    world = population.belief("part").covariance
    logs = [0.5 * float(torch.linalg.slogdet(each).logabsdet) for each in (drawn, world)]
    assert float(relative.log_volume[0]) == pytest.approx(logs[0], abs=0.1)
    alone = RelativeMixture.fit(population, "part", pose, peg._replace(inserted=None))
    assert float(alone.log_volume[0]) == pytest.approx(logs[1], abs=0.02)


def test_predicted_touches_are_moved_by_shared_errors_as_measured_ones_are() -> None:
    gap, pose = PegGap(block((0.06, 0.06, 0.025)), box_peg(0.016, 0.05)), around(3, 3, 1e-3, 0.03)
    rows = rows_with_wrenches([1, 1, 1, 1], [0, 0, 1, 1], seed=4)
    rows[:, :3] = torch.tensor(
        [[0.0, 0.01, 0.0502], [0.01, 0.0, 0.0505], [0.0382, 0.0, 0.03], [0, -0.0384, 0.03]]
    )
    errors = LinearErrors((Grasp(slips=0.0), ArmCompliance(), KinematicError(), Size(0.001)))
    one = ContactEpisodes(gap, pose, 4, 6e-5, 1e-5, 2e-5, bench=errors)
    # Free errors first, which do not depend on the wrench: their twist is the contact's.
    grasp = LinearErrors((Grasp(1.0, 1.0, 1.0, slips=0.0),))
    wrench_of = ContactEpisodes(gap, pose, 4, 6e-5, 1e-5, 2e-5, bench=grasp)
    slope = lines_at(gap(pose, rows[:, :7]), pose, rows, wrench_of.bench).columns
    force = torch.full((len(pose), 4), 4.0, dtype=torch.float64)
    stood = rows[:, :7].expand(len(pose), 4, 7)
    found = by_shared_errors(gap(pose, stood), pose, stood, force, errors)
    for k in range(len(pose)):
        pressed = rows.clone()
        pressed[:, WRENCH] = 4.0 * slope[k, 0]
        columns = lines_at(gap(pose, rows[:, :7]), pose, pressed, one.bench).columns
        torch.testing.assert_close(found[k], columns[k, 0], rtol=1e-9, atol=1e-15)
        # Pressed onto the part, an arm that yields makes the gap larger than it was measured to be.
        assert bool((found[k, :, 6:12] >= 0.0).all())
    # Measured under errors and explained by them, the gaps are those that were predicted.
    value = torch.cat([stood, rows[:, FELT, None].expand(len(pose), 4, 1)], dim=-1)
    drawn = 0.01 * torch.randn(len(pose), len(errors.means), dtype=torch.float64)
    measured = replace(one, sink=4.0 * one.compliance).with_shared_errors(value, drawn)
    again = replace(one, sink=4.0 * one.compliance)._moved(measured, drawn)[0]
    # Across an edge the gap is linear but for the turn, of which the errors here are a milliradian.
    torch.testing.assert_close(again, gap(pose, stood).distance, rtol=0.0, atol=2e-6)
    assert float((gap(pose, measured[..., :7]).distance - again).abs().max()) > 1e-6


def test_a_leaning_touch_meets_the_point_that_an_upright_one_meets() -> None:
    part, peg = block((0.06, 0.06, 0.025)), box_peg(0.016, 0.05)
    belief, gap = Belief(poses.identity(4), torch.zeros(4)), PegGap(part, peg)
    side = SurfacePoint(np.array([part.vertices[:, 0].max(), 0.0, 0.0]), np.array([1.0, 0.0, 0.0]))
    lean = np.array([0.0, ROCKED.lean, ROCKED.turn])
    upright, leaning = (touch(belief, part, peg, side, lean=each) for each in (0.0 * lean, lean))
    turned = poses.local(torch.from_numpy(upright.world_from_peg), torch.from_numpy(leaning.world_from_peg))
    torch.testing.assert_close(turned[:, 3:], torch.from_numpy(lean).expand(len(turned), 3))
    for plan in (upright, leaning):
        ((contact, _),) = expected_contacts(plan)
        assert abs(float(gap(belief.mean[None], torch.from_numpy(contact)[None]).distance)) < 2e-5
    with pytest.raises(InputError, match="leans towards the side at 0°"):
        touch(belief, part, peg, side, lean=-lean)


def test_leaning_candidates_keep_their_tips_above_the_part_s_base() -> None:
    """A peg of twice the part's height, whose upper end would take its tip below the table."""
    part, peg = block((0.06, 0.06, 0.03)), box_peg(0.012, 0.08)
    torch.manual_seed(0)
    tangent = torch.randn(50, 6, dtype=torch.float64) * torch.tensor([2e-3] * 3 + [2e-2] * 3)
    belief = Belief(poses.retract(poses.identity(50), tangent), torch.zeros(50))
    base, corners = float(part.vertices[:, 2].min()), torch.from_numpy(peg.vertices)
    planned = plan_candidates(belief, part, peg, {"lean": 24}, seed=1)
    assert sum("side" in plan.name for plan in planned) >= 10
    for plan in planned:
        lowest = float(poses.transform(torch.from_numpy(plan.world_from_peg), corners)[..., 2].min())
        assert lowest > base - 1e-3, plan.name


def test_before_any_touch_the_prior_is_that_of_the_hypotheses() -> None:
    """A row far away from the part tells nothing: it must not change the errors' covariance."""
    recording = load_recording("peg_probe")
    probe = look_and_touch.prepare(recording, profile="ur5e").likelihoods["window"]
    window = next(m.action for m in recording.measurements if isinstance(m.action, ProbeWindow))
    far = MIXED[:1].clone()
    far[:, FELT], far[:, 2] = 0.0, 5.0
    mean, covariance = probe.site(window, poses.identity(1)).shared_posterior(far)
    prior_mean, prior = probe.shared_prior
    torch.testing.assert_close(mean[0], prior_mean, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(covariance[0], prior, rtol=1e-6, atol=1e-9)
    assert float(prior.diagonal().max()) > 2.0, "hypotheses of a worse bench widen it"


def grasped() -> Population:
    """A peg 0.8 mm too high in the hand, known from presses on a part whose place is known."""
    rows = MIXED[MIXED[:, FELT] == 1.0].clone()
    rows[:, 2] += 8e-4

    def pressed() -> None:
        part = pyro.sample("part", NormalPose(poses.identity(), [2e-4] * 3 + [1e-3] * 3))
        pyro.sample("touch", site(part, rows, Grasp(slips=0.0)))

    torch.manual_seed(0)
    return importance_sampling(pressed, (), {"touch": rows}, 1500)


def test_what_is_made_of_a_belief_knows_how_the_peg_is_held() -> None:
    """Copies merged, a mode, a moved belief, several runs: each has the relative pose, not the world's."""
    population = grasped()
    belief = population.belief("part")
    expected = belief.relative(AT).mean
    assert abs(float(expected[2]) - float(belief.mean[2])) > 5e-4
    (mode,) = belief.modes(0.05, 2.0)
    for one in (belief.merged, mode.belief):
        torch.testing.assert_close(one.relative(AT).mean, expected, rtol=0.0, atol=1e-6)
    several = Repeated((population, population), (0, 1)).belief("part")
    torch.testing.assert_close(several.relative(AT).mean, expected, rtol=0.0, atol=1e-6)
    shift = poses.identity()
    shift[:3] = torch.tensor([2e-3, -1e-3, 3e-3])
    moved = belief.moved(poses.compose(shift, belief.world_from_part))
    off = moved.relative(AT).mean[:3] - expected[:3] - shift[:3]
    assert float(off.abs().max()) < 1e-4

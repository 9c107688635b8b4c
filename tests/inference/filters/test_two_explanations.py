"""A touch that either of two ridges explains: the belief has both modes, weighted by their evidence."""

from __future__ import annotations

import functools
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor
from torch.distributions import MultivariateNormal

from bcppl import poses
from bcppl.contact.touch import Touch
from bcppl.distributions.pose_normals import GaussianMixture, matched, widened, widened_mixture
from bcppl.distributions.poses import UniformPose
from bcppl.geometry.extrusion import box_peg
from bcppl.geometry.parts import Guess, Part
from bcppl.inference.approximations.gaussian import GaussianApproximation
from bcppl.inference.approximations.laplace import (
    Normal,
    QuadraticApproximation,
    Search,
    quadratic_approximation,
)
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.proposals.approximated import component_transitions
from bcppl.models import look_and_touch
from bcppl.recordings import problems
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors.capabilities import Approximated
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.scene import Scene
from tests.inference.filters.checked_pairs import run_checked

MODEL = look_and_touch.model.with_settings(profile="perfect")
APART, THICK, HIGH, WIDE = 0.012, 0.004, 0.01, 0.004  # m: of the ridges, and of the peg
LENGTH, DEEP = 0.05, 0.006  # m: the peg, and how far below the ridges' tops its tip is
TOUCHED, SPEED = 0.3, 0.007  # s from which the peg, moving along x at so many m/s, is held up
# Where the middle of the part is if the inner side of one ridge was touched, or the outer side of the other.
INNER, OUTER = -0.5 * (APART - THICK - WIDE), 0.5 * (APART + THICK + WIDE)


def ridges() -> Part:
    walls = [
        trimesh.creation.box((THICK, 0.06, HIGH), trimesh.transformations.translation_matrix([x, 0.0, 0.0]))
        for x in (-0.5 * APART, 0.5 * APART)
    ]
    mesh = trimesh.util.concatenate(walls)
    return Part("two ridges", np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces))


@functools.cache
def touched() -> Recording:
    """The peg moves by 2 mm along x, to where its middle is at x = 0, and is held up there."""
    stamps = np.arange(0.0, 0.7, 0.01)
    x = np.minimum(0.0, SPEED * (stamps - TOUCHED))
    command = np.zeros((len(stamps), 7))
    command[:, 0], command[:, 2], command[:, 3] = SPEED * (stamps - TOUCHED), LENGTH - DEEP + 0.5 * HIGH, 1.0
    stood = command.copy()
    stood[:, 0] = x
    wrench = np.zeros((len(stamps), 6))
    wrench[stamps > TOUCHED, 0] = -4.0
    probe = Probe("across", stamps, command, np.full(6, 2000.0), np.full(6, 50.0), stamps)
    action = ProbeWindow(probe, 0, len(stamps))
    guess = Guess(
        np.array([0.5 * (INNER + OUTER), 0, 0, 1, 0, 0, 0]), np.array([0.011, 0.003, 1e-4]), 0.002, 0.01
    )
    seen = Measurement(action, Touch(stamps, wrench, stood))
    return Recording(ridges(), guess, [seen], peg=box_peg(WIDE, LENGTH))


def shares(world_from_part: Tensor, weights: Tensor) -> tuple[float, float]:
    """Of the two explanations; what is left is neither."""
    x = world_from_part[:, 0]
    near = [(x - middle).abs() < 0.0005 for middle in (INNER, OUTER)]
    return float(weights[near[0]].sum()), float(weights[near[1]].sum())


def window_of(recording: Recording) -> tuple[Any, Approximated]:
    """The likelihood of touches, and the window with its observed value."""
    scene = MODEL.prepare(recording)
    value = scene.observed(recording.measurements)["touch_0"]
    return scene.likelihoods["window"], Approximated(0, recording.measurements[0].action, value)


def approximated(
    everywhere: bool, before: GaussianMixture | None = None, nearby: bool = False
) -> tuple[Normal, QuadraticApproximation]:
    recording = touched()
    sensor, window = window_of(recording)
    spread = torch.tensor([0.006, 0.002, 1e-4, 0.001, 0.001, 0.005], dtype=torch.float64)
    center = torch.from_numpy(recording.guess.world_from_part)[None]
    prior = Normal(center, torch.diag(spread**-2)[None])
    sites, heading = partial(sensor.sites, [window]), sensor.heading([window])
    return prior, quadratic_approximation(sites, prior, before, Search(heading, everywhere), nearby=nearby)


def test_the_world_is_sound_and_both_places_explain_the_touch_alike() -> None:
    assert not [p for p in problems(touched()) if "tared" not in p]
    sensor, (_, action, value) = window_of(touched())
    assert set(value[:, 7][~torch.isnan(value[:, 7])].tolist()) == {0.0, 1.0}
    part = poses.identity(4)
    part[:, 0] = torch.tensor([INNER, OUTER, 0.5 * (INNER + OUTER), OUTER + 0.002])
    log_prob = sensor.site(action, part).log_prob(value)
    assert float(log_prob[0]) == pytest.approx(float(log_prob[1]), abs=1e-4)
    assert float(log_prob[:2].min() - log_prob[2:].max()) > 20.0


def test_a_search_everywhere_reaches_both_modes_with_equal_weights_and_keeps_them() -> None:
    prior, one = approximated(False)
    assert len(one.around) == 1, "errors of millimetres lead all starts to one of them"
    _, both = approximated(True)
    modes = both.posterior(prior.center[0], prior.precision[0])
    assert sorted(round(1e3 * float(x), 1) for x in modes.centers[:, 0]) == [1e3 * INNER, 1e3 * OUTER]
    # They guide proposals; each is that of a mixture over the contacts' compliance, by its two moments.
    assert float((modes.log_weights[0] - modes.log_weights[1]).abs()) < 0.5
    _, again = approximated(False, modes)
    assert len(again.around) == 2


def test_modes_nearby_are_followed_and_those_that_explain_nothing_are_searched_for_again() -> None:
    prior, both = approximated(True)
    modes = both.posterior(prior.center[0], prior.precision[0])
    off = torch.tensor([2e-4, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    for k in range(2):
        beside = modes._replace(centers=poses.retract(modes.centers, off))
        one = GaussianMixture(*(values[k : k + 1] for values in beside))
        _, followed = approximated(False, one, nearby=True)
        torch.testing.assert_close(followed.around, both.around[k : k + 1], rtol=0.0, atol=1e-5)
    far = poses.retract(modes.centers[:1], 100.0 * off)
    lost = GaussianMixture(far, modes.covariances[:1], modes.log_weights[:1])
    _, again = approximated(False, lost, nearby=True)
    _, searched = approximated(False, lost)
    torch.testing.assert_close(again.around, searched.around)


def test_a_mode_weighs_what_a_normal_observation_is_worth() -> None:
    torch.manual_seed(0)
    rows, noise = torch.randn(9, 6, dtype=torch.float64), 0.3
    spread = torch.rand(6, dtype=torch.float64) + 0.5
    off = torch.cat([0.2 * torch.randn(3), torch.zeros(3)]).double()
    seen = torch.randn(9, dtype=torch.float64)
    information, zero = rows.T @ rows / noise**2, torch.zeros(9, dtype=torch.float64)
    log_prob = MultivariateNormal(zero, noise**2 * torch.eye(9).double()).log_prob(seen)
    gradient = -(rows.T @ seen / noise**2)
    quadratic = QuadraticApproximation(poses.identity(1), gradient[None], information[None], log_prob[None])
    posterior = quadratic.posterior(poses.retract(poses.identity(1), off)[0], torch.diag(spread**-2))
    whole = noise**2 * torch.eye(9).double() + rows @ torch.diag(spread**2) @ rows.T
    assert float(posterior.log_weights) == pytest.approx(
        float(MultivariateNormal(rows @ off, whole).log_prob(seen)), rel=1e-6
    )
    precision = torch.diag(spread**-2) + information
    expected = torch.linalg.solve(precision, off / spread**2 + rows.T @ seen / noise**2)
    torch.testing.assert_close(poses.log(poses.identity(1), posterior.centers)[0], expected)
    torch.testing.assert_close(posterior.covariances[0], torch.linalg.inv(precision))


def test_modes_widen_as_one_does_and_match_their_mean_and_covariance() -> None:
    torch.manual_seed(1)
    center = poses.retract(poses.identity(3), 0.1 * torch.randn(3, 6, dtype=torch.float64))
    root = torch.randn(6, 6, dtype=torch.float64)
    covariance = 1e-4 * (root @ root.T + torch.eye(6)).expand(3, 6, 6)
    twice = GaussianMixture(
        torch.stack([center, center], 1), torch.stack([covariance] * 2, 1), torch.tensor([1.0, -2.0]).double()
    )
    at = poses.retract(center, 0.01 * torch.randn(3, 6, dtype=torch.float64))
    one, other = widened(center, covariance), widened_mixture(twice)
    torch.testing.assert_close(one.log_prob(at), other.log_prob(at))
    torch.testing.assert_close(matched(one).covariance, matched(other).covariance)
    away = torch.tensor([0.01, 0, 0, 0, 0, 0], dtype=torch.float64)
    apart = GaussianMixture(
        torch.stack([center, poses.retract(center, away)], 1),
        twice.covariances,
        torch.tensor([0.0, 0.0]).double(),
    )
    middle = matched(widened_mixture(apart))
    torch.testing.assert_close(poses.local(center, middle.center), (0.5 * away).expand(3, 6))
    spread = middle.covariance - matched(one).covariance
    torch.testing.assert_close(spread, 0.25 * torch.outer(away, away).expand(3, 6, 6))


def test_a_proposal_is_wider_along_each_principal_axis_in_turn_and_in_all_directions() -> None:
    """In units of the Gaussian itself one axis alone is wider, another each time; millimetres and degrees."""
    generator = torch.Generator().manual_seed(2)
    root = torch.randn(6, 6, generator=generator, dtype=torch.float64) * torch.tensor([1e-4] * 3 + [5e-3] * 3)
    covariance = root.T @ root
    proposed = widened(poses.identity(), covariance)
    torch.testing.assert_close(proposed.log_weights.exp().sum(), torch.tensor(1.0).double())
    lower = torch.linalg.inv(torch.linalg.cholesky(covariance))
    ratios = [torch.linalg.eigh(lower @ each @ lower.T) for each in proposed.components.covariance]
    values = torch.stack([ratio.eigenvalues for ratio in ratios])
    torch.testing.assert_close(values[:2], torch.tensor([[1.21] * 6, [9.0] * 6], dtype=torch.float64))
    torch.testing.assert_close(values[2:], torch.tensor([[1.21] * 5 + [9.0]] * 6, dtype=torch.float64))
    axes = torch.stack([ratio.eigenvectors[:, -1] for ratio in ratios[2:]])
    torch.testing.assert_close((axes @ axes.T).abs(), torch.eye(6).double(), rtol=0.0, atol=1e-6)


def test_particles_mostly_stay_in_their_mode_and_may_go_to_any() -> None:
    centers = poses.identity(2)
    centers[1, 0] = 0.01
    spread = 1e-7 * torch.eye(6, dtype=torch.float64).expand(2, 6, 6)
    modes = GaussianMixture(centers, spread, torch.tensor([0.9, 0.1]).double().log())
    stay = component_transitions(modes, modes).exp()
    torch.testing.assert_close(stay, torch.tensor([[0.98, 0.02], [0.18, 0.82]]).double())
    wide = GaussianMixture(centers[:1], 1e-4 * torch.eye(6).double()[None], torch.zeros(1).double())
    torch.testing.assert_close(component_transitions(wide, modes).exp(), torch.tensor([[0.9, 0.1]]).double())
    torch.testing.assert_close(component_transitions(modes, wide).exp(), torch.ones(2, 1).double())
    assert modes.component(centers).tolist() == [0, 1]


def test_a_contact_is_new_where_the_peg_did_not_touch_before() -> None:
    sensor, (_, action, _) = window_of(touched())

    def windows(*flags: str) -> list[Approximated]:
        """Windows of one probe, a character for each 50 ms."""
        rows = torch.zeros(sum(map(len, flags)), 13, dtype=torch.float64)
        rows[:, 7] = torch.tensor([{"#": 1.0, ".": 0.0, "?": torch.nan}[each] for each in "".join(flags)])
        rows[:, 10] = 0.05 * torch.arange(len(rows))
        return [Approximated(0, action, value) for value in rows.split([len(each) for each in flags])]

    for newest, given, new in (
        (True, ["..?##"], True),
        (True, ["..###", "#####"], False),
        (False, ["..###", "#####"], True),
        (True, ["..###", "#?..#"], True),
        (True, ["...??", "##"], True),
        (False, ["....", "??"], False),
        (True, [], False),
    ):
        assert sensor.new_contact(windows(*given), newest) is new, (newest, given)


def test_the_contact_may_be_elsewhere_where_the_part_is_not_known_to_half_a_millimetre() -> None:
    for deviation, unsure in ((0.0004, False), (0.0008, True)):
        prior = UniformPose(poses.identity(), deviation / 0.6, 0.1)
        assert GaussianApproximation("part", Scene(prior, {}, "toy"))._is_unsure() is unsure


@pytest.mark.long
def test_the_belief_holds_both_alike() -> None:
    held = []
    for seed in range(6):
        *_, last = infer(MODEL, touched(), particles=75, seed=seed)
        held.append(shares(last.belief.world_from_part, last.belief.weights))
    inner, outer = np.array(held).T
    assert float(np.min(inner + outer)) > 0.9, held
    assert float(inner.min()) > 0.1 and float(inner.max()) < 0.9, held
    assert 0.35 < float(np.mean(inner / (inner + outer))) < 0.65, held


def test_the_backward_kernel_leads_back_from_both() -> None:
    *_, last = run_checked(MODEL, touched(), particles=20)
    assert np.isfinite(last.info.log_evidence)

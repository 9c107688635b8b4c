"""Errors that all touches share, integrated out: dense Gaussians, any cut, jumps, the peg's own view."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pyro
import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal
from torch.special import log_ndtr

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.cli.predictive_checks import change_sentence
from bcppl.distributions.episodes import (
    ArmCompliance,
    ContactEpisodes,
    Delay,
    Grasp,
    Hypothesis,
    KinematicError,
    LinearErrors,
    PartSlides,
    Size,
)
from bcppl.distributions.episodes.displaced import lines_at
from bcppl.distributions.episodes.filter.posterior import moments
from bcppl.distributions.episodes.filter.row_errors import RowErrors
from bcppl.distributions.episodes.rows import (
    EARLIER,
    FELT,
    FORCE,
    GIVEN,
    SECONDS,
    WRENCH,
    late,
    new_rows,
)
from bcppl.distributions.poses import NormalPose
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, box_peg
from bcppl.geometry.gap import PegGap
from bcppl.inference import importance_sampling
from bcppl.inference.criticism.nuisances import SuddenChange, shared_errors, sudden_changes
from bcppl.inference.filters.default import infer
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.metrology_parameters import ROCKED
from bcppl.models import look_and_touch
from bcppl.models.worlds.bench.errors import BenchErrors
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.robot.motion import ProbeWindow
from bcppl.sensors.likelihoods.bench_profiles import PROFILES, BenchProfile
from bcppl.sensors.likelihoods.contact_probe import TouchSettings
from bcppl.sensors.measurements import Measurement, Recording
from tests.distributions.touches.episode_errors import factors
from tests.distributions.touches.test_contact_episodes import MIXED
from tests.distributions.touches.test_manifold import around, ledge
from tests.made_recordings import assert_one_sentence
from tests.sensors.test_probe_rows import cut, probed, values_of

ONE = (Hypothesis(0.0, 5e-6),)
SHARED = (Grasp(slips=0.0), ArmCompliance(), KinematicError(center=(0.01, 0.0, 0.0)), Delay(), Size(0.001))
OUTLIER = 1e-9
ZERO = torch.zeros(4, dtype=torch.float64)


def site(
    pose: Tensor, rows: Tensor, *errors: Any, outlier: float = OUTLIER, **others: Any
) -> ContactEpisodes:
    given = {"hypotheses": ONE, "bench": LinearErrors(errors or SHARED), **others}
    return ContactEpisodes(ledge, pose, len(rows), 6e-5, 1e-5, 2e-5, outlier, **given)


def rows_with_wrenches(felt: list[float], episodes: list[int], seed: int = 0) -> Tensor:
    """As `MIXED`: turned pegs that come from elsewhere, and wrenches mostly along z."""
    rng = np.random.default_rng(seed)
    rows = MIXED[:1].repeat(len(felt), 1)
    rows[:, :7] = poses.retract(
        poses.identity(len(felt)), torch.from_numpy(rng.normal(size=(len(felt), 6)) * [0.03] * 6)
    )
    rows[:, 2] = torch.from_numpy(rng.normal(0.0, 3e-4, len(felt)))
    rows[:, FELT], rows[:, 11] = torch.tensor(felt), torch.tensor(episodes)
    rows[:, 8] = torch.from_numpy(rng.uniform(2e-5, 9e-5, len(felt)))
    rows[:, FORCE] = torch.from_numpy(rng.uniform(2.0, 12.0, len(felt)))
    rows[:, 10] = torch.from_numpy(np.cumsum(rng.uniform(0.02, 0.08, len(felt))))
    rows[:, WRENCH] = torch.from_numpy(rng.normal(size=(len(felt), 6)) * [1.0, 1.0, 4.0, 0.1, 0.1, 0.1])
    steps = rng.normal(0.0, 1.0, (len(felt), len(SECONDS), 6)) * ([2e-4] * 3 + [1e-3] * 3)
    rows[:, EARLIER] = torch.from_numpy(steps.cumsum(axis=1)).flatten(1)
    return rows


FIVE = rows_with_wrenches([1, 1, 1, 1, 1], [0, 0, 1, 1, 2])


def moved(peg: Tensor, twist: Tensor) -> Tensor:
    """Pegs (T, 7) displaced along their own axes and turned about them by twists (T, 6)."""
    along = (poses.rotation_matrix(peg) @ twist[:, :3, None])[..., 0]
    return poses.retract(peg, torch.cat([along, twist[:, 3:]], dim=1))


def measured_columns(gap: Any, pose: Tensor, rows: Tensor, errors: LinearErrors) -> Tensor:
    """The gap's changes (N, R, M) by each parameter, by finite differences of the gap itself."""
    effect = errors.effect(rows)
    columns = []
    for k in range(len(errors.means)):
        step = 1e-3
        apart = [
            gap(pose, moved(rows[:, :7], sign * step * effect.twist[..., k])).distance for sign in (1.0, -1.0)
        ]
        columns.append((apart[0] - apart[1]) / (2.0 * step) + effect.offset[:, k])
    return torch.stack(columns, dim=-1)


def dense(pose: Tensor, rows: Tensor, errors: LinearErrors, extra: Tensor | None = None) -> Tensor:
    """Log-density (N,) of all contact rows at once; `extra` (R, R, M): variances that rows share besides."""
    factor = factors(rows, RowErrors(0.0, 1e-5, 2e-5, 0.1, 0.6, 0.2), ONE[0])
    own = torch.zeros(len(rows), len(rows), dtype=torch.float64)
    for episode in rows[:, 11].unique():
        index = (rows[:, 11] == episode).nonzero()[:, 0]
        part = factor[index][:, : len(index)]
        own[index[:, None], index] = part @ part.T
    each = []
    for interval, probability in errors.delays.items():
        then, twist = late(rows, interval)
        columns = measured_columns(ledge, pose, then, errors)
        covariance = own + columns @ (errors.variances[:, None] * columns.transpose(-1, -2))
        if extra is not None:
            covariance = covariance + torch.einsum("nrm,nsm,rsm->nrs", columns, columns, extra)
        mean = -5e-6 * rows[:, FORCE] - columns @ errors.means
        gaps = ledge(pose, moved(rows[:, :7], twist)).distance
        each.append(MultivariateNormal(mean, covariance).log_prob(gaps) + math.log(probability))
    return torch.logsumexp(torch.stack(each), dim=0)


def test_errors_of_one_name_are_refused_and_a_list_is_a_bench() -> None:
    twice = [PartSlides(), Grasp(), PartSlides(shift=0.002)]
    for make in (LinearErrors, lambda given: TouchSettings(bench=given)):
        with pytest.raises(InputError, match=r"2 errors with the name \"the part's place") as caught:
            make(twice)
        assert_one_sentence(str(caught.value))
    assert hash(TouchSettings(bench=[Grasp(), Size()])) == hash(TouchSettings(bench=(Grasp(), Size())))
    listed = LinearErrors([Grasp()]).effect_again(FIVE)
    assert torch.equal(listed.twist, LinearErrors((Grasp(),)).effect(FIVE).twist)


def test_the_filter_is_the_dense_gaussian_and_each_error_matters() -> None:
    pose = around(20)
    expected = dense(pose, FIVE, LinearErrors(SHARED))
    torch.testing.assert_close(site(pose, FIVE).log_prob(FIVE), expected, rtol=1e-4, atol=1e-3)
    for k in range(len(SHARED)):
        others = SHARED[:k] + SHARED[k + 1 :]
        assert float((site(pose, FIVE, *others).log_prob(FIVE) - expected).abs().max()) > 0.02, SHARED[k].name

    @dataclass(frozen=True)
    class Pulled(ArmCompliance):
        """Mutant: the arm yields towards the force."""

        def effect(self, rows: Tensor) -> Any:
            right = super().effect(rows)
            return right._replace(twist=-right.twist)

    wrong = site(pose, FIVE, *(Pulled() if isinstance(e, ArmCompliance) else e for e in SHARED))
    assert float((wrong.log_prob(FIVE) - expected).abs().max()) > 0.1


def test_the_gap_s_change_by_a_displaced_peg_is_that_of_the_gap_itself() -> None:
    """On a real part, where witness points and normals matter, on its top and at its sides."""
    gap, pose = PegGap(block((0.06, 0.06, 0.025)), box_peg(0.016, 0.05)), around(6, 3, 1e-3, 0.03)
    rows = rows_with_wrenches([1, 1, 1, 1], [0, 0, 1, 1], seed=4)
    rows[:, :3] = torch.tensor(
        [[0.0, 0.01, 0.0502], [0.01, 0.0, 0.0505], [0.0382, 0.0, 0.03], [0, -0.0384, 0.03]]
    )
    errors = LinearErrors((*SHARED, PartSlides(center=(0.02, 0.01, 0.0))))
    one = ContactEpisodes(gap, pose, 4, 6e-5, 1e-5, 2e-5, bench=errors)
    lines = lines_at(gap(pose, rows[:, :7]), pose, rows, one.bench)
    shifts, columns = lines.moved, lines.columns
    for place, interval in enumerate(errors.delays):
        then, twist = late(rows, interval)
        differences = (columns[:, place] - measured_columns(gap, pose, then, errors)).abs()
        assert float(differences.quantile(0.95)) < 0.02 * float(columns.abs().quantile(0.95))
        step = 1e-3  # a shift is linear, as are the errors
        apart = [gap(pose, moved(rows[:, :7], sign * step * twist)).distance for sign in (1.0, -1.0)]
        differences = (shifts[:, place] - (apart[0] - apart[1]) / (2.0 * step)).abs()
        assert float(differences.quantile(0.9)) < 0.02 * float(shifts.abs().quantile(0.9))


def test_a_bench_may_lack_any_error() -> None:
    """Errors of size 0 change nothing, and without a delay the wrench is taken to be on time."""
    none = BenchProfile((0.0, 0.0, 0.0), (0.0, 0.0), (0.0, 0.1), delay=0.0, size=0.0, slips=0.0, slides=0.0)
    errors = none.errors((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    known = site(around(4), FIVE, *errors).log_prob(FIVE)
    assert torch.allclose(known, site(around(4), FIVE, bench=LinearErrors(())).log_prob(FIVE), atol=1e-9)


def test_any_cut_gives_the_same_likelihood_with_shared_errors() -> None:
    pose = around(10, 0, 3e-4, 3e-3)
    model = replace(look_and_touch.model, prepare=lambda r: look_and_touch.prepare(r, profile="ur5e"))
    totals = []
    for length in (300, 100, 37, 10):
        recording = cut(probed(100), length)
        sensor, values = values_of(recording, model)
        totals.append(sum(sensor.site(a, pose).log_prob(v) for a, v in values))
        assert isinstance(totals[-1], Tensor)
    for total in totals[1:]:
        torch.testing.assert_close(total, totals[0], rtol=0.0, atol=1e-6)
    # A row within an episode too: the chain rule.
    whole = site(pose, FIVE).log_prob(FIVE)
    parts = torch.zeros_like(whole)
    for k in range(5):
        value = FIVE[: k + 1].clone()
        value[:k, GIVEN] = 1.0
        parts = parts + site(pose, value).log_prob(value)
    torch.testing.assert_close(parts, whole, rtol=1e-6, atol=1e-4)


def test_a_row_without_contact_is_positive_given_the_contacts_before() -> None:
    pose = around(8)
    rows = rows_with_wrenches([1, 1, 0], [0, 0, -1], seed=2)
    certain = [error for error in SHARED if not error.delays]
    errors = LinearErrors(tuple(certain))
    columns, gaps = measured_columns(ledge, pose, rows, errors), ledge(pose, rows[:, :7]).distance
    after = site(pose, rows, *certain).branches(rows[:2])
    mean, covariance = moments(after)
    own = columns[:, 2]
    variance = float(rows[2, 8]) ** 2 + 1e-10 + 4e-10 + torch.einsum("na,nab,nb->n", own, covariance, own)
    score = (gaps[:, 2] + (own * mean).sum(-1)) / variance.sqrt() + math.sqrt(2.0 / math.pi)
    rubbing = torch.distributions.Normal(0.0, 1.0).log_prob(score)
    expected = torch.logaddexp(log_ndtr(score), rubbing).clamp(max=0.0)
    value = rows.clone()
    value[:2, GIVEN] = 1.0
    torch.testing.assert_close(site(pose, value, *certain).log_prob(value), expected, rtol=1e-3, atol=1e-3)


def pressed_with_the_peg_off(shift: float) -> Recording:
    """`probed`, by a robot that takes its peg to be higher in the hand than it is by `shift`."""
    recording = probed(100)
    whole = recording.measurements[0]
    measured = whole.observation.world_from_peg.copy()
    measured[:, 2] += shift
    touch = replace(whole.observation, world_from_peg=measured)
    return replace(recording, measurements=[Measurement(whole.action, touch)])


@pytest.mark.long
def test_the_pose_relative_to_the_peg_is_sure_where_that_in_the_world_is_not() -> None:
    """Along z, where peg and part are off alike: what the touches fix is the one relative to the other."""
    shift = 0.0008
    recording = pressed_with_the_peg_off(shift)
    sensor, values = values_of(
        recording, replace(look_and_touch.model, prepare=lambda r: look_and_touch.prepare(r, profile="ur5e"))
    )
    (action, value), at = values[-1], torch.tensor([0.0, 0, 0.05, 1, 0, 0, 0], dtype=torch.float64)
    height = torch.linspace(-1e-3, 1e-3, 41, dtype=torch.float64)
    pose = poses.identity(41)
    pose[:, 2] = height
    one = sensor.site(action, pose)
    log_weights = one.log_prob(value)
    belief = Belief(pose, log_weights, apparent=lambda at, draws: one.apparent_poses(value, at, draws))
    relative = belief.relative(at, 256)
    assert float(belief.spread[2]) > 3e-4, "the world's pose is unsure by as much as the grasp is"
    assert float(relative.spread[2]) < 1.4e-4
    assert abs(float(relative.mean[2]) - shift) < 2e-4, "a peg that is lower meets a part that seems higher"
    rough = replace(one, shared=3e-4)
    other = Belief(pose, log_weights, apparent=lambda at, draws: rough.apparent_poses(value, at, draws))
    assert float(other.relative(at, 64).spread[:2].min()) > 2.5e-4, "the place there has an error of its own"
    assert belief.relative(at).log_weights.shape == (41 * 8,)
    assert Belief(pose, log_weights).relative(at).world_from_part is pose


def test_what_touches_tell_of_the_grasp_is_its_posterior() -> None:
    """Presses along z that stop 1 mm too high: half of it is the part's, half a peg that sits lower."""
    grasp = Grasp(1e-3, 1e-9, 1e-9, slips=0.0)
    rows = MIXED[MIXED[:, FELT] == 1.0].clone()
    rows[:, 2] += 1e-3

    def pressed() -> None:
        part = pyro.sample("part", NormalPose(poses.identity(), [1e-3] * 3 + [1e-9] * 3))
        pyro.sample("touch", site(part, rows, grasp))

    population = importance_sampling(pressed, (), {"touch": rows}, 4000)
    (error,) = shared_errors(population)
    assert error.name == grasp.name
    expected = torch.tensor([1.0, 1.0, math.sqrt(0.5), 1.0, 1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(error.deviation, expected, rtol=0.04, atol=0.0)
    assert float(error.mean[2]) == pytest.approx(-0.5, abs=0.1)
    assert not shared_errors(importance_sampling(lambda: None, (), {}, 2)), "nothing is shared"


def changes_of(fault: str, seed: int = 21004) -> list[SuddenChange]:
    """What has changed, by touches, at the true pose: the part slides and turns by 0.5 degrees at 2.84 s."""
    scene = bench_scene(seed, BenchParameters(errors=BenchErrors.only(fault)))
    truth = torch.from_numpy(scene.truth)
    recording = scene.probe(three_two_one(Belief(truth.repeat(4, 1), ZERO), scene.part, scene.peg, ROCKED))
    prepared = look_and_touch.prepare(recording, profile="ur5e")
    touches = {a: v for a, v in prepared.observed(recording.measurements).items() if a.startswith("touch")}

    def near_the_truth() -> None:
        part = pyro.sample("part", NormalPose(truth, [1e-6] * 6))
        for k, measurement in enumerate(recording.measurements):
            if f"touch_{k}" in touches:
                prepared.likelihoods["window"].observe(k, measurement.action, part)

    population = importance_sampling(near_the_truth, (), touches, 3)
    return sudden_changes(population)


@pytest.mark.long
def test_a_part_that_slid_is_named_with_its_time_and_one_that_stood_is_not() -> None:
    (change,) = changes_of("slide")
    assert change.name == "the part slid" and change.probability > 0.9
    assert 2.84 <= change.time < 3.0
    assert_one_sentence(change_sentence(change))
    assert not changes_of("none")


def test_a_perfect_bench_has_none_and_an_unknown_profile_is_refused() -> None:
    _, values = values_of(probed(100))
    assert len(torch.cat([new_rows(v) for _, v in values]))
    assert PROFILES["perfect"] is None and {"ur5e", "panda", "industrial"} <= set(PROFILES)
    with pytest.raises(InputError, match="no profile 'ur5'"):
        look_and_touch.prepare(probed(100), profile="ur5")


@pytest.mark.long
@pytest.mark.parametrize(
    ("seed", "fault"), [(21000, "delay"), (21001, "delay"), (21004, "delay"), (21004, "none")]
)
def test_touches_tell_by_how_much_the_wrench_is_late(seed: int, fault: str) -> None:
    """By 35, 30, 14 and 0 ms; up to 19 ms less, since a peg that meets a part sinks in and comes back."""
    scene = bench_scene(seed, BenchParameters(errors=BenchErrors.only(fault)))
    truth = torch.from_numpy(scene.truth)
    certain = Belief(truth.repeat(4, 1), torch.zeros(4, dtype=torch.float64))
    recording = scene.probe(three_two_one(certain, scene.part, scene.peg))
    prepared = look_and_touch.prepare(recording, profile="ur5e")
    values = [v for a, v in prepared.observed(recording.measurements).items() if a.startswith("touch")]
    one = prepared.likelihoods["window"].site(recording.measurements[-1].action, truth[None])
    rows = torch.cat([new_rows(value) for value in values])
    branches = one.branches(rows)
    ends, (error,) = np.array([0.0, 0.0, *SECONDS]), [e for e in one.bench.errors if isinstance(e, Delay)]
    interval = [one._every[which].delay for which in branches.which[0]]
    rest = error.within * branches.mean[0][:, one.bench.slices[error.name]][:, 0]
    each = 0.5 * (ends[1:] + ends[:-1])[interval] + 0.5 * np.diff(ends)[interval] * rest
    assert abs(branches.weights[0] @ each - scene.drawn.delay) < 0.02
    # What is felt from 12 mm away, in free motion, is the tool's inertia: a late wrench feels it later.
    then, twist = late(rows, int(np.searchsorted(SECONDS, scene.drawn.delay)) + 1)
    gaps = one.gap(truth[None], moved(then[:, :7], twist)).distance[0]
    assert float(gaps[rows[:, FELT] == 1.0].max()) < 1.5e-3


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_peg_off_in_the_hand_leaves_a_belief_that_holds_the_truth(seed: int) -> None:
    """Simulated touches of which the robot's poses are off, by half a millimetre and half a degree."""
    scene, rng = bench_scene(seed), np.random.default_rng(seed)
    *_, seen = infer(look_and_touch.model, scene.look(), seed=seed)
    recording = scene.probe(three_two_one(seen.belief, scene.part, scene.peg))
    grasp = torch.from_numpy(rng.normal(size=6) * ([5e-4] * 3 + [math.radians(0.5)] * 3))

    def off(measurement: Measurement) -> Measurement:
        if not isinstance(measurement.action, ProbeWindow):
            return measurement
        true = torch.from_numpy(measurement.observation.world_from_peg)
        measured = poses.compose(true, poses.inverse(peg_from_true).expand(len(true), 7)).numpy()
        return replace(measurement, observation=replace(measurement.observation, world_from_peg=measured))

    peg_from_true = poses.retract(poses.identity(), grasp)
    shifted = replace(recording, measurements=[off(m) for m in recording.measurements])
    distances = {}
    for profile in ("perfect", "ur5e"):
        prepare = partial(look_and_touch.prepare, profile=profile)
        *_, last = infer(replace(look_and_touch.model, prepare=prepare), shifted, seed=seed)
        hole = poses.compose(last.belief.mean, torch.from_numpy(scene.kind.part_from_hole))
        measured = poses.compose(hole, torch.tensor([0, 0, 0.08, 1, 0, 0, 0], dtype=torch.float64))
        held = poses.compose(measured, peg_from_true)
        truth = torch.from_numpy(scene.truth)
        apparent = poses.compose(measured, poses.compose(poses.inverse(held), truth))
        relative = last.belief.relative(measured)
        away = poses.local(relative.mean, apparent)
        distances[profile] = float(away @ torch.linalg.solve(relative.covariance, away))
    assert distances["ur5e"] < 22.5, "99.9 % of chi-square with six degrees of freedom"
    assert distances["perfect"] > 100.0

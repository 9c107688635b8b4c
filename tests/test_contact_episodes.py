"""Contacts by episodes: a dense Gaussian, any cut of a probe, any rate, repeats, and mutants."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from bcppl import poses
from bcppl.arrays import Array
from bcppl.contact.sensing.contact_detection import ContactDetector
from bcppl.contact.sensing.episodes import EpisodeExtractor, Rows
from bcppl.contact.touch import Touch
from bcppl.distributions.episodes import ContactEpisodes, Grasp, Hypothesis, LinearErrors
from bcppl.distributions.episodes.alike import begun_alike, filtered_alike
from bcppl.distributions.episodes.prior import NOISES, WIDE
from bcppl.distributions.episodes.row_errors import segments_of
from bcppl.distributions.episodes.rows import (
    COLUMNS,
    CONTINUES,
    EPISODE,
    FELT,
    FORCE,
    GIVEN,
    NOISE as NOISE_COLUMN,
    TIME,
    WRENCH,
    new_rows,
)
from bcppl.distributions.manifold import FARTHEST
from bcppl.geometry.extrusion import block, box_peg
from bcppl.geometry.parts import Guess
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.verbs import observations_of
from bcppl.models import look_and_touch
from bcppl.recordings import repeated
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors import Measurement, Recording
from bcppl.traces import Model
from tests.test_manifold import around, differences, ledge

NOISE, SHARED, DRIFT, LASTING, COMPLIANCE, VARYING, ROUGH = 6e-5, 1e-5, 2e-5, 0.1, 5e-6, 0.6, 0.2
OUTLIER = 1e-3


def site(pose: Tensor, stamps: int, **others: Any) -> ContactEpisodes:
    return ContactEpisodes(ledge, pose, stamps, NOISE, SHARED, 2e-5, OUTLIER, **others)


def rows_at(heights: Sequence[float], felt: Sequence[float], episodes: Sequence[int]) -> Tensor:
    """Rows (T, 13) 20 to 80 ms apart, of forces from 2 to 12 N."""
    rng = np.random.default_rng(3)
    count = len(heights)
    rows = torch.zeros(count, COLUMNS, dtype=torch.float64)
    rows[:, :2] = torch.from_numpy(rng.uniform(-0.03, 0.03, (count, 2)))
    rows[:, 2], rows[:, 3], rows[:, 7] = torch.tensor(heights), 1.0, torch.tensor(felt)
    rows[:, 8] = torch.from_numpy(rng.uniform(2e-5, 9e-5, count))
    rows[:, 9] = torch.from_numpy(rng.uniform(2.0, 12.0, count))
    rows[:, 10] = torch.from_numpy(np.cumsum(rng.uniform(0.02, 0.08, count)))
    rows[:, 11] = torch.tensor(episodes)
    return rows


MIXED = rows_at(
    [-1e-4, -8e-5, 1e-5, 2e-4, -3e-5, -6e-5, -9e-5, 3e-5],
    [1, 1, 1, 0, 1, 1, 1, 0],
    [0, 0, 0, -1, 1, 1, 1, -1],
)


def test_it_is_the_dense_gaussian_of_a_stationary_process_an_uncertain_compliance_and_noise() -> None:
    pose = around(30)
    distance = ledge(pose, MIXED[:, :7]).distance
    nodes = torch.linspace(-1.25, 1.25, 11, dtype=torch.float64)
    weights = (-0.5 * (nodes / 0.5) ** 2).log_softmax(dim=0)
    sums = []
    for (decade, weight), (share, scale) in itertools.product(zip(nodes, weights, strict=True), NOISES):
        compliance, total = COMPLIANCE * 10.0**decade, (weight + math.log(share)).expand(len(pose))
        for own in ([0, 1, 2], [4, 5, 6]):
            force, time, noise = MIXED[own, 9], MIXED[own, 10], MIXED[own, 8]
            apart = (time[:, None] - time).abs()
            covariance = scale**2 * (DRIFT**2 * torch.exp(-apart / LASTING) + SHARED**2)
            covariance = covariance + (VARYING * compliance) ** 2 * force[:, None] * force
            covariance = covariance + torch.diag((scale * noise) ** 2 + (ROUGH * compliance * force) ** 2)
            inlier = MultivariateNormal(-compliance * force, covariance).log_prob(distance[:, own])
            stray = torch.full_like(inlier, math.log(OUTLIER) - 3 * math.log(FARTHEST))
            total = total + torch.logaddexp(inlier + math.log1p(-OUTLIER), stray)
        for k in (3, 7):
            spread = scale * math.sqrt(float(MIXED[k, 8]) ** 2 + DRIFT**2 + SHARED**2)
            score = distance[:, k] / spread + math.sqrt(2.0 / math.pi)  # as between two walls
            rubbing = torch.exp(-0.5 * score**2) / math.sqrt(2.0 * math.pi)
            free = (torch.special.ndtr(score) + rubbing).clamp(max=1.0)
            total = total + torch.log((1 - OUTLIER) * free + OUTLIER)
        sums.append(total)
    expected = torch.logsumexp(torch.stack(sums), dim=0)
    # Hypotheses that no longer weigh are left out.
    torch.testing.assert_close(site(pose, 8).log_prob(MIXED), expected, rtol=1e-7, atol=2e-5)
    for name in ("drift", "varying", "rough"):  # mutants without one of the errors
        assert float((site(pose, 8, **{name: 0.0}).log_prob(MIXED) - expected).abs().max()) > 0.01, name


def continued(rows: Tensor, cut: int) -> Tensor:
    """The same, an episode in two from a row on, of one contact."""
    rows = rows.clone()
    rows[cut:, EPISODE] += 1.0
    last = rows[:, EPISODE] == rows[cut, EPISODE]
    rows[last, CONTINUES] = 1.0
    return rows


def test_what_is_common_to_a_contact_lasts_as_long_as_it() -> None:
    """A contact over two cells: each may be an outlier by itself, and where it is and yields is common."""
    pose, one = around(20), (Hypothesis(0.0, 1e-5),)
    rows, cut = continued(MIXED[4:7], 2), 2
    distance, force, noise = ledge(pose, rows[:, :7]).distance, rows[:, FORCE], rows[:, NOISE_COLUMN]
    expected = []
    for among in itertools.product((True, False), repeat=2):
        own = [k for k in range(3) if among[int(k >= cut)]]
        total = torch.zeros(len(pose), dtype=torch.float64)
        for inside, count in zip(among, (cut, 3 - cut), strict=True):
            total = total + (
                math.log1p(-OUTLIER) if inside else math.log(OUTLIER) - count * math.log(FARTHEST)
            )
        if own:
            apart = (rows[own, TIME][:, None] - rows[own, TIME]).abs()
            together = torch.tensor([[int(a >= cut) == int(b >= cut) for b in own] for a in own])
            covariance = SHARED**2 + torch.where(together, DRIFT**2 * torch.exp(-apart / LASTING), 0.0)
            covariance = covariance + (VARYING * 1e-5) ** 2 * force[own][:, None] * force[own]
            covariance = covariance + torch.diag(noise[own] ** 2 + (ROUGH * 1e-5 * force[own]) ** 2)
            total = total + MultivariateNormal(-1e-5 * force[own], covariance).log_prob(distance[:, own])
        expected.append(total)
    exact = torch.logsumexp(torch.stack(expected), dim=0)
    off = (site(pose, 3, hypotheses=one).log_prob(rows) - exact).abs()
    # A mixture of outlier and not, of which the filter keeps the moments, has other tails.
    assert float(off.median()) < 1e-4 and float(off.max()) < 0.2
    apart = rows.clone()
    apart[:, CONTINUES] = 0.0
    off = (site(pose, 3, hypotheses=one).log_prob(apart) - exact).abs()
    assert float(off.median()) > 0.05, "as another contact"
    # Where the rows before are left out, it is as another.
    cuts = [site(pose, 1, hypotheses=one).log_prob(each[cut:]) for each in (rows, apart)]
    torch.testing.assert_close(*cuts)


@pytest.mark.parametrize("cut", [5, 6])
def test_for_all_particles_together_it_is_the_same(cut: int) -> None:
    """As it is evaluated on a GPU, here on the processor: rows at once, and those after others."""
    pose, rows = around(30), continued(MIXED, cut)
    whole = site(pose, 8)
    prior, distance = whole._prior(0), ledge(pose, rows[:, :7]).distance
    branches = begun_alike(prior, pose)
    for part in itertools.starmap(slice, itertools.pairwise((0, 4, cut, 8))):
        segments = segments_of(rows[part], whole._row_errors, whole._every)
        branches = filtered_alike(branches, prior, segments, distance[:, part], rows[part, FORCE].numpy())
    expected = torch.from_numpy(whole.branches(rows).log_evidence)
    torch.testing.assert_close(branches.log_evidence, expected, rtol=0.0, atol=1e-9)
    both = branches.on_host, whole.branches(rows)
    squares = [(each.weights[..., None] * each.squared).sum(axis=(1, 2)) for each in both]
    np.testing.assert_allclose(*squares, rtol=1e-9)


def test_a_row_given_before_counts_once() -> None:
    """The chain rule: rows one after another, within episodes too, have the density of all at once."""
    pose = around(20)
    whole, parts, mutant = site(pose, 8).log_prob(MIXED), 0.0, 0.0
    for k in range(8):
        value = MIXED[: k + 1].clone()
        value[:k, GIVEN] = 1.0
        parts = parts + site(pose, k + 1).log_prob(value)
        mutant = mutant + site(pose, 1).log_prob(MIXED[k : k + 1])
    torch.testing.assert_close(parts, whole, rtol=1e-9, atol=1e-8)
    assert float((mutant - whole).abs().max()) > 1.0, "rows as if none had been before"


def test_a_measured_window_of_each_particle_is_that_window() -> None:
    """As `assess` is given what was measured: a value for each particle, the same for all or not."""
    pose, other = around(6), MIXED.clone()
    other[2, 2] = -9e-5
    each = torch.stack([MIXED, other, MIXED, MIXED, other, other])
    torch.testing.assert_close(
        site(pose, 8).log_prob(MIXED.expand(6, 8, COLUMNS)), site(pose, 8).log_prob(MIXED)
    )
    asked = torch.stack([site(pose[n : n + 1], 8).log_prob(each[n])[0] for n in range(6)])
    torch.testing.assert_close(site(pose, 8).log_prob(each), asked)


def test_quadratic_is_the_gradient_and_nearly_the_curvature() -> None:
    """Of one compliance, of which the log-likelihood is a quadratic function of the gaps."""
    step = torch.tensor([1e-7] * 3 + [3e-6] * 3, dtype=torch.float64)
    scale = torch.tensor([1e-4] * 3 + [3e-3] * 3, dtype=torch.float64)
    given = MIXED.clone()
    given[:2, GIVEN] = 1.0
    one = (Hypothesis(0.0, COMPLIANCE),)
    for value in (MIXED, given):
        pose = around(1, 1, 1e-5, 1e-4)
        stated = site(pose, 8, hypotheses=one).quadratic(value)
        gradient, bend = differences(lambda p: site(p, 8, hypotheses=one), value, pose, step)
        size = float((gradient * scale).abs().max())
        assert float(((stated.gradient[0] - gradient) * scale).abs().max()) < 0.12 * size
        information, curved = stated.information[0] * scale[:, None] * scale, bend * scale[:, None] * scale
        assert float((information - curved).abs().max()) < 0.3 * float(curved.abs().max())


def test_quadratic_of_an_uncertain_compliance_has_the_likelihood_s_own_moments() -> None:
    """Along the plane's normal: mean and variance of the normalised likelihood."""
    pose = poses.identity(4001)
    pose[:, 2] = torch.linspace(-1e-3, 1e-3, 4001, dtype=torch.float64)
    weights = site(pose, 8).log_prob(MIXED).softmax(dim=0)
    mean = weights @ pose[:, 2]
    variance = weights @ (pose[:, 2] - mean) ** 2
    stated = site(pose[2000:2001], 8).quadratic(MIXED)
    information, slope = float(stated.information[0, 2, 2]), float(stated.gradient[0, 2])
    # The other axes are known by nothing else here, so they are held.
    assert 0.4 < 1.0 / information / float(variance) < 2.5
    assert abs(-slope / information - float(mean)) < float(variance) ** 0.5


# ---------------------------------------------------------------- rows of a probe

PERFECT = look_and_touch.model.with_settings(profile="perfect")
LONG, HIGH = 0.05, 0.025


@functools.cache
def probed(rate: int) -> Recording:
    """A block that is tapped on its top, pressed for 0.4 s, and pressed from a side, in 3 s; no view."""
    stamps = np.arange(0.0, 3.0, 1.0 / rate)
    knots = [
        (0.0, 0.0, 0.010),
        (0.4, 0.0, 0.010),
        (0.5, 0.0, -0.002),  # the first press is a tap
        (0.62, 0.0, 0.010),
        (1.0, 0.015, 0.004),
        (1.2, 0.015, -0.002),
        (1.6, 0.015, -0.002),
        (1.8, 0.050, 0.008),
        (2.1, 0.050, -0.015),
        (2.4, 0.036, -0.015),
        (2.7, 0.036, -0.015),
        (2.9, 0.050, -0.015),
        (3.0, 0.050, -0.015),
    ]
    time, x, z = np.array(knots).T
    command = np.zeros((len(stamps), 7))
    command[:, 0], command[:, 2], command[:, 3] = np.interp(stamps, time, x), np.interp(stamps, time, z), 1.0
    stood, force, side = command.copy(), np.zeros((len(stamps), 3)), 0.03 + 0.008
    on_top, beside = (np.abs(command[:, 0]) < 0.03) & (command[:, 2] < 0), stamps > 2.1
    force[on_top, 2] = -2500.0 * command[on_top, 2]
    pressed = beside & (command[:, 0] < side)
    force[pressed, 0] = 2500.0 * (side - command[pressed, 0])
    stood[on_top, 2], stood[pressed, 0] = -COMPLIANCE * force[on_top, 2], side
    stood[pressed, 0] -= COMPLIANCE * force[pressed, 0]
    stood[:, 2] += LONG  # the peg's frame is at its upper end
    command[:, 2] += LONG
    rng = np.random.default_rng(rate)
    stood[:, :3] += rng.normal(0.0, 3e-5, (len(stamps), 3))
    wrench = np.concatenate([force + rng.normal(0.0, 0.05, force.shape), np.zeros_like(force)], axis=1)
    probe = Probe("pressing", stamps, command, np.full(6, 2500.0), np.full(6, 100.0), stamps)
    guess = Guess(np.array([0.0, 0, 0, 1, 0, 0, 0]), np.full(3, 0.003), 0.02, 0.02)
    whole = Measurement(ProbeWindow(probe, 0, len(stamps)), Touch(stamps, wrench, stood))
    return Recording(block((0.06, 0.06, HIGH)), guess, [whole], peg=box_peg(0.016, LONG))


def cut(recording: Recording, length: int) -> Recording:
    """The same in windows of so many stamps."""
    action, touch = recording.measurements[0].action, recording.measurements[0].observation
    windows = []
    for first in range(0, len(touch.times), length):
        rows = slice(first, min(first + length, len(touch.times)))
        own = Touch(touch.times[rows], touch.wrench[rows], touch.world_from_peg[rows])
        windows.append(Measurement(ProbeWindow(action.probe, rows.start, rows.stop), own))
    return replace(recording, measurements=windows)


def values_of(recording: Recording, model: Model = PERFECT) -> tuple[Any, list[tuple[Any, Tensor]]]:
    """The likelihood, and each value with its action, as a filter comes by them."""
    scene = model.prepare(recording)
    steps = observations_of(model, scene, recording.measurements)
    values = [(each.args[1][-1], value) for each in steps for value in each.observations.values()]
    return scene.likelihoods["window"], values


def log_likelihood(recording: Recording, pose: Tensor, forget: bool = False) -> Tensor:
    sensor, values = values_of(recording)
    total = pose.new_zeros(len(pose))
    for action, value in values:
        if forget:
            value = value[(value[:, GIVEN] != 1.0).nonzero()[:, 0]]
        total = total + sensor.site(action, pose).log_prob(value)
    return total


@pytest.mark.parametrize("rate", [20, 50, 100, 500])
def test_the_likelihood_does_not_depend_on_how_a_probe_is_cut(rate: int) -> None:
    pose = around(20, 0, 5e-5, 1e-3)
    whole = log_likelihood(probed(rate), pose)
    for length in (1, rate // 10, rate // 2, rate):
        torch.testing.assert_close(
            log_likelihood(cut(probed(rate), length), pose), whole, rtol=1e-9, atol=1e-6
        )
    forgetful = log_likelihood(cut(probed(rate), rate // 2), pose, forget=True)
    assert float((forgetful - whole).abs().max()) > 1e-2, "a mutant that forgets the earlier windows"


def information_at(rate: int) -> Tensor:
    sensor, values = values_of(probed(rate))
    pose = poses.identity(1)
    every = sum((sensor.site(action, pose).quadratic(value).information[0] for action, value in values))
    assert isinstance(every, Tensor)
    return every


def test_stamps_at_other_rates_inform_nearly_as_much() -> None:
    usual = information_at(100)[[2, 0], [2, 0]].sqrt()
    assert bool((usual > 1 / 1e-4).all()), (
        "the top and the side are known to less than a tenth of a millimetre"
    )
    for rate in (50, 200, 500, 2000):
        ratio = information_at(rate)[[2, 0], [2, 0]].sqrt() / usual
        assert bool(((ratio > 0.5) & (ratio < 2.0)).all()), (rate, ratio)


@pytest.mark.parametrize("profile", ["perfect", "ur5e"])
def test_a_tap_of_forty_milliseconds_is_used_at_every_rate(profile: str) -> None:
    """Also where the wrench may be late: the peg's own stop is not taken for what stopped it."""
    for rate in (50, 100, 500, 2000):
        _, values = values_of(probed(rate), look_and_touch.model.with_settings(profile=profile))
        rows = torch.cat([new_rows(value) for _, value in values])
        tap = rows[(rows[:, 10] > 0.45) & (rows[:, 10] < 0.55)]
        assert float((tap[:, 7] == 1.0).sum()) >= 1, rate
        assert len(rows) < 120, "rows are as many as their time is worth"


class _Hasty(EpisodeExtractor):
    """Mutant: a stamp is decided at once, before what surrounds it is known."""

    @property
    def _lag(self) -> float:
        return 0.0


def test_rows_do_not_depend_on_later_stamps_and_those_of_a_mutant_do() -> None:
    recording = probed(100)
    touch, stamps = recording.measurements[0].observation, recording.measurements[0].action.probe.stamps
    changed = touch.wrench.copy()
    changed[250:, :3] += 30.0

    def rows(kind: type[EpisodeExtractor], wrench: Array, last: int) -> Rows:
        """Those of the first 2.5 s, where the probe is known up to stamp `last`."""
        extractor = kind(ContactDetector(), 0.01)
        extractor.rows(stamps[:200], touch.world_from_peg[:200], wrench[:200, :3], False)
        every = extractor.rows(stamps[:last], touch.world_from_peg[:last], wrench[:last, :3], False)
        early = every.time < 2.475
        return Rows(*(column[early] for column in every))

    right = rows(EpisodeExtractor, touch.wrench, 300)
    assert len(right.time) > 5 and bool((right.felt == 1.0).any())
    for last in (250, 260, 300):
        for each, other in zip(rows(EpisodeExtractor, changed, last), right, strict=True):
            np.testing.assert_array_equal(each[:-1], other[: len(each) - 1])
    hasty = [rows(_Hasty, touch.wrench, last) for last in (247, 300)]
    assert len(hasty[0].time) != len(hasty[1].time) or not np.array_equal(hasty[0].speed, hasty[1].speed)


# ---------------------------------------------------------------- deferred and repeated measurements


def test_fine_windows_give_the_belief_of_coarse_ones_to_the_bit_and_steps_for_all() -> None:
    coarse, fine = (
        list(infer(look_and_touch.model, cut(probed(50), length), particles=6, seed=1)) for length in (25, 1)
    )
    assert len(fine) == 151 and len(coarse) == 7
    assert torch.equal(fine[-1].belief.world_from_part, coarse[-1].belief.world_from_part)
    assert fine[-1].info.log_evidence == coarse[-1].info.log_evidence
    assert fine[30].population is fine[25].population, "nothing is known before a cell ends"
    resumed = infer(look_and_touch.model, cut(probed(50), 1), particles=6, seed=1, start=fine[40])
    *_, last = resumed
    assert torch.equal(last.belief.world_from_part, fine[-1].belief.world_from_part)


def test_a_window_given_twice_counts_once_and_is_named() -> None:
    once = cut(probed(100), 50)
    twice = replace(once, measurements=[*once.measurements[:3], *once.measurements[2:]])
    assert repeated(twice) == {3: 2}
    with pytest.warns(RuntimeWarning, match="measurement 3 repeats measurement 2"):
        *_, last = infer(look_and_touch.model, twice, particles=6, seed=2)
    *_, other = infer(look_and_touch.model, once, particles=6, seed=2)
    assert last.taken == 6 and torch.equal(last.belief.world_from_part, other.belief.world_from_part)
    # Windows that overlap are no repeats; stamps that were measured before are left out.
    action, touch = probed(100).measurements[0].action, probed(100).measurements[0].observation

    def window(first: int, last: int) -> Measurement:
        own = Touch(touch.times[first:last], touch.wrench[first:last], touch.world_from_peg[first:last])
        return Measurement(ProbeWindow(action.probe, first, last), own)

    overlapping = replace(once, measurements=[window(0, 120), window(80, 220), window(150, 300)])
    pose = around(10, 0, 5e-5, 1e-3)
    torch.testing.assert_close(
        log_likelihood(overlapping, pose), log_likelihood(once, pose), rtol=1e-9, atol=1e-6
    )


def test_part_and_grasp_move_together_in_the_joint_covariance() -> None:
    """Contacts with a plane leave both as open as the grasp's prior, and their difference not."""
    one, bench = (Hypothesis(0.0, COMPLIANCE),), LinearErrors((Grasp(1e-3, 1e-9, 1e-9, slips=0.0),))
    likelihood = site(poses.identity(1), 8, hypotheses=one, bench=bench)
    covariance = likelihood.joint_covariance(MIXED)[0]
    assert covariance.shape == (12, 12)
    of_part, of_peg = torch.zeros(2, 12, dtype=torch.float64)
    of_part[2], of_peg[8] = 1.0, 1e-3  # m along the plane's normal
    apart = of_part - of_peg
    assert float(of_part @ covariance @ of_part) > 0.5e-6
    assert float(apart @ covariance @ apart) < 1e-8
    given = torch.linalg.inv(likelihood.quadratic(MIXED).information[0] + torch.diag(WIDE**-2))
    torch.testing.assert_close(covariance[:6, :6], given, rtol=1e-6, atol=1e-14)


def test_a_couple_presses_a_peg_no_harder() -> None:
    """How deep a peg that leans in a hole is in the walls goes by the force on it, not by the torque."""
    recording = probed(100)
    (whole,) = recording.measurements
    levered = whole.observation.wrench.copy()
    levered[50:, 3] += 0.6
    touch = replace(whole.observation, wrench=levered)
    loads = []
    for each in (recording, replace(recording, measurements=[Measurement(whole.action, touch)])):
        rows = new_rows(values_of(each)[1][-1][1])
        loads.append(rows[rows[:, FELT] == 1.0])
    plain, other = loads
    torch.testing.assert_close(plain[:, TIME], other[:, TIME])
    torch.testing.assert_close(plain[:, FORCE], other[:, FORCE])
    torch.testing.assert_close(other[:, FORCE], other[:, WRENCH][:, :3].norm(dim=1), rtol=0.02, atol=0.02)
    assert float((other[:, WRENCH] - plain[:, WRENCH])[:, 3].median()) == pytest.approx(0.6, abs=0.01)

"""Contacts by episodes: a dense Gaussian, pieces of it, rows given before, the quadratic, and mutants."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from bcppl import poses
from bcppl.distributions.episodes import ContactEpisodes, Grasp, Hypothesis, LinearErrors
from bcppl.distributions.episodes.filter.alike import begun_alike, filtered_alike
from bcppl.distributions.episodes.filter.row_errors import segments_of
from bcppl.distributions.episodes.prior import NOISES, WIDE
from bcppl.distributions.episodes.rows import (
    COLUMNS,
    CONTINUES,
    EPISODE,
    FORCE,
    GIVEN,
    NOISE as NOISE_COLUMN,
    TIME,
)
from bcppl.distributions.manifold import FARTHEST
from tests.distributions.touches.test_manifold import around, differences, ledge

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


def in_pieces(pose: Tensor, rows: Tensor, piece: Sequence[int], compliance: float) -> Tensor:
    """The log-density (N,) of a contact of which each piece may be an outlier: a sum over which are."""
    distance, force, noise = ledge(pose, rows[:, :7]).distance, rows[:, FORCE], rows[:, NOISE_COLUMN]
    number, which = len(set(piece)), torch.tensor(piece)
    every = []
    for among in itertools.product((True, False), repeat=number):
        own = [k for k, p in enumerate(piece) if among[p]]
        total = torch.zeros(len(pose), dtype=torch.float64)
        for p, inside in enumerate(among):
            stray = math.log(OUTLIER) - piece.count(p) * math.log(FARTHEST)
            total = total + (math.log1p(-OUTLIER) if inside else stray)
        if own:
            apart = (rows[own, TIME][:, None] - rows[own, TIME]).abs()
            together = which[own][:, None] == which[own]
            covariance = SHARED**2 + torch.where(together, DRIFT**2 * torch.exp(-apart / LASTING), 0.0)
            covariance = covariance + (VARYING * compliance) ** 2 * force[own][:, None] * force[own]
            covariance = covariance + torch.diag(noise[own] ** 2 + (ROUGH * compliance * force[own]) ** 2)
            total = total + MultivariateNormal(-compliance * force[own], covariance).log_prob(
                distance[:, own]
            )
        every.append(total)
    return torch.logsumexp(torch.stack(every), dim=0)


def test_what_is_common_to_a_contact_lasts_as_long_as_it() -> None:
    """A contact over two cells: each may be an outlier by itself, and where it is and yields is common."""
    pose, one, cut = around(20), (Hypothesis(0.0, 1e-5),), 2
    rows = continued(MIXED[4:7], cut)
    exact = in_pieces(pose, rows, [0, 0, 1], 1e-5)
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


def test_of_a_long_episode_a_piece_may_be_false_by_itself() -> None:
    """Contact that is felt for a tenth of a second amid another costs the rest of the episode nothing."""
    pose, one = around(20, 0, 3e-5, 1e-3), (Hypothesis(0.0, 1e-5),)
    rows = rows_at([-1e-4] * 10, [1] * 10, [0] * 10)
    rows[:, TIME], piece = 0.05 * torch.arange(10), [0, 0, 0, 0, 1, 1, 1, 1, 2, 2]
    rows[:, 2] = -1e-5 * rows[:, FORCE]
    for away in (0.0, 0.002):
        rows[4:8, 2] = rows[4:8, 2] + away
        exact = in_pieces(pose, rows, piece, 1e-5)
        off = (site(pose, 10, hypotheses=one).log_prob(rows) - exact).abs()
        assert float(off.max()) < 0.05, away
    whole = in_pieces(pose, rows, [0] * 10, 1e-5)
    assert float((exact - whole).min()) > 20.0, "as an outlier as a whole"


def test_what_is_held_slips_where_it_is_loaded_more_than_before() -> None:
    rows = rows_at([0.0] * 12, [1] * 12, [0] * 12)
    rows[:, TIME] = 0.05 * torch.arange(12)
    rows[:, FORCE] = torch.tensor([2.0, 5.0, 4.0, 10.0, 9.0, 10.5, 10.2, 3.0, 10.0, 14.0, 12.0, 20.0])
    likelihood = site(poses.identity(1), 12)
    segments = segments_of(rows, likelihood._row_errors, likelihood._every)
    assert segments.first.tolist() == [0, 4, 8] and segments.begins.tolist() == [1, 0, 0]
    assert segments.slips.tolist() == [1, 0, 1]
    np.testing.assert_allclose(segments.loaded[:4], [0.2, 0.5, 0.5, 1.0])
    np.testing.assert_allclose(segments.loaded[8:], [0.0, *[3.5 / 9.5] * 2, 1.0])


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
    # The first contact is false, and determines where the plane would be.
    false = rows_at(
        [5e-3, *MIXED[:, 2].tolist()], [1, *MIXED[:, 7].tolist()], [0, *(MIXED[:, 11] + 1).tolist()]
    )
    one = (Hypothesis(0.0, COMPLIANCE),)
    for value in (MIXED, given, false):
        pose = around(1, 1, 1e-5, 1e-4)
        stated = site(pose, len(value), hypotheses=one).quadratic(value)
        here = functools.partial(site, stamps=len(value), hypotheses=one)
        gradient, bend = differences(here, value, pose, step)
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

"""A peg that goes into the hole, which is a needle: poses that have it there are proposed, and found."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.episodes import ContactEpisodes
from bcppl.distributions.episodes.rows import EPISODE, FELT, FORCE, GIVEN, NOISE, TIME, WRENCH, padded
from bcppl.geometry.holes import fit_in, hole_of
from bcppl.inference.approximations.laplace import Normal, Search, quadratic_approximation
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.sensors.capabilities import Approximated
from bcppl.sensors.likelihoods.contact_probe import ContactProbe, TouchSettings

DEPTHS = np.linspace(0.004, -0.01, 15)  # m above the mouth
OFF = torch.tensor([0.003, -0.0035, 0.001, 0.01, -0.02, 0.012], dtype=torch.float64)


@functools.cache
def scene() -> BenchScene:
    return bench_scene(7, part="square 8 mm")


def lowered(lateral: float = 0.0) -> Tensor:
    """Rows of a peg that is lowered in the hole's axis, or beside it, without contact."""
    hole = hole_of(scene().part)
    held = fit_in(hole, scene().peg).hole_from_peg
    mouth = poses.compose(torch.from_numpy(scene().truth), torch.from_numpy(hole.part_from_hole))
    place = poses.identity(len(DEPTHS))
    place[:, 0], place[:, 2] = lateral, torch.from_numpy(DEPTHS)
    rows = padded(poses.compose(poses.compose(mouth, place), torch.from_numpy(held)), len(DEPTHS))
    rows[:, FELT], rows[:, NOISE], rows[:, FORCE], rows[:, EPISODE], rows[:, GIVEN] = (
        0.0,
        3e-5,
        0.0,
        -1.0,
        0.0,
    )
    rows[:, TIME], rows[:, WRENCH] = 0.02 * torch.arange(len(DEPTHS)), 0.0
    return rows


def probe() -> ContactProbe:
    return ContactProbe(scene().look(), TouchSettings(profile="perfect"))


def test_a_peg_that_would_be_deep_in_the_material_is_in_the_hole_instead() -> None:
    truth, sensor = torch.from_numpy(scene().truth), probe()
    believed = poses.retract(truth, OFF)[None]
    measured = [Approximated(2, None, lowered())]
    inside = sensor.in_hole(measured, believed)
    width = torch.linalg.inv(inside.information[0] + 1e3 * torch.eye(6, dtype=torch.float64))[:2, :2]
    assert 0.1 * scene().clearance < float(torch.linalg.eigvalsh(width)[0].sqrt()) < scene().clearance
    off = poses.local(truth, inside.part[0])
    across = poses.rotation_matrix(truth).T @ off[:3]
    # Along the hole's axis and about it nothing is known; the mouth is as far off as the yaw turns it.
    assert float(across[:2].abs().max()) < 2e-4 and float(off[3:5].abs().max()) < 1e-3
    assert abs(float(off[5]) - float(OFF[5])) < 2e-3
    # The room is that of mouth and tip across the hole's axis: by differences.
    part, rows = inside.part[0], lowered()
    deepest = rows[int(sensor.gap(believed, rows[:, :7]).distance[0].argmin()), :7]
    low = torch.tensor([[0.0, 0.0, float(scene().peg.vertices[:, 2].min())]], dtype=torch.float64)
    ends = torch.cat(
        [
            torch.from_numpy(hole_of(scene().part).part_from_hole[None, :3]),
            poses.transform(poses.compose(poses.inverse(part), deepest), low),
        ]
    )
    moved = poses.retract(part, 1e-7 * torch.eye(6, dtype=torch.float64))
    slopes = (poses.transform(moved, ends) - poses.transform(part, ends)) / 1e-7  # (6, 2, 3)
    axis = poses.rotation_matrix(deepest)[:, 2]
    beside = slopes - (slopes @ axis)[..., None] * axis
    expected = torch.einsum("akc,bkc->ab", beside, beside) / (scene().clearance ** 2 / 12.0)
    torch.testing.assert_close(inside.information[0], expected, rtol=1e-4, atol=1e-4 * float(expected.max()))
    # Beside the believed part, or above it, nothing has to be explained.
    assert len(sensor.in_hole(measured, torch.from_numpy(scene().truth)[None]).part) == 0
    assert len(sensor.in_hole([Approximated(2, None, lowered(0.2))], believed).part) == 0


def test_the_mode_in_the_hole_is_reached_and_as_wide_as_the_hole_leaves_it_room() -> None:
    truth, sensor, rows = torch.from_numpy(scene().truth), probe(), lowered()
    center = poses.retract(truth, OFF)[None]
    # The height is known: else the part is more probably lower, for the hole is small.
    spread = torch.tensor([0.004, 0.004, 0.0015] + [0.02] * 3, dtype=torch.float64)
    precision = torch.diag(spread**-2)
    prior = Normal(center, precision[None])

    def sites(part: Tensor, blur: float) -> list[tuple[ContactEpisodes, Tensor]]:
        wide = math.hypot(6e-5, blur)
        return [(ContactEpisodes(sensor.gap, part, len(rows), wide, 1e-5, 2e-5, blur=blur), rows)]

    inside = sensor.in_hole([Approximated(2, None, rows)], center)
    found = quadratic_approximation(sites, prior, inside=[inside])
    posterior = found.posterior(center[0], precision)
    away = [poses.rotation_matrix(truth).T @ poses.local(truth, mode)[:3] for mode in posterior.centers]
    best = min(range(len(away)), key=lambda k: float(away[k][:2].norm()))
    assert float(away[best][:2].abs().max()) < 0.5 * scene().clearance
    turned = poses.rotation_matrix(truth)
    own = turned.T @ posterior.covariances[best][:3, :3] @ turned
    assert float(own[:2, :2].diagonal().sqrt().max()) < 2.0 * scene().clearance
    assert float(own[2, 2].sqrt()) > 0.001


def leaning(heading: float, lean: float = 0.1) -> Tensor:
    """A peg (7,) that leans in the hole's mouth, lowered until it touches."""
    hole, truth = hole_of(scene().part), torch.from_numpy(scene().truth)
    held = torch.from_numpy(fit_in(hole, scene().peg).hole_from_peg)
    mouth = poses.compose(truth, torch.from_numpy(hole.part_from_hole))
    axis = torch.tensor([math.cos(heading), math.sin(heading), 0.0], dtype=torch.float64)
    tip = poses.identity(200)
    tip[:, 2] = torch.linspace(0.002, -0.008, 200, dtype=torch.float64)
    tip = poses.retract(tip, torch.cat([torch.zeros(3, dtype=torch.float64), lean * axis]).expand(200, 6))
    # The middle of what is inside stands in the middle of the hole.
    up = poses.rotation_matrix(tip[0])[:, 2]
    tip[:, :2] += 0.5 * tip[:, 2:3] * up[:2]
    peg = poses.compose(poses.compose(mouth, tip), held)
    touching = probe().gap(truth[None], peg).distance[0] < 0.0
    return peg[int(touching.nonzero()[0])]


def test_a_peg_that_is_wedged_in_the_mouth_leads_there() -> None:
    """The peg may also stand on a part that is lower: only the place of the mouth leads to the truth."""
    truth, sensor = torch.from_numpy(scene().truth), probe()
    rows = padded(torch.stack([leaning(heading) for heading in (0.3, 1.6, 2.9, 4.5)]), 4)
    rows[:, FELT], rows[:, NOISE], rows[:, FORCE], rows[:, GIVEN] = 1.0, 3e-5, 5.0, 0.0
    rows[:, EPISODE], rows[:, TIME] = torch.arange(4.0).double(), 0.3 * torch.arange(4.0).double()
    rows[:, WRENCH] = 0.0
    measured = [Approximated(2, None, rows)]
    center = poses.retract(truth, torch.tensor([0.003, -0.0035, -0.005, 0.01, -0.02, 0.012]).double())[None]
    there = poses.local(truth, sensor.at_mouth(measured, center)[0])
    assert float(there[:3].norm()) < 0.0015 < float(poses.local(truth, center[0])[:3].norm())
    spread = torch.tensor([0.004] * 3 + [0.02] * 3, dtype=torch.float64)
    prior = Normal(center, torch.diag(spread**-2)[None])

    def sites(part: Tensor, blur: float) -> list[tuple[ContactEpisodes, Tensor]]:
        wide = math.hypot(6e-5, blur)
        return [(ContactEpisodes(sensor.gap, part, len(rows), wide, 1e-5, 2e-5, blur=blur), rows)]

    def nearest(search: Search) -> float:
        modes = quadratic_approximation(sites, prior, search=search).around
        return min(float(poses.local(truth, mode)[:3].norm()) for mode in modes)

    assert nearest(Search(everywhere=True)) > 0.002
    entry = functools.partial(sensor.at_mouth, measured)
    assert nearest(Search(everywhere=True, entries=(entry,))) < 0.0015


def test_a_peg_whose_tip_travels_in_contact_is_in_no_mouth() -> None:
    """It slides on the part, or its contact is false."""
    center, sensor = torch.from_numpy(scene().truth)[None], probe()
    rows = padded(leaning(0.3)[None].repeat(4, 1), 4)
    rows[:, FELT], rows[:, NOISE], rows[:, FORCE], rows[:, EPISODE], rows[:, GIVEN] = 1.0, 3e-5, 5.0, 0.0, 0.0
    rows[:, TIME], rows[:, WRENCH] = 0.1 * torch.arange(4.0).double(), 0.0
    for travel, starts in ((0.001, 1), (0.003, 0)):
        moved = rows.clone()
        moved[:, 0] += travel * torch.arange(4.0).double()
        assert len(sensor.at_mouth([Approximated(2, None, moved)], center)) == starts

"""Torques that no single contact exerts, and the turn that contacts against each other prevent."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.contact.sensing.couple import LEAST, couple_of, turn_against
from bcppl.distributions.episodes import ContactEpisodes
from bcppl.distributions.episodes.couples import coupled, log_blocked
from bcppl.distributions.episodes.rows import COLUMNS, FELT, FORCE, GIVEN, NOISE, TIME, TURN
from bcppl.geometry.gap import PegGap
from bcppl.geometry.holes import fit_in, hole_of
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene

INSIDE = 0.01  # m
FREE = math.log(0.05)


@functools.cache
def scene() -> BenchScene:
    return bench_scene(7, part="square 8 mm")


@functools.cache
def gap() -> PegGap:
    return PegGap(scene().part, scene().peg)


def leaning(angle: float) -> Tensor:
    """A peg half in the hole that leans by so much about the middle of what is inside, (1, 7)."""
    hole = hole_of(scene().part)
    held = torch.from_numpy(fit_in(hole, scene().peg).hole_from_peg)
    mouth = poses.compose(torch.from_numpy(scene().truth), torch.from_numpy(hole.part_from_hole))
    middle, tip = poses.identity(1), poses.identity(1)
    middle[0, 2], tip[0, 2] = -0.5 * INSIDE, -0.5 * INSIDE
    lean = poses.from_rotation_vector(torch.zeros(3).double(), torch.tensor([angle, 0.0, 0.0]).double())
    return poses.compose(poses.compose(poses.compose(poses.compose(mouth, middle), lean), tip), held)


def jammed() -> Tensor:
    """It where it touches the hole's walls on both sides."""
    truth, low, high = torch.from_numpy(scene().truth)[None], 0.0, 0.2
    for _ in range(30):
        angle = 0.5 * (low + high)
        low, high = (angle, high) if float(gap()(truth, leaning(angle)).distance) > 0.0 else (low, angle)
    return leaning(low)


def row(peg: Tensor, turn: Tensor) -> Tensor:
    """One row with a rotation vector (3,) in the world that the contacts are to prevent."""
    rows = torch.zeros(1, COLUMNS, dtype=torch.float64)
    rows[:, :7] = peg
    rows[:, TURN] = (poses.rotation_matrix(peg).transpose(-1, -2) @ turn[None, :, None])[..., 0]
    return rows


def about_the_hole(angle: float) -> Tensor:
    """A rotation vector in the world about the axis by which `leaning` leans."""
    hole = hole_of(scene().part)
    mouth = poses.compose(torch.from_numpy(scene().truth), torch.from_numpy(hole.part_from_hole))
    return angle * poses.rotation_matrix(mouth)[:, 0]


def test_a_force_anywhere_on_the_peg_leaves_no_torque_and_a_couple_is_left_whole() -> None:
    rng = np.random.default_rng(1)
    peg = scene().peg
    place = peg.surface_points(50)
    force = rng.normal(size=(50, 3)) * 10.0
    single = np.hstack([force, np.cross(place, force)])
    assert np.abs(couple_of(single, peg)).max() < 1e-6
    assert (turn_against(single, peg) == 0.0).all()
    # Without a force in all each place leaves the whole torque.
    apart = place - place[::-1]
    pair = np.hstack([np.zeros_like(force), np.cross(apart, force)])
    np.testing.assert_allclose(couple_of(pair, peg), pair[:, 3:], atol=1e-9)


def test_a_turn_is_against_the_couple_and_moves_what_is_as_far_off_as_the_peg_is_wide() -> None:
    peg = scene().peg
    wrench = np.array([[0, 0, 0, 0, 2.0 * LEAST, 0], [0, 0, 0, 0.9 * LEAST, 0, 0]], dtype=float)
    breadth = np.ptp(peg.vertices[:, 0])
    np.testing.assert_allclose(turn_against(wrench, peg), [[0, -0.0004 / breadth, 0], [0, 0, 0]], atol=1e-12)


def test_a_peg_jammed_in_a_hole_is_free_to_turn_back_alone() -> None:
    truth, spread = torch.from_numpy(scene().truth)[None], torch.full((1, 1), 2e-5).double()
    for angle, expected in ((0.05, 0.0), (-0.05, FREE)):
        rows = row(jammed(), about_the_hole(angle))
        logged = log_blocked(gap(), truth, rows, spread)
        torch.testing.assert_close(logged, torch.tensor([expected]).double(), rtol=0.0, atol=0.03)


def test_it_is_the_same_wherever_part_and_peg_are_together() -> None:
    truth, spread = torch.from_numpy(scene().truth)[None], torch.full((1, 1), 2e-5).double()
    rows = row(jammed(), about_the_hole(0.02))
    moved = poses.from_rotation_vector(
        torch.tensor([0.3, -0.2, 0.1]), torch.tensor([0.2, 0.4, -0.7])
    ).double()
    away = rows.clone()
    away[:, :7] = poses.compose(moved, rows[:, :7])
    both = [
        log_blocked(gap(), pose, each, spread)
        for pose, each in ((truth, rows), (poses.compose(moved, truth), away))
    ]
    torch.testing.assert_close(both[0], both[1], rtol=1e-6, atol=1e-6)


def test_a_couple_counts_once_however_rows_are_cut() -> None:
    torch.manual_seed(0)
    truth = poses.retract(torch.from_numpy(scene().truth), 1e-4 * torch.randn(5, 6, dtype=torch.float64))
    rows = row(jammed(), about_the_hole(0.02)).repeat(4, 1)
    rows[:, FELT], rows[:, NOISE], rows[:, FORCE] = 1.0, 3e-5, 10.0
    rows[:, TIME] = 0.1 * torch.arange(4)
    rows[[0, 2, 3], TURN] = torch.tensor([[0.0] * 3, [torch.nan] * 3, [0.0] * 3], dtype=torch.float64)

    def site(value: Tensor) -> Tensor:
        return ContactEpisodes(gap(), truth, len(value), 5e-5, 1e-5, solids=gap()).log_prob(value)

    assert len(coupled(rows)) == 1
    given = rows.clone()
    given[:2, GIVEN] = 1.0
    torch.testing.assert_close(site(rows[:2]) + site(given), site(rows), rtol=1e-9, atol=1e-9)
    without = rows.clone()
    without[:, TURN] = 0.0
    spoken = site(rows) - site(without)
    assert bool((spoken <= 0.0).all()) and bool((spoken >= FREE - 1e-9).all())

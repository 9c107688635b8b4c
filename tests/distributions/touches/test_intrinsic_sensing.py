"""Posteriors of contact locations: closed forms, coverage, physics."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.contact.physics import PegPhysics
from bcppl.contact.probe_rollout import ProbeRollout
from bcppl.contact.sensing.intrinsic import IntrinsicSensing
from bcppl.contact.sensing.load import transform_wrench
from bcppl.contact.sensing.location import ContactSensing
from bcppl.contact.sensing.noise import WrenchNoise, noise_at_rest, variance_gain
from bcppl.contact.sensing.surface_posterior import CORNER, EDGE, FACE
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, round_peg
from bcppl.geometry.parts import Part, Piece
from bcppl.robot.motion import Probe
from tests.contact.pressed_pegs import COVARIANCE, PEG, fork, noisy, pressed, wrench


def test_a_line_through_a_known_point_locates_it() -> None:
    tiny = WrenchNoise(1e-4, 1e-6).covariance()
    for peg in (PEG, round_peg(0.008, 0.05), fork()):
        points, normals, seen = pressed(peg, 60, seed=0)
        candidates = IntrinsicSensing(peg, friction=0.6).candidates(seen, tiny)
        near = np.linalg.norm(candidates.location - points[:, None], axis=-1)
        best = np.nanargmin(near, axis=1)
        rows = np.arange(60)
        assert np.quantile(near[rows, best], 0.95) < 1e-6
        assert np.sum(candidates.normal[rows, best] * normals, axis=1).min() > 0.99
        np.testing.assert_allclose(candidates.probability.sum(axis=1), 1.0, atol=0.03)


def test_all_candidates_are_kept_where_a_line_enters_twice() -> None:
    sensing = IntrinsicSensing(fork(), friction=0.5)
    seen = wrench(np.array([[-0.012, 0.002, -0.03]]), np.array([[8.0, 0.5, 0.3]]))
    candidates = sensing.candidates(seen, COVARIANCE)
    assert candidates.count[0] == 2 and (candidates.kind[0, :2] == FACE).all()
    assert sorted(np.round(candidates.location[0, :2, 0], 6)) == [-0.012, 0.006]
    assert np.abs(candidates.normal[0, :2] - [-1, 0, 0]).max() < 1e-9
    # Both lie on the line of action.
    step = candidates.location[0, 1] - candidates.location[0, 0]
    assert np.linalg.norm(np.cross(step, seen[0, :3])) / np.linalg.norm(step) / 8.0 < 0.01
    np.testing.assert_allclose(candidates.probability[0].sum(), 1.0, atol=1e-6)


def test_edges_and_corners_are_candidates_where_no_face_stands_in_the_cone() -> None:
    sensing = IntrinsicSensing(PEG, friction=0.3)
    points = np.array([[0.008, 0.003, -0.05], [0.008, 0.008, -0.05]])
    seen = wrench(points, np.array([[-5.0, 0.0, 5.0], [-4.0, -4.0, 4.0]]))
    candidates = sensing.candidates(seen, COVARIANCE)
    assert candidates.kind[:, 0].tolist() == [EDGE, CORNER]
    np.testing.assert_allclose(candidates.location[:, 0], points, atol=1e-4)
    # Beside the edge by a third of a millimetre, which the noise may well do, is still the edge.
    beside = wrench(points[:1] + np.array([0.0002, 0.0, -0.0002]), seen[:1, :3])
    np.testing.assert_allclose(sensing.candidates(beside, COVARIANCE).location[:, 0], points[:1], atol=2e-4)
    # Beside it by 10 mm is no contact with this peg.
    assert (
        sensing.candidates(wrench(points[:1] + np.array([0.01, 0.0, 0.0]), seen[:1, :3]), COVARIANCE).count[0]
        == 0
    )


def test_the_covariance_is_that_of_the_line_across_a_face() -> None:
    """On a face that is pushed squarely, far from its edges, an error e of the torque moves by e / f."""
    sensing = IntrinsicSensing(block((0.2, 0.2, 0.02)), friction=0.5, shares=(1, 0, 0))
    force, torque = 0.05, 0.002
    candidates = sensing.candidates(
        wrench(np.zeros((1, 3)), np.array([[0, 0, -10.0]])), WrenchNoise(force, torque).covariance()
    )
    across = (torque / 10.0) ** 2
    np.testing.assert_allclose(
        candidates.covariance[0, 0], np.diag([across, across, 0.0]), rtol=0.01, atol=1e-14
    )
    np.testing.assert_allclose(candidates.location[0, 0], 0.0, atol=1e-9)


def test_the_stated_region_holds_nine_in_ten() -> None:
    rng = np.random.default_rng(4)
    errors, levels = [], []
    for peg in (PEG, round_peg(0.008, 0.05, sides=24), fork()):
        points, normals, seen = pressed(peg, 150, seed=5)
        sensing = IntrinsicSensing(peg, friction=0.5, shares=(1, 0, 0))
        read = noisy(seen, rng)
        posterior = sensing.posterior(read, COVARIANCE)
        levels.append(sensing.credible_level(posterior, read, COVARIANCE, points, normals[:, None]))
        errors.append(np.linalg.norm(posterior.candidates().location[:, 0] - points, axis=1))
        held = np.bincount(posterior.nodes.row, posterior.mass * posterior.region(0.9), len(points))
        assert (held >= 0.9).all() and np.median(held) < 0.93
    level = np.concatenate(levels)
    assert 0.85 < np.mean(level < 0.9) < 0.95 and 0.42 < np.mean(level < 0.5) < 0.58
    assert np.median(np.concatenate(errors)) < 0.0005
    # The mutant: noise that is stated at half its size covers too little.
    half = COVARIANCE / 4.0
    posterior = sensing.posterior(read, half)
    level = sensing.credible_level(posterior, read, half, points, normals[:, None])
    assert np.mean(level < 0.9) < 0.75


def test_candidates_turn_with_the_peg_and_do_not_depend_on_the_batch() -> None:
    _, _, seen = pressed(PEG, 30, seed=6)
    seen = noisy(seen, np.random.default_rng(7))
    sensing = IntrinsicSensing(PEG, friction=0.5)
    whole = sensing.candidates(seen, COVARIANCE)
    for rows in (slice(0, 1), slice(1, 12), slice(12, 30)):
        part = sensing.candidates(seen[rows], COVARIANCE)
        for name in ("location", "covariance", "probability", "kind"):
            np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[rows])
    # The same peg and wrenches in another frame, and with a covariance that is turned with them.
    turn = Rotation.from_rotvec([0.5, -0.8, 0.3])
    to = np.array([0.02, 0.01, -0.03, *turn.as_quat()[[3, 0, 1, 2]]])
    moved = Part("moved", turn.apply(PEG.vertices) + to[:3], PEG.faces)
    carry = np.stack([transform_wrench(axis, to) for axis in np.eye(6)], axis=1)
    other = IntrinsicSensing(moved, friction=0.5).candidates(
        transform_wrench(seen, to), carry @ COVARIANCE @ carry.T
    )
    there = turn.apply(whole.location[:, 0]) + to[:3]
    # The grid of lines is laid out differently, so the sums differ by a little.
    assert np.quantile(np.linalg.norm(other.location[:, 0] - there, axis=1), 0.9) < 5e-5


def test_a_pin_in_simulated_contact_is_located() -> None:
    """A single contact of the engine's: the peg's tip is pressed on a pin's point."""
    tip = np.array([[0.0, 0, 0], [0.005, 0.005, -0.01], [-0.005, 0.005, -0.01], [0, -0.005, -0.01]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    pin = Part("pin", tip, faces, (Piece("hull", tip),))
    command = np.tile([0.003, -0.002, 0.06, 1.0, 0, 0, 0], (3, 1))
    command[1:, 2] = 0.044
    stiffness, damping = np.repeat([1000.0, 500.0], 3), np.repeat([400.0, 18.0], 3)
    probe = Probe("pin", np.array([0, 0.7, 1.5]), command, stiffness, damping, np.arange(150) / 100.0)
    part = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64)
    rollout = ProbeRollout.start(PegPhysics(pin, PEG), ContactSensing(PEG, rate=100.0), part, probe)
    pose = rollout.window(0, 150)[1][0, -1]
    truth = poses.transform(poses.inverse(pose), torch.zeros(1, 3, dtype=torch.float64))[0].numpy()
    exact = rollout.wrench(149, 150)[0].numpy()
    assert np.linalg.norm(exact[0, :3]) > 3.0
    sensing = IntrinsicSensing(PEG, friction=0.5)
    candidates = sensing.candidates(exact, COVARIANCE)
    assert candidates.kind[0, 0] == FACE and np.linalg.norm(candidates.location[0, 0] - truth) < 1e-4
    read = noisy(np.repeat(exact, 300, axis=0), np.random.default_rng(8))
    posterior = sensing.posterior(read, COVARIANCE)
    place, normal = np.tile(candidates.location[0, 0], (300, 1)), np.tile([[[0.0, 0, -1]]], (300, 1, 1))
    assert 0.83 < np.mean(sensing.credible_level(posterior, read, COVARIANCE, place, normal) < 0.9) < 0.97


def test_uninformative_wrenches_have_no_candidates_and_bad_ones_are_refused() -> None:
    sensing = IntrinsicSensing(PEG)
    _, _, seen = pressed(PEG, 5, seed=9)
    seen[1], seen[3], seen[4] = np.nan, 0.0, 0.01 * seen[4]
    candidates = sensing.candidates(seen, COVARIANCE)
    assert (candidates.count > 0).tolist() == [True, False, True, False, False]
    assert np.isneginf(sensing.posterior(seen, COVARIANCE).log_evidence[[1, 3]]).all()
    assert sensing.candidates(np.empty((0, 6)), COVARIANCE).count.shape == (0,)
    clean = pressed(PEG, 5, seed=9)[2] * [1, 1, 1, 1000, 1000, 1000]
    with pytest.raises(InputError, match="N mm"):
        sensing.candidates(clean, COVARIANCE)
    with pytest.raises(InputError, match="not symmetric"):
        sensing.candidates(seen, COVARIANCE + np.triu(np.full((6, 6), 1e-4), 1))
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        sensing.candidates(seen, np.zeros((6, 6)))
    for most, least in ((0, 0.1), (2.5, 0.1), (8, math.nan), (8, 1.0)):
        with pytest.raises(InputError, match="candidates are given"):
            sensing.candidates(seen, COVARIANCE, most, least)
    # The noise of single samples stands for its covariance.
    noise = WrenchNoise(0.05, 0.002)
    np.testing.assert_array_equal(
        sensing.candidates(seen, noise).location, sensing.candidates(seen, noise.covariance()).location
    )


def test_noise_is_estimated_and_filtered() -> None:
    rng = np.random.default_rng(10)
    seen = noise_at_rest(noisy(np.zeros((4000, 6)), rng, WrenchNoise(0.2, 0.01).covariance()))
    assert seen.force == pytest.approx(0.2, rel=0.03) and seen.torque == pytest.approx(0.01, rel=0.03)
    sensing = ContactSensing(PEG, rate=100.0, tare=0, cutoff=20.0)
    filtered, _ = sensing.clean(rng.normal(size=(20, 2000, 6)), sensing.start(20))
    assert variance_gain(sensing.sections) == pytest.approx(float(filtered.var()), rel=0.03)
    assert variance_gain(replace(sensing, cutoff=None).sections) == 1.0

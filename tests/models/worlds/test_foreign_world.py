"""Recordings of a foreign world are true in contact; faults are what they are named."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bcppl.errors import InputError
from bcppl.recordings import problems

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from foreign import check, faults, world

TICKS = 10  # of the controller between stamps at 100 Hz


@pytest.fixture(scope="module")
def scene():
    return world.scene_of(3)


@pytest.fixture(scope="module")
def log(scene):
    return world.log_of(scene, "taps", "softer")


@pytest.fixture(scope="module")
def recording(scene, log):
    return world.recording_of(scene, "taps", "softer", 500, log)


def joined(recording, name):
    return np.concatenate([getattr(m.observation, name) for m in recording.measurements[2:]])


def spans(depth):
    """First and last ticks of touches, which an interval of 60 ms parts."""
    ticks = np.flatnonzero(depth > 0.0)
    return [(part[0], part[-1]) for part in np.split(ticks, 1 + np.flatnonzero(np.diff(ticks) > 60))]


@pytest.mark.long
def test_gap_at_the_true_poses_is_the_penetration_in_contact_and_positive_elsewhere(scene, log, recording):
    fewer = faults.resampled(recording, 100)
    windows = [
        replace(m, observation=replace(m.observation, world_from_peg=exact))
        for m, exact in zip(fewer.measurements[2:], np.split(log.world_from_peg[::TICKS], 12), strict=True)
    ]
    exact = check.gaps_of(replace(fewer, measurements=[*scene.views, *windows]))
    depth = log.depth[::TICKS]
    touching = depth > 0.0
    assert touching.sum() > 20
    # On a bevelled edge the two measure the depth along other directions.
    np.testing.assert_allclose(exact.gap[touching], -depth[touching], rtol=0.2, atol=2e-6)
    assert np.median(np.abs(exact.gap + depth)[touching]) < 1e-7
    assert exact.gap[~touching].min() > -1e-6
    assert exact.contact.sum() > 10 and touching[exact.contact].all()


def test_six_taps_of_40_to_60_ms_push_the_peg_out_of_the_part(scene, log):
    touches = spans(log.depth)
    assert len(touches) == 6
    assert all(35 <= last - first <= 65 for first, last in touches)
    turn = Rotation.from_quat(scene.truth[3:], scalar_first=True)
    up, free = turn.apply([0.0, 0.0, 1.0]), np.median(log.wrench[:300, :3], axis=0)
    for k, (first, last) in enumerate(touches):
        at = slice(first + 10, last)
        into_world = Rotation.from_quat(log.world_from_peg[at, 3:], scalar_first=True)
        force = into_world.apply(log.wrench[at, :3] - free).mean(axis=0)
        back = log.world_from_peg[last + 30, :3] - log.world_from_peg[last, :3]
        assert force @ back / np.linalg.norm(back) > 2.0  # N, the way that the peg then retreats
        assert (force @ up > 2.0) == (k < 3)


def test_truth_is_within_the_guess_and_measurements_have_no_problem(recording):
    assert problems(recording) == []
    for seed in range(3):
        scene = world.scene_of(seed)
        guess = scene.guess
        assert (np.abs(scene.truth[:3] - guess.world_from_part[:3]) <= guess.translation).all()
        turns = [Rotation.from_quat(p[3:], scalar_first=True) for p in (guess.world_from_part, scene.truth)]
        away = (turns[0].inv() * turns[1]).as_matrix()
        assert np.arccos(away[2, 2]) < guess.tilt
        assert abs(np.arctan2(away[1, 0] - away[0, 1], away[0, 0] + away[1, 1])) < guess.yaw


@pytest.mark.parametrize("seconds, count", [(0.01, 600), (0.1, 60), (0.5, 12), (6.0, 1)])
def test_a_probe_cut_otherwise_is_the_same_probe(recording, seconds, count):
    cut = faults.recut(recording, seconds)
    assert problems(cut) == [] and len(cut.measurements) == 2 + count
    for name in ("times", "wrench", "world_from_peg"):
        np.testing.assert_array_equal(joined(cut, name), joined(recording, name))


def test_a_probe_read_less_often_is_what_is_recorded_at_that_rate(scene, log, recording):
    fewer = faults.resampled(recording, 100)
    slow = world.recording_of(scene, "taps", "softer", 100, log)
    for one, other in zip(fewer.measurements[2:], slow.measurements[2:], strict=True):
        assert (one.action.first, one.action.last) == (other.action.first, other.action.last)
        np.testing.assert_array_equal(one.observation.wrench, other.observation.wrench)
        np.testing.assert_array_equal(one.action.probe.stamps, other.action.probe.stamps)
    with pytest.raises(InputError, match="does not divide"):
        faults.resampled(recording, 150)


@pytest.mark.parametrize("name", faults.FAULTS)
def test_faulty_recordings_have_no_problem_that_a_check_of_the_file_reports(recording, name):
    faulty = faults.FAULTS[name](recording)
    faulty.part.check()
    assert problems(faulty) == []


@pytest.mark.long
def test_a_moved_part_is_touched_where_it_was_moved_to(recording):
    slow = faults.resampled(recording, 50)
    moved = faults.part_moved(slow, 0.02, 0.7)
    shift = 0.02 * np.array([np.cos(0.7), np.sin(0.7), 0.0])
    away = joined(moved, "world_from_peg") - joined(slow, "world_from_peg")
    np.testing.assert_allclose(away[-1, :3], shift, atol=1e-12)
    np.testing.assert_array_equal(away[0], 0.0)
    later = replace(moved, truth=moved.truth + np.append(shift, np.zeros(4)))
    before, after = check.gaps_of(moved), check.gaps_of(later)
    second = np.linalg.norm(away[:, :3], axis=1) > 0.01
    contact = before.contact
    assert (contact & second).sum() >= 3 and (contact & ~second).sum() >= 3
    assert np.abs(before.gap[contact & ~second]).max() < 2.5e-4
    assert np.abs(after.gap[contact & second]).max() < 2.5e-4
    assert np.abs(before.gap[contact & second]).max() > 1e-3


def test_the_truth_is_as_far_from_the_guess_as_named(recording):
    for fault, far in ((faults.truth_outside, 0.03), (faults.truth_at_edge, 0.0199)):
        away = fault(recording).truth[:3] - fault(recording).guess.world_from_part[:3]
        assert abs(away[0]) == pytest.approx(far, abs=1e-12)


def test_wrong_meshes_are_closed_and_are_not_the_part(recording):
    part = recording.part
    mirrored, turned = faults.part_mirrored(recording).part, faults.part_turned(recording).part
    larger = faults.part_scaled(recording).part
    for other, factor in ((mirrored, 1.0), (turned, 1.0), (larger, 1.1)):
        assert other.mesh.is_volume
        assert other.mesh.volume == pytest.approx(factor**3 * part.mesh.volume, rel=1e-6)
        hulls = np.concatenate([piece.size for piece in other.pieces])
        np.testing.assert_allclose(hulls.min(axis=0), other.vertices.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(turned.extent, part.extent[[1, 0, 2]], atol=1e-9)


def test_repeated_displaced_and_hidden_measurements(recording):
    assert [m.kind for m in faults.view_repeated(recording).measurements[:12]] == ["view"] * 11 + ["window"]
    again = faults.touches_repeated(recording)
    assert {m.action.probe.name for m in again.measurements[2:]} == {"taps", "taps, again 1"}
    first, off = (r.measurements[0].action.camera for r in (recording, faults.camera_off(recording)))
    assert np.linalg.norm(off.world_from_camera[:3] - first.world_from_camera[:3]) == pytest.approx(0.015)
    seen, hidden = (r.measurements[0].observation.depth for r in (recording, faults.part_occluded(recording)))
    shown = recording.background[first.name] - seen > 0.01
    shown &= seen < np.nanquantile(seen[shown], 0.5) + 0.08
    assert 0.25 < (hidden[shown] < seen[shown] - 0.01).mean() < 0.42

"""Gravity compensation, contact onset detection, and both on real pushes."""

from __future__ import annotations

import doctest
import functools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.contact.physics import PegPhysics
from bcppl.contact.probe_rollout import ProbeRollout
from bcppl.contact.sensing.load import identify_load, transform_wrench
from bcppl.contact.sensing.location import ContactSensing
from bcppl.contact.sensing.onset import OnsetDetector
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.extrusion import block
from bcppl.recordings.importers.point_probe import LoggedPush, force_on_object, prism, read_log
from bcppl.robot.motion import Probe
from tests.contact.pressed_pegs import LOAD, LOGS, PEG, noisy, orientations

# ---------------------------------------------------------------- weight


def test_a_weight_in_closed_form() -> None:
    # Upside down, and lying with its z axis along the world's x.
    pose = np.array([[0, 0, 0, 1.0, 0, 0, 0], [0, 0, 0, 0, 1.0, 0, 0], [1, 2, 3, 0.5**0.5, 0, 0.5**0.5, 0]])
    pull = 0.8 * 9.80665
    force = np.array([[0, 0, -pull], [0, 0, pull], [pull, 0, 0]])
    np.testing.assert_allclose(LOAD.weight(pose)[:, :3], force, atol=1e-12)
    np.testing.assert_allclose(LOAD.weight(pose)[:, 3:], np.cross([0.01, -0.02, -0.05], force), atol=1e-12)


def test_a_load_is_identified_with_the_stated_covariance() -> None:
    rng, bias = np.random.default_rng(0), np.array([5.0, -3.0, 8.0, 0.2, -0.1, 0.3])
    truth, errors = np.concatenate([[LOAD.mass], LOAD.center, bias]), []
    for _ in range(300):
        pose = orientations(10, rng)
        estimate = identify_load(noisy(LOAD.weight(pose) + bias, rng), pose)
        errors.append(
            (np.array([estimate.load.mass, *estimate.load.center, *estimate.bias]) - truth)
            / estimate.standard_deviation
        )
    # Student's t of 26 degrees of freedom: its deviation is 1.04.
    np.testing.assert_allclose(np.std(errors, axis=0), 1.04, atol=0.15)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.2
    exact = identify_load(LOAD.weight(pose) + bias, pose)
    np.testing.assert_allclose([exact.load.mass, *exact.load.center, *exact.bias], truth, atol=1e-9)
    # The mutants: the sensor's pose the wrong way round, and forces of the hand on the tool.
    inverse = poses.inverse(torch.from_numpy(pose)).numpy()
    assert identify_load(LOAD.weight(inverse) + bias, pose).noise[0] > 0.5
    with pytest.raises(InputError, match="wrong sign"):
        identify_load(-LOAD.weight(pose), pose)


def test_bad_static_readings_are_refused() -> None:
    rng = np.random.default_rng(1)
    pose = orientations(8, rng)
    weight = LOAD.weight(pose)
    with pytest.raises(InputError, match="N mm"):
        identify_load(weight * [1, 1, 1, 1000, 1000, 1000], pose)
    with pytest.raises(InputError, match="four or more"):
        identify_load(weight[:3], pose[:3])
    with pytest.raises(InputError, match="same tilt"):
        identify_load(weight, np.tile(pose[:1], (8, 1)))
    with pytest.raises(InputError, match="not finite"):
        identify_load(np.where(np.arange(6) == 2, np.nan, weight), pose)


def test_a_simulated_wrench_with_the_tools_weight_and_a_bias_reads_as_without() -> None:
    """Gravity off first, then the tare: the other way round, the weight at rest would be taken off twice."""
    command = np.zeros((5, 7))
    command[:, 2] = [0.06, 0.06, 0.06, 0.046, 0.046]
    command[:, 3:] = Rotation.from_euler(
        "yx", [[0, 0], [0, 0], [20, 0], [20, 0], [20, 10]], degrees=True
    ).as_quat()[:, [3, 0, 1, 2]]
    stiffness, damping = np.repeat([1000.0, 5000.0], 3), np.repeat([720.0, 18.0], 3)
    stamps = np.arange(0.0, 1.8, 0.01)
    probe = Probe("lean", np.array([0.0, 0.2, 0.6, 1.0, 1.8]), command, stiffness, damping, stamps)
    sensing = ContactSensing(PEG, rate=100.0)
    part = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64)
    rollout = ProbeRollout.start(PegPhysics(block((0.2, 0.2, 0.02)), PEG), sensing, part, probe)
    simulated, pose = rollout.window(0, 180)
    raw = rollout.wrench(0, 180)[0].numpy()
    heavy = raw + LOAD.weight(pose[0].numpy()) + np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])
    touch = Touch(stamps, heavy, pose[0].numpy())
    loaded = replace(sensing, load=LOAD)
    ((locations, _),) = loaded.measure([touch])
    assert torch.isfinite(locations).all(dim=-1).sum() > 30
    torch.testing.assert_close(locations, simulated[0], atol=1e-7, rtol=0, equal_nan=True)
    np.testing.assert_allclose(loaded.tared([touch])[0][10:], raw[10:], atol=1e-9)
    with pytest.raises(InputError, match="N mm"):
        loaded.measure([Touch(stamps, heavy * [1, 1, 1, 1000, 1000, 1000], pose[0].numpy())])
    ((without, _),) = sensing.measure([touch])
    assert not torch.allclose(without, simulated[0], atol=1e-3, equal_nan=True)


def test_weights_in_no_orientation_are_refused() -> None:
    for bad in (np.zeros(7), np.array([0, 0, 0, 2.0, 0, 0, 0]), np.full(7, np.nan)):
        with pytest.raises(InputError, match=r"unit|finite"):
            LOAD.weight(bad)
        with pytest.raises(InputError, match=r"unit|finite"):
            transform_wrench(np.ones(6), bad)


def test_wrenches_of_frames_that_turn_are_each_transformed() -> None:
    rng = np.random.default_rng(0)
    wrench = rng.normal(size=(5, 6))
    turns = Rotation.random(5, rng=rng).as_quat()[:, [3, 0, 1, 2]]
    pose = np.concatenate([rng.normal(size=(5, 3)), turns], axis=1)
    each = [transform_wrench(one, to) for one, to in zip(wrench, pose, strict=True)]
    np.testing.assert_allclose(transform_wrench(wrench, pose), each, atol=1e-14)
    twist = rng.normal(size=(5, 6))  # the power of a wrench is the same in either frame
    turn, place = Rotation.from_quat(pose[:, [4, 5, 6, 3]]), pose[:, :3]
    angular = turn.apply(twist[:, 3:])
    linear = turn.apply(twist[:, :3]) + np.cross(place, angular)
    power = (transform_wrench(wrench, pose) * np.concatenate([linear, angular], axis=1)).sum(axis=1)
    np.testing.assert_allclose(power, (wrench * twist).sum(axis=1), atol=1e-12)
    with pytest.raises(InputError, match="one for each wrench"):
        transform_wrench(wrench, pose[:3])


def test_the_example_of_the_documentation_runs() -> None:
    page = Path(__file__).parents[2] / "docs/simulators.md"
    failed, tried = doctest.testfile(str(page), module_relative=False)
    assert failed == 0 and tried > 20


# ---------------------------------------------------------------- onset


@pytest.mark.parametrize(("size", "slope"), [(3.0, 0.0), (4.0, 0.0), (8.0, 0.0), (0.0, 0.3), (0.0, 0.04)])
def test_a_force_that_lasts_is_one_contact(size: float, slope: float) -> None:
    times = np.arange(1000) / 100.0
    for seed in range(3):
        force = np.random.default_rng(seed).normal(size=(1000, 3))
        force[300:, 2] += size + slope * np.arange(700)
        (onset,) = OnsetDetector().onsets(times, force)
        assert 300 <= onset.alarm < 500 and onset.end == 1000


def test_contact_is_over_soon_after_it_ends() -> None:
    late, times = [], np.arange(800) / 100.0
    for seed in range(20):
        force = np.random.default_rng(seed).normal(size=(800, 3))
        force[300:500, 0] += 4.0
        force[650:700, 1] -= 8.0
        first, second = OnsetDetector(rest=30).onsets(times, force)
        assert first.alarm < first.end < second.alarm < second.end
        late += [first.end - 500, second.end - 700]
    assert min(late) >= -3 and np.quantile(late, 0.9) <= 6 and max(late) <= 30


def test_the_onset_of_a_step_or_a_slow_rise_has_the_stated_error() -> None:
    """A step is seen only at samples: what it is message to lie off by is a third of their distance."""
    rng, times = np.random.default_rng(5), np.arange(250.0)
    for step, slope in ((20.0, 0.0), (0.0, 0.3)):
        scores, spreads = [], []
        for _ in range(60):
            began = 150.0 + rng.uniform()
            height = np.where(times > began, step + slope * (times - began), 0.0)
            force = rng.normal(size=(250, 3)) + height[:, None] * np.array([0.6, 0.0, 0.8])
            (onset,) = OnsetDetector().onsets(times, force)
            scores.append((onset.time - began) / onset.standard_deviation)
            spreads.append(onset.standard_deviation)
        assert abs(np.mean(scores)) < 0.6 and 0.75 < np.std(scores) < 1.3
        assert step == 0.0 or np.median(spreads) == pytest.approx(12.0**-0.5, abs=0.06)


def test_rows_that_are_missing_at_the_start_are_passed_over() -> None:
    times, force = np.arange(300) / 100.0, np.random.default_rng(6).normal(size=(300, 3))
    force[150:, 0] += 20.0
    (plain,) = OnsetDetector().onsets(times[20:], force[20:])
    (padded,) = OnsetDetector().onsets(times, np.where(np.arange(300)[:, None] < 20, np.nan, force))
    assert (padded.alarm, padded.end) == (plain.alarm + 20, plain.end + 20)
    assert (padded.time, padded.standard_deviation) == (plain.time, plain.standard_deviation)
    force[200, 1] = np.inf
    with pytest.raises(InputError, match="not finite at row 200"):
        OnsetDetector().onsets(times, force)


@pytest.mark.parametrize(
    "bad",
    [
        {"limit": math.nan},
        {"drift": math.inf},
        {"rest": 10.5},
        {"rest": 4},
        {"before": math.nan},
        {"after": -1},
        {"quiet": 0},
        {"threshold": math.nan},
        {"release": 1.5},
        {"resolution": -1.0},
    ],
)
def test_settings_out_of_range_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"{next(iter(bad))} = "):
        OnsetDetector(**bad)


def test_the_time_of_onset_has_the_stated_error() -> None:
    rng, detector, times = np.random.default_rng(2), OnsetDetector(), np.arange(250) / 100.0
    for slope in (20.0, 400.0):
        scores = []
        for _ in range(120):
            began, way = 1.5 + rng.uniform(0, 0.01), rng.normal(size=3)
            force = slope * np.maximum(times - began, 0.0)[:, None] * way / np.linalg.norm(way)
            (onset,) = detector.onsets(times, force + 0.1 * rng.normal(size=force.shape) + [4.0, -2.0, 7.0])
            assert times[onset.alarm] > began and onset.end == 250
            scores.append((onset.time - began) / onset.standard_deviation)
        assert 0.8 < np.std(scores) < 1.25 and abs(np.mean(scores)) < 0.4
    # Nothing later than the alarm decides about the alarm.
    cut = detector.onsets(
        times[: onset.alarm + 1], (force + 0.1 * rng.normal(size=force.shape))[: onset.alarm + 1]
    )
    assert len(cut) <= 1


def test_two_touches_are_two_onsets_and_silence_is_none() -> None:
    rng, times = np.random.default_rng(3), np.arange(600) / 100.0
    calm = 0.1 * rng.normal(size=(600, 3))
    assert OnsetDetector().onsets(times, calm) == []
    touched = calm.copy()
    touched[200:300, 2] += 5.0
    touched[400:450, 0] -= 3.0
    # Around the threshold the force goes up and down: hysteresis makes one contact of it.
    touched[400:450:3, 0] += 1.3
    for detector in (OnsetDetector(), OnsetDetector(threshold=1.6, release=0.5)):
        first, second = detector.onsets(times, touched)
        assert abs(first.alarm - 200) <= 1 and abs(second.alarm - 400) <= 2
        assert abs(first.end - 300) <= 1 and abs(second.end - 450) <= 1
        assert abs(first.time - 1.995) < 0.006 and first.standard_deviation < 0.006


def test_bad_forces_have_no_onset() -> None:
    times, force = np.arange(50) / 100.0, np.random.default_rng(0).normal(size=(50, 3))
    for bad, message in (
        (np.zeros((50, 3)), "all equal"),
        (force[:8], "too short"),
        (force * np.nan, "too short"),
        (np.where(np.arange(50)[:, None] == 30, np.nan, force), "not finite at row 30"),
    ):
        with pytest.raises(InputError, match=message):
            OnsetDetector().onsets(times[: len(bad)], bad)


# ---------------------------------------------------------------- real pushes


@functools.cache
def logged() -> list[LoggedPush]:
    files = sorted(LOGS.glob("10_*"))
    if not files:
        pytest.skip(f"the push logs are not at {LOGS}")
    return [push for file in files for push in read_log(file)]


@functools.cache
def distance() -> SignedDistance:
    return SignedDistance(prism())


def inside(push: LoggedPush, time: float) -> tuple[float, np.ndarray]:
    """How far inside the triangle (mm) the recorded tip is at a time; the inward normal in the base frame."""
    tip = np.array([np.interp(time, push.tip_times, push.base_from_tip[:, k].numpy()) for k in range(3)])
    local = poses.transform(poses.inverse(push.base_from_object), torch.from_numpy(tip)[None])
    near = distance()(local)
    normal = poses.rotation_matrix(push.base_from_object) @ near.normal[0]
    return -1e3 * float(near.distance[0]), -normal.numpy()


def test_real_onsets_lie_where_the_data_page_states() -> None:
    pushes = logged()
    by_force = [OnsetDetector(threshold=0.6).onsets(p.force_times, p.force) for p in pushes]
    assert [onset[0].alarm for onset in by_force] == [push.onset for push in pushes]
    depth = np.array([inside(p, p.force_times[f[0].alarm])[0] for p, f in zip(pushes, by_force, strict=True)])
    assert depth.mean() == pytest.approx(0.6, abs=0.05) and depth.std() == pytest.approx(0.6, abs=0.05)
    assert depth.max() < 2.4
    # With only the sensor's quantum, the detector is a few rows earlier and never late.
    adaptive = [OnsetDetector(resolution=0.02).onsets(p.force_times, p.force)[0] for p in pushes]
    early = [f[0].alarm - a.alarm for f, a in zip(by_force, adaptive, strict=True)]
    assert min(early) >= 0 and max(early) <= 5
    began = np.array([inside(p, a.time)[0] for p, a in zip(pushes, adaptive, strict=True)])
    assert began.mean() < depth.mean() and began.std() == pytest.approx(0.6, abs=0.05)


def test_real_forces_scatter_within_the_friction_cone_of_the_edge() -> None:
    leans = []
    for push in logged():
        # As for the peg: tared by `ContactSensing`, the onset by the detector.
        raw = np.pad(force_on_object(push), ((0, 0), (0, 3)))
        plain = ContactSensing(PEG, rate=100.0, tare=10, cutoff=None)
        cleaned, _ = plain.clean(raw[None], plain.start(1))
        ((alarm, *_),) = [
            [f.alarm for f in OnsetDetector(threshold=0.6).onsets(push.force_times, raw[:, :3])]
        ]
        force = cleaned[0, alarm : alarm + 5, :2].mean(axis=0)
        _, inward = inside(push, push.force_times[alarm])
        lean = np.arctan2(force[1], force[0]) - np.arctan2(inward[1], inward[0])
        leans.append(np.degrees(np.remainder(lean + np.pi, 2 * np.pi) - np.pi))
    lean, cone = np.array(leans), np.degrees(np.arctan(0.4))
    assert np.abs(lean).max() < cone + 6.0 and np.mean(np.abs(lean) < cone + 3.0) >= 0.9
    # To both sides of the normal they reach 20 to 26 degrees.
    for side in (lean[lean > 0], -lean[lean < 0]):
        assert len(side) > 30 and 20.0 < np.quantile(side, 0.9) < 26.0

"""The point probe: simulated pushes, learnt settings, and real pushes."""

import math
from dataclasses import replace
from pathlib import Path as File

import numpy as np
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.distance import SignedDistance
from bcppl.models.point_probe import estimate_settings, model, prepare
from bcppl.models.worlds.point_probe import noise_seed
from bcppl.recordings.importers.point_probe import command
from bcppl.sensors import Measurement, Push, Recording
from bcppl.sensors.likelihoods.point_finger import FingerSettings, contact_of
from bcppl.traces import assess, generate

LOGS = File(__file__).parents[3] / "shared/data/point_probe_pushes"


def t(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


# ---------------------------------------------------------------- the program


def log_likelihood(recording: Recording, pose: Tensor, **settings: object) -> Tensor:
    """Log-likelihood (N,) of a recording's pushes at poses (N, 7)."""
    scene = prepare(recording, **settings)
    observed = scene.observed(recording.measurements)
    actions = [m.action for m in recording.measurements]
    choices = {**observed, "part": pose}
    return assess(model.program, (scene, actions), choices, len(pose)) - scene.prior.log_prob(pose)


def around(truth: Tensor, step: float) -> Tensor:
    """The true pose, then poses (7, 7 in all) a step to either side in x and y (m) and yaw (step / 0.1 m)."""
    tangent = torch.zeros(7, 6, dtype=torch.float64)
    for k, axis in enumerate((0, 1, 5)):
        tangent[1 + 2 * k, axis] = step * (10.0 if axis == 5 else 1.0)
        tangent[2 + 2 * k] = -tangent[1 + 2 * k]
    return poses.retract(truth, tangent)


def moved(recording: Recording, by: Tensor) -> Recording:
    """The same recording in a world that is moved by a pose (7,): everything that is stated in the world."""
    turn = poses.rotation_matrix(by).numpy()

    def wrench(touch: Touch) -> Touch:
        turned = np.concatenate([touch.wrench[:, :3] @ turn.T, touch.wrench[:, 3:] @ turn.T], axis=1)
        return Touch(touch.times, turned, touch.world_from_peg)

    def there(pose: np.ndarray) -> np.ndarray:
        return poses.compose(by, torch.from_numpy(pose)).numpy()

    return replace(
        recording,
        guess=replace(recording.guess, world_from_part=there(recording.guess.world_from_part)),
        truth=there(recording.truth),
        measurements=[
            Measurement(Push(m.action.times, there(m.action.world_from_tip)), wrench(m.observation))
            for m in recording.measurements
        ],
    )


@pytest.mark.parametrize("use_free_path", [False, True])
def test_the_program_explains_what_it_simulates(use_free_path: bool) -> None:
    recording = model.simulate_recording(3, pushes=8, use_free_path=use_free_path)
    likelihood = log_likelihood(
        recording, around(torch.from_numpy(recording.truth), 0.002), use_free_path=use_free_path
    )
    assert float(likelihood[0]) > float(likelihood[1:].max()) + 5.0


def test_a_simulated_recording_is_read_back() -> None:
    recording = model.simulate_recording(5, pushes=12)
    scene = prepare(recording)
    actions = [m.action for m in recording.measurements]
    torch.manual_seed(noise_seed(5))
    trace, _ = generate(model.program, (scene, actions), {"part": torch.from_numpy(recording.truth)[None]}, 1)
    for address, value in scene.observed(recording.measurements).items():
        # One row of force is 0.033 mm of travel; its noise turns the averaged force by a thousandth.
        tolerance = 1e-4 if address.startswith("onset") else 0.02
        assert torch.allclose(trace[address][0], value, atol=tolerance, equal_nan=True), address


def test_settings_are_learnt_from_pushes_at_a_known_pose() -> None:
    given = FingerSettings(
        finger=(0.0010, -0.0005, 0.0),
        registration=(0.0003, -0.0002, 0.004),
        drift=(0.0, 0.0),
        offset=0.0004,
        spread=0.0002,
        friction=0.6,
        outlier=0.0,
    )
    keys = ("finger", "registration", "drift", "offset", "spread", "friction", "outlier")
    recording = model.simulate_recording(
        4, pushes=80, direction_outlier=0.0, **{k: getattr(given, k) for k in keys}
    )
    touching = [m for m in recording.measurements if np.abs(m.observation.wrench[-1, :2]).max() > 2.0]
    learnt = estimate_settings(replace(recording, measurements=touching))
    assert learnt.finger == pytest.approx(given.finger, abs=2e-4)
    # Half of what one session shows is taken to last.
    half = [0.5 * r for r in given.registration]
    assert learnt.registration[:2] == pytest.approx(half[:2], abs=1e-4)
    assert learnt.registration[2] == pytest.approx(half[2], abs=1e-3)  # some of the offset looks like a turn
    assert learnt.offset == pytest.approx(given.offset, abs=1e-4)
    # What the finger alone leaves: the registration is in it.
    assert 0.65 * given.spread < learnt.spread < math.hypot(given.spread, *given.registration[:2])
    assert learnt.friction == pytest.approx(given.friction, abs=0.03)
    assert learnt.direction_spread == pytest.approx(given.direction_spread, rel=0.3)


def test_a_push_that_misses_is_evidence() -> None:
    recording = model.simulate_recording(1, pushes=3)
    away = np.array(recording.measurements[0].action.world_from_tip)
    away[:, 2] += 0.2
    push = recording.measurements[0].action
    silent = Touch(push.times, np.full((len(push.times), 6), 0.3), np.zeros((0, 7)))
    missed = replace(recording, measurements=[Measurement(Push(push.times, away), silent)])
    at = around(torch.from_numpy(recording.truth), 0.001)
    for use_free_path in (False, True):
        likelihood = log_likelihood(missed, at, use_free_path=use_free_path)
        assert torch.allclose(likelihood, torch.full_like(likelihood, math.log(0.99)), atol=1e-9)
    felt_nothing = replace(recording, measurements=[Measurement(push, silent)])
    assert float(log_likelihood(felt_nothing, at)[0]) < -4.0


@pytest.mark.parametrize("use_free_path", [False, True])
def test_the_likelihood_does_not_depend_on_the_world_frame(use_free_path: bool) -> None:
    recording = model.simulate_recording(2, pushes=5)
    by = t(0.3, -0.2, 0.1, math.cos(0.4), 0.0, 0.0, math.sin(0.4))
    at = around(torch.from_numpy(recording.truth), 0.0004)
    here = log_likelihood(recording, at, use_free_path=use_free_path)
    there = log_likelihood(moved(recording, by), poses.compose(by, at), use_free_path=use_free_path)
    assert torch.allclose(here, there, atol=1e-6)


def test_bad_pushes_are_refused() -> None:
    recording = model.simulate_recording(0, pushes=1)
    push, touch = recording.measurements[0].action, recording.measurements[0].observation
    short = Touch(touch.times[:8], touch.wrench[:8], touch.world_from_peg)
    with pytest.raises(InputError, match="too few to tare"):
        contact_of(push, short, FingerSettings())
    late = Touch(touch.times + 100.0, touch.wrench, touch.world_from_peg)
    with pytest.raises(InputError, match="outside its path's times"):
        contact_of(push, late, FingerSettings())
    with pytest.raises(InputError, match="no setting 'ofset'"):
        prepare(recording, ofset=1.0)


# ---------------------------------------------------------------- real pushes


def log(name: str) -> Recording:
    files = sorted(LOGS.glob(name + "*"))
    if not files:
        pytest.skip(f"the push logs are not at {LOGS}")
    return command(files, pushes=50, seed=0)


def test_defaults_are_learnt_from_one_log() -> None:
    learnt, settings = estimate_settings(log("10_130")), FingerSettings()
    for name in ("finger", "registration", "drift"):
        assert getattr(learnt, name) == pytest.approx(getattr(settings, name), abs=1e-5)
    for name in ("offset", "spread", "tolerance", "free_spread"):
        assert getattr(learnt, name) == pytest.approx(getattr(settings, name), abs=1e-5)
    assert learnt.friction == pytest.approx(settings.friction, abs=0.005)
    assert learnt.direction_spread == pytest.approx(settings.direction_spread, abs=0.002)


def test_the_finger_of_one_log_explains_the_other() -> None:
    recording = log("10_90")
    truth, distance = torch.from_numpy(recording.truth), SignedDistance(recording.part)
    depths = {}
    for finger in ((0.0, 0.0, 0.0), FingerSettings().finger):
        settings = FingerSettings(finger=finger)
        tips = torch.stack(
            [contact_of(m.action, m.observation, settings).onset for m in recording.measurements]
        )
        depths[finger] = -1e3 * distance(poses.transform(poses.inverse(truth), tips)).distance
    raw, mended = depths.values()
    assert float(raw.mean()) == pytest.approx(
        0.58, abs=0.03
    )  # mm inside the outline, as the logs' readme has it
    assert float(raw.std()) > 0.5
    assert abs(float(mended.mean())) < 0.2
    assert float(mended.std()) < 0.3


def test_forces_lie_in_the_cone_and_point_inwards() -> None:
    recording = log("10_90")
    truth, distance = torch.from_numpy(recording.truth), SignedDistance(recording.part)
    settings = FingerSettings()
    seen = [contact_of(m.action, m.observation, settings) for m in recording.measurements]
    near = distance(poses.transform(poses.inverse(truth), torch.stack([s.onset for s in seen])))
    inward = -(near.normal @ poses.rotation_matrix(truth).T)
    lean = torch.stack([s.direction for s in seen]) - torch.atan2(inward[:, 1], inward[:, 0])
    lean = torch.remainder(lean + math.pi, 2 * math.pi) - math.pi
    cone = math.atan(settings.friction) + 2 * settings.direction_spread
    assert float((lean.abs() < cone).double().mean()) >= 0.95


def test_the_truth_explains_real_pushes_better_than_its_neighbours() -> None:
    recording = log("10_90")
    likelihood = log_likelihood(recording, around(torch.from_numpy(recording.truth), 0.002))
    assert float(likelihood[0]) > float(likelihood[1:].max()) + 20.0
    # A world seen in a mirror (forces the other way round) must not do.
    flipped = replace(
        recording,
        measurements=[
            Measurement(
                m.action, Touch(m.observation.times, -m.observation.wrench, m.observation.world_from_peg)
            )
            for m in recording.measurements
        ],
    )
    assert (
        float(log_likelihood(flipped, around(torch.from_numpy(recording.truth), 0.002))[0])
        < float(likelihood[0]) - 100
    )

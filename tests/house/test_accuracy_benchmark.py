"""The accuracy benchmark: what it calls along, across, tilt and yaw; touches after vision; misses."""

import math
import signal
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.errors import InputError
from bcppl.inference.filters.guided_smc import infer
from bcppl.inference.planning.metrology import three_two_one
from bcppl.models.worlds.bench.scene import bench_scene

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import ablations
import scenes

FEW = 10  # particles


def pose(place, rotation):
    return poses.from_translation_quaternion_xyzw(
        torch.tensor(place, dtype=torch.float64), torch.tensor(rotation.as_quat())
    )


def test_hole_errors_are_those_that_were_put_in():
    truth = pose([0.5, -0.2, 0.15], Rotation.from_rotvec([0.3, -0.5, 1.1]))
    part_from_hole = pose([0.007, 0.005, 0.01], Rotation.from_rotvec([0.0, 0.4, 0.0]))
    swing, twist = Rotation.from_euler("y", -3.0, degrees=True), Rotation.from_euler("z", 5.0, degrees=True)
    off = pose([0.0003, -0.0004, -0.0012], swing * twist)
    mean = poses.compose(
        poses.compose(poses.compose(truth, part_from_hole), off), poses.inverse(part_from_hole)
    )
    whole = math.degrees((swing * twist).magnitude())
    assert scenes.hole_error(mean, truth, part_from_hole) == pytest.approx(
        [1.2, 0.5, whole, 3.0, 5.0], abs=1e-9
    )
    # The same pose with the other sign of its quaternion.
    mean[3:] *= -1.0
    assert scenes.hole_error(mean, truth, part_from_hole) == pytest.approx(
        [1.2, 0.5, whole, 3.0, 5.0], abs=1e-9
    )


@pytest.fixture(scope="module")
def seen():
    """A scene and the steps of vision."""
    scene = bench_scene(0)
    return scene, list(scenes.default_run(scene.look(), FEW, 0))


@pytest.mark.long
def test_touches_after_vision_are_those_of_one_run_to_the_bit(seen):
    scene, vision = seen
    whole = scene.probe(three_two_one(vision[-1].belief, scene.part, scene.peg))
    felt = replace(whole, measurements=whole.measurements[:9])  # 3.5 s: the first contacts are among them
    touched = list(scenes.default_run(felt, FEW, 0, start=vision[-1]))
    straight = list(infer(scenes.model, felt, particles=FEW, seed=0))
    assert len(vision) + len(touched) == len(straight)
    for one, other in zip([*vision, *touched], straight, strict=True):
        assert torch.equal(one.belief.world_from_part, other.belief.world_from_part)
        assert torch.equal(one.belief.log_weights, other.belief.log_weights)
    assert not torch.equal(touched[-1].belief.world_from_part, vision[-1].belief.world_from_part)


def test_a_scene_that_fails_is_a_miss_and_keeps_its_vision(monkeypatch):
    def refused(*_):
        raise InputError("there is no room\nfor the peg.")

    monkeypatch.setattr(scenes, "three_two_one", refused)
    one = scenes.probed(0, FEW)
    assert one.missed == "InputError: there is no room for the peg."
    assert one.at(scenes.VISION).weighted_add < 20.0 and one.at(scenes.END).weighted_add == math.inf
    assert not one.held(scenes.END, "pose", 0.9) and math.isnan(one.wall)
    assert one.curve.kinds == ["prior", "view", "view"]


def test_a_run_that_stopped_has_the_times_that_it_got_to():
    def step(label, moment):
        return SimpleNamespace(info=SimpleNamespace(label=label, time=moment))

    steps = [step("prior", math.nan), step("view 1", math.nan), step("view 2", math.nan)]
    steps += [step(f"window {k}", 0.5 * k - 0.01) for k in range(1, 10)]  # until 4.49 s
    found = scenes.moments_among(steps, complete=False)
    assert list(found) == ["vision", "3 s", "4 s"]
    assert found["vision"] is steps[2] and found["4 s"].info.time == pytest.approx(3.99)
    assert scenes.moments_among(steps)["6 s"] is steps[-1]  # a shorter probe has ended by then


def test_misses_count_as_infinitely_far_off():
    assert scenes.quantile([3.0, 1.0, math.inf], 0.5) == 3.0
    assert scenes.quantile([1.0, math.inf, math.inf], 0.5) == math.inf
    assert scenes.quantile([1.0, 2.0, 4.0], 0.75) == np.quantile([1.0, 2.0, 4.0], 0.75)
    low, high = ablations.interval([0.1, 0.2, 0.3, math.inf])
    assert 0.1 <= low < high == math.inf


def test_a_process_that_dies_takes_no_other_scene_with_it():
    asked = [signal.SIGCHLD, signal.SIGKILL, signal.SIGURG]  # only the second ends a process
    found = list(scenes.every(signal.raise_signal, asked, 2, lambda number, why: (number, why)))
    assert found.count(None) == 2
    ((number, why),) = [one for one in found if one is not None]
    assert number == signal.SIGKILL and why.startswith("TerminatedWorkerError")

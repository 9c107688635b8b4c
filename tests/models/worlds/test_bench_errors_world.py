"""Errors of a real bench in the simulated world: what is measured, and where peg and part truly are."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch

from bcppl.arrays import Array
from bcppl.beliefs import Belief
from bcppl.geometry.gap import PegGap
from bcppl.geometry.turns import turns_freely
from bcppl.inference.planning.metrology import three_two_one
from bcppl.models.worlds.bench.errors import BenchErrors
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.sensors.likelihoods.bench_profiles import profile_named

SEED = 5


def gaps_at_contacts(scene: BenchScene) -> tuple[Array, Array]:
    """Gaps (T,) in m between the measured peg and the part, as it truly is and as it appears there."""
    truth = torch.from_numpy(bench_scene(SEED).truth)
    certain = Belief(truth.repeat(4, 1), torch.zeros(4, dtype=torch.float64))
    measured = scene.measure(three_two_one(certain, scene.part, scene.peg))
    stood = np.concatenate([m.observation.world_from_peg for m in measured])
    force = np.concatenate([m.observation.wrench for m in measured])[:, :3]
    felt = np.flatnonzero(np.linalg.norm(force - np.median(force[:10], axis=0), axis=1) > 2.5)
    gap, at = PegGap(scene.part, scene.peg), torch.from_numpy(stood[felt])
    apparent = torch.stack([torch.as_tensor(scene.apparent(pose)) for pose in stood[felt]])
    seen = [float(gap(a[None], p[None]).distance) for a, p in zip(apparent, at, strict=True)]
    return gap(truth[None], at).distance[0].numpy(), np.array(seen)


@functools.cache
def with_error(name: str) -> tuple[Array, Array]:
    return gaps_at_contacts(bench_scene(SEED, BenchParameters(errors=BenchErrors.only(name))))


def test_without_errors_a_part_is_where_it_appears() -> None:
    truly, seen = with_error("none")
    assert np.allclose(truly, seen, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", ["grasp", "kinematic"])
def test_a_part_appears_where_the_peg_meets_it(name: str) -> None:
    """The gap of the measured peg is off by tenths of a millimetre, and that to the apparent part is none."""
    truly, seen = with_error(name)
    _, perfect = with_error("none")
    assert np.median(np.abs(truly)) > 2.0 * np.median(np.abs(seen))
    assert np.median(np.abs(seen)) < 1.3 * np.median(np.abs(perfect))


@pytest.mark.long
def test_an_arm_that_bends_seems_to_press_the_peg_into_the_part() -> None:
    assert np.median(with_error("bending")[1]) < np.median(with_error("none")[1]) - 3e-5


@pytest.mark.parametrize("part", ["round 16 mm", "round tray", "square 8 mm", "hexagon 12 mm", "D 10 mm"])
def test_a_round_peg_has_no_turn_about_its_axis_in_the_world_nor_in_the_model(part: str) -> None:
    """No touch sees it, and an insertion does not depend on it."""
    scene = bench_scene(SEED, BenchParameters(errors=BenchErrors.only("grasp")), part=part)
    is_round = part.startswith("round")
    assert turns_freely(scene.peg) == is_round
    assert (scene.drawn.grasp[5] == 0.0) == is_round and np.all(scene.drawn.grasp[:5] != 0.0)
    profile = profile_named("ur5e")
    assert profile is not None
    grasp = profile.errors((0.0, 0.0, 0.0), (0.0, 0.0, 0.1), is_round=is_round)[0]
    by_yaw = grasp.effect(torch.zeros(1, 22, dtype=torch.float64)).twist[0, :, 5]
    assert bool((by_yaw == 0.0).all()) == is_round
    assert bool(torch.isfinite(grasp.jumps[0].variances).all())

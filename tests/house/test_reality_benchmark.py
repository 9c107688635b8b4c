"""The bound of `reality.py`: how points move with a twist, and the mean distance of normal displacements."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.metrology_parameters import ROCKED, MetrologyParameters
from bcppl.models.worlds.bench.scene import bench_scene

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import reality

STEP = 1e-6  # m and rad
POSE = poses.retract(poses.identity(), torch.tensor([0.4, -0.2, 0.1, 0.3, -0.8, 0.5], dtype=torch.float64))


@pytest.mark.parametrize("along_world", [True, False])
@pytest.mark.parametrize("axis", range(6))
def test_points_move_with_a_body_as_finite_differences_say(axis: int, along_world: bool) -> None:
    points = POSE[:3] + 0.05 * torch.randn(5, 3, generator=torch.Generator().manual_seed(0)).double()
    twist = torch.zeros(6, dtype=torch.float64)
    twist[axis] = STEP
    step = poses.retract(poses.identity(), twist)
    after = poses.retract(POSE, twist) if along_world else poses.compose(POSE, step)
    moved = poses.transform(poses.compose(after, poses.inverse(POSE)), points)
    stated = reality.displacements(POSE, points, along_world=along_world)[:, :, axis]
    assert torch.allclose((moved - points) / STEP, stated, atol=1e-5)


def test_the_mean_distance_of_a_normal_displacement() -> None:
    """Of three coordinates of 1 mm each it is sqrt(8 / pi) mm."""
    moved = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    mean = reality.least(moved, 1e-6 * torch.eye(3, dtype=torch.float64))
    assert mean == pytest.approx(math.sqrt(8.0 / math.pi), rel=0.06)


def test_a_peg_that_leans_and_turns_while_it_presses_tells_how_it_is_held() -> None:
    """The least error of part relative to peg is hardly more than half, for a square peg near its hole."""
    scene = bench_scene(21000)
    generator = torch.Generator().manual_seed(0)
    away = torch.tensor([0.003] * 3 + [0.05] * 3) * torch.randn(75, 6, generator=generator)
    truth = torch.from_numpy(scene.truth)
    seen = Belief(poses.retract(truth, away.double()), torch.zeros(75, dtype=torch.float64))
    above = poses.compose(truth, torch.from_numpy(scene.kind.part_from_hole))
    above[2] += 0.08
    least = []
    for parameters in (MetrologyParameters(), ROCKED):
        recording = scene.probe(three_two_one(seen, scene.part, scene.peg, parameters))
        least.append(reality.bounds(scene, recording, "ur5e", seen, above)[1])
    assert least[1] < 0.6 * least[0]

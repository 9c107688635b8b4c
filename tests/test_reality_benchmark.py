"""The bound of `reality.py`: how points move with a twist, and the mean distance of normal displacements."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch

from bcppl import poses

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
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

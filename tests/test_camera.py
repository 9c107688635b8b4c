"""Where a camera looks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.errors import InputError
from bcppl.simulators.camera import looking_at


def test_the_point_is_straight_ahead_and_up_is_up() -> None:
    eye, point = np.array([0.3, -0.2, 0.5]), np.array([0.05, 0.1, 0.02])
    world_from_camera = torch.from_numpy(looking_at(eye, point))
    seen = poses.transform(
        poses.inverse(world_from_camera), torch.from_numpy(np.stack([point, point + np.array([0, 0, 0.1])]))
    )
    assert seen[0].numpy() == pytest.approx([0.0, 0.0, np.linalg.norm(point - eye)])
    assert float(seen[1, 1]) < -0.01, "what is higher is higher in the image: y points down"
    assert float(seen[1, 0]) == pytest.approx(0.0, abs=1e-12)


def test_looking_along_up_is_refused() -> None:
    with pytest.raises(InputError, match="upwards"):
        looking_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    assert np.isfinite(looking_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0], up=(0.0, 1.0, 0.0))).all()

"""Probes of a peg, and the comparison of their rollouts."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.contact.physics import Rollout
from bcppl.geometry.extrusion import block_with_square_hole
from bcppl.robot.motion import Probe

STIFFNESS = np.array([1500.0, 1000.0, 2000.0, 60.0, 50.0, 40.0])
DAMPING = np.array([80.0, 80.0, 80.0, 2.0, 2.0, 2.0])


def path(*points: tuple[float, float, float, float], turn: Rotation | None = None, **options: Any) -> Probe:
    """A probe through (time, x, y, z) of the peg's origin, at a fixed rotation."""
    values = np.array(points)
    command = np.zeros((len(values), 7))
    command[:, :3] = values[:, 1:]
    command[:, 3:] = (Rotation.identity() if turn is None else turn).as_quat()[[3, 0, 1, 2]]
    settings: dict[str, Any] = {
        "stiffness": STIFFNESS,
        "damping": DAMPING,
        "stamps": np.arange(0.0, values[-1, 0] + 1e-9, 0.01),
    } | options
    return Probe("probe", values[:, 0], command, **settings)


# Down on the block, over its hole, and down.
SEARCH = path((0, 0, 0, 0.06), (0.5, 0, 0, 0.047), (1.0, 0.006, 0.002, 0.045), (1.2, 0.006, 0.002, 0.03))
HOLE = block_with_square_hole(hole=0.0165, offset=(0.005, 0.002))


def same(a: Rollout, b: Rollout) -> None:
    np.testing.assert_array_equal(a.wrench, b.wrench)
    np.testing.assert_array_equal(a.world_from_peg, b.world_from_peg)

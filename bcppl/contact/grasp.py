"""A peg that gives in the hand: a spring between the hand and the peg, in series with the controller's.

The two springs carry the same wrench. So the peg is pulled by one spring whose compliance is the sum of both,
and the hand is ahead of the peg by what the grasp's spring gives. That is exact at rest. In motion the arm's
mass goes with the peg: right for touches that are slower than a held peg rings (0.2 kg at 1e5 N/m: 110 Hz,
far above the sensor's filter), and wrong within the first milliseconds of a knock.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bcppl.contact.peg_model import SENSED

Array = npt.NDArray[np.float64]


def in_series(unknowns: Mapping[str, Array], stiffness: Array) -> dict[str, Array]:
    """What is unknown, the grasp's compliance taken into the controller's stiffness and damping.

    A spring K with a damper D in series with a compliance C is, for slow motion, a spring K / (1 + C K) with
    a damper D / (1 + C K)^2: the first two terms of (K + D s) / (1 + C (K + D s)) in s.

    Args:
        unknowns: from `Unknowns.rows`.
        stiffness: (6,) the probe's, N/m and N m/rad.
    """
    if "grasp_compliance" not in unknowns:
        return dict(unknowns)
    ones = np.ones_like(unknowns["grasp_compliance"])
    factor, damping = unknowns.get("stiffness", ones), unknowns.get("damping", ones)
    share = 1.0 / (1.0 + unknowns["grasp_compliance"] * factor * stiffness)
    return {**unknowns, "stiffness": factor * share, "damping": damping * share**2}


def as_gripped(rows: Array, compliance: Array) -> Array:
    """What the hand feels and where it is, of what a peg in its springs does.

    Args:
        rows: (N, T, 13) pose of the peg in the world, and the environment's wrench on it in its frame.
        compliance: (N, 6) along and about the grip's axes.

    Returns:
        (N, T, 13) pose of the grip in the world, and the same wrench in the grip's frame about its origin.
    """
    gripped = rows.copy()
    soft = (compliance > 0).any(axis=1)
    loose = rows[soft].reshape(-1, SENSED)
    finite = np.isfinite(loose).all(axis=1)
    flat = loose[finite]
    force, torque = flat[:, 7:10], flat[:, 10:]
    given = np.repeat(compliance[soft], rows.shape[1], axis=0)[finite] * flat[:, 7:]
    # The environment pushes the peg into the hand: grip_from_peg is what the springs have given.
    turned = Rotation.from_rotvec(given[:, 3:])
    felt = turned.apply(force)
    held = Rotation.from_quat(flat[:, [4, 5, 6, 3]]) * turned.inv()
    flat[:, :3] -= held.apply(given[:, :3])
    flat[:, 3:7] = held.as_quat()[:, [3, 0, 1, 2]]
    flat[:, 7:10], flat[:, 10:] = felt, turned.apply(torque) + np.cross(given[:, :3], felt)
    loose[finite] = flat
    gripped[soft] = loose.reshape(-1, *rows.shape[1:])
    return gripped

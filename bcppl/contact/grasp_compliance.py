"""Grasp compliance: a spring between the hand and the peg, in series with the controller's.

Both springs carry the same wrench. So the peg is pulled by one spring with the sum of their compliances, and
the hand is displaced from the peg by the deflection of the grasp's. That is exact at rest. In motion the mass
of the arm goes with the peg, which holds for touches that are slower than a held peg's natural frequency
(0.2 kg at 1e5 N/m: 110 Hz, far above the sensor's filter), and not in the first milliseconds of an impact.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array


def springs_in_series(nuisances: Mapping[str, Array], stiffness: Array) -> dict[str, Array]:
    """The nuisance parameters, with the grasp's compliance included in the stiffness and damping.

    A spring K with a damper D in series with a compliance C is, for slow motion, a spring K / (1 + C K) with
    a damper D / (1 + C K)^2: the first two terms of (K + D s) / (1 + C (K + D s)) in s. The nuisances are
    from `Nuisances.rows`, the stiffness (6,) is the probe's, N/m and N m/rad.
    """
    if "grasp_compliance" not in nuisances:
        return dict(nuisances)
    ones = np.ones_like(nuisances["grasp_compliance"])
    factor, damping = nuisances.get("stiffness", ones), nuisances.get("damping", ones)
    share = 1.0 / (1.0 + nuisances["grasp_compliance"] * factor * stiffness)
    return {**nuisances, "stiffness": factor * share, "damping": damping * share**2}


def readings_at_grip(rows: Array, compliance: Array) -> Array:
    """Rows (N, T, C) of the grip's poses in the world, and the wrench in its frame about its origin.

    From rows of the peg's poses (7) in the world, the environment's wrench (6) on it in its frame, and others
    that stay, and the grasp's compliance (N, 6) along and about the grip's axes.
    """
    at_grip = rows.copy()
    compliant = (compliance > 0).any(axis=1)
    flat = rows[compliant].reshape(-1, rows.shape[2])
    finite = np.isfinite(flat).all(axis=1)
    peg = flat[finite]
    # The environment pushes the peg into the hand: grip_from_peg is the springs' deflection.
    deflection = np.repeat(compliance[compliant], rows.shape[1], axis=0)[finite] * peg[:, 7:13]
    turned = Rotation.from_rotvec(deflection[:, 3:])
    force = turned.apply(peg[:, 7:10])
    world_from_grip = Rotation.from_quat(peg[:, [4, 5, 6, 3]]) * turned.inv()
    flat[finite, :13] = np.concatenate(
        [
            peg[:, :3] - world_from_grip.apply(deflection[:, :3]),
            world_from_grip.as_quat()[:, [3, 0, 1, 2]],
            force,
            turned.apply(peg[:, 10:13]) + np.cross(deflection[:, :3], force),
        ],
        axis=1,
    )
    at_grip[compliant] = flat.reshape(-1, *rows.shape[1:])
    return at_grip

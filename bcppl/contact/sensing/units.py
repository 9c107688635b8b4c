"""A check of the units of wrenches."""

from __future__ import annotations

import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError

LONGEST_LEVER = 30.0  # in reaches of the peg; torques that need a longer one are in N mm


def refuse_millimetres(wrench: Array, reach: float) -> None:
    """Refuse tared wrenches (M, 6) in contact whose torques are in N mm, unless they are fewer than three.

    Args:
        wrench: (M, 6) force and torque.
        reach: the distance of the peg's farthest point from their origin, metres.

    Raises:
        InputError: the torques are too large to be in N m.
    """
    if len(wrench) < 3:
        return
    force, torque = np.linalg.norm(wrench[:, :3], axis=1), np.linalg.norm(wrench[:, 3:], axis=1)
    lever = float(np.median(torque / force))
    if lever > LONGEST_LEVER * reach:
        raise InputError(
            f"the wrenches act {lever:.3g} m from the origin of a peg that ends {reach:.3g} m from it: "
            "their torques are probably in N mm; scale them by 0.001."
        )

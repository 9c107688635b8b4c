"""Whether wrenches can be in the units that they should be in."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bcppl.errors import InputError

Array = npt.NDArray[np.float64]

LONGEST_LEVER = 30.0  # a force that acts this many times as far off as the peg reaches has torques in N mm


def refuse_millimetres(wrench: Array, reach: float) -> None:
    """Refuse tared wrenches (M, 6) in contact with a peg that ends `reach` metres from their origin.

    Fewer than three are not judged.

    Raises:
        InputError: the torques are so large that they must be in N mm.
    """
    if len(wrench) < 3:
        return
    force, torque = np.linalg.norm(wrench[:, :3], axis=1), np.linalg.norm(wrench[:, 3:], axis=1)
    lever = float(np.median(torque / force))
    if lever > LONGEST_LEVER * reach:
        raise InputError(
            f"the wrenches push {lever:.3g} m beside the origin of a peg that ends {reach:.3g} m from it: "
            "their torques are probably in N mm; scale them by 0.001."
        )

"""What is known of a part's pose before anything is measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Guess:
    """What is known of the part's pose beforehand.

    Attributes:
        world_from_part: (7,) the pose about which the prior is centred.
        translation: (3,) half widths of the box, metres, along the world's axes; 0 holds an axis fixed.
        tilt: the largest angle between the part's z axis and its guess, radians; 0 holds it fixed.
        yaw: the largest turn about the part's z axis, radians; 0 holds it fixed.
        angle: if not None, the rotation is uniform within this angle (radians) of the guess, and
            `tilt` and `yaw` are not used.
    """

    world_from_part: Array
    translation: Array
    tilt: float = 0.0
    yaw: float = 0.0
    angle: float | None = None

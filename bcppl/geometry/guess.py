"""The support of the prior over a part's pose."""

from __future__ import annotations

from dataclasses import dataclass

from bcppl.arrays import Array


@dataclass(frozen=True, eq=False)
class Guess:
    """A prior's support: poses of the part within bounds of a guessed pose.

    Attributes:
        world_from_part: (7,) the guessed pose, the centre of the prior.
        translation: (3,) half widths of a box along the world's axes, metres; 0 fixes an axis.
        tilt: largest angle between the part's z axis and its guess, radians; 0 fixes it.
        yaw: largest rotation about the part's z axis, radians; 0 fixes it.
        angle: if not None, the rotation is uniform within this angle (radians) of the guess, and
            `tilt` and `yaw` are not used.
    """

    world_from_part: Array
    translation: Array
    tilt: float = 0.0
    yaw: float = 0.0
    angle: float | None = None

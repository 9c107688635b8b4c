"""How a recording's parts, guess, poses and backgrounds lie in its file; sensors state the rest."""

from __future__ import annotations

import numpy as np

from bcppl.geometry.parts import Guess, Part, Piece
from bcppl.sensors.layout import POSE_UNITS, TEXT, Layout, number, numbers

PART = Layout(Part, {"name": TEXT, "source": TEXT, "vertices": numbers("m"), "faces": numbers("1", np.int64)})
PIECE = Layout(Piece, {"kind": TEXT, "size": numbers("m"), "center": numbers("m")})
GUESS = Layout(
    Guess,
    {
        "world_from_part": numbers(POSE_UNITS),
        "translation": numbers("m"),
        **{name: number("rad") for name in ("tilt", "yaw", "angle")},
    },
    optional={"angle": 1},
)
POSE = numbers(POSE_UNITS)
DEPTH = numbers("m", np.float32)

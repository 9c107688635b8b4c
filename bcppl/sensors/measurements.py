"""What a recording holds: measurements in order, each an action and what was observed.

Units are SI throughout: metres, radians, newtons, newton metres, seconds. Poses are
`[x, y, z, qw, qx, qy, qz]`, named after the frames they take from and to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from bcppl.geometry.camera import Camera
from bcppl.geometry.guess import Guess
from bcppl.geometry.parts import Part
from bcppl.robot.motion import ProbeWindow

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """Action: a depth image is taken with a camera (its pose as the robot's owner believes it)."""

    camera: Camera


@dataclass(frozen=True, eq=False)
class Push:
    """Action: a point finger is moved along a path until (and beyond where) it touches.

    Attributes:
        times: (R,) seconds, increasing.
        world_from_tip: (R, 7) pose of the finger's tip.
    """

    times: Array
    world_from_tip: Array


@dataclass(frozen=True, eq=False)
class DepthImage:
    """Observation: depth along the optical axis, (H, W) metres, NaN where missing; colour (H, W, 3)."""

    depth: Array
    rgb: npt.NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Measurement:
    """One action and what was observed."""

    action: Any
    observation: Any

    @property
    def kind(self) -> str:
        """One of "view", "window" and "push"."""
        return {View: "view", ProbeWindow: "window", Push: "push"}[type(self.action)]


@dataclass(frozen=True, eq=False)
class Recording:
    """One scene: the part that is looked for, what was known beforehand, and what was measured.

    Attributes:
        part: the part whose pose is sought.
        guess: the prior.
        measurements: in the order in which they were taken.
        peg: the held peg, its frame's origin at the wrench sensor's; None where nothing is held.
        background: (by camera name) depth (H, W) in metres of what stands behind the part, NaN where unknown.
        truth: (7,) true `world_from_part`, where known.
        model: the name of the model that explains it by default.
        source: where it comes from: attribution and licence.
    """

    part: Part
    guess: Guess
    measurements: Sequence[Measurement]
    peg: Part | None = None
    background: Mapping[str, Array] = field(default_factory=dict)
    truth: Array | None = None
    model: str = "peg_in_hole"
    source: str = ""

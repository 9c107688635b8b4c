"""What a recording holds: measurements in order, each an action and what was observed.

Units are SI throughout: metres, radians, newtons, newton metres, seconds. Poses are
`[x, y, z, qw, qx, qy, qz]`, named after the frames they take from and to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """Action: a depth image is taken with a camera (its pose as the robot's owner believes it)."""

    camera: Camera


@dataclass(frozen=True, eq=False)
class Probe:
    """A compliant motion: the peg, held by a Cartesian spring-damper, follows a commanded trajectory.

    Attributes:
        name: windows of the same probe carry the same name and share one simulation.
        command_times: (C,) seconds, increasing; the command is interpolated between them
            (translations linearly, rotations along the geodesic).
        command: (C, 7) commanded `world_from_peg`.
        stiffness: (6,) N/m along, then N m/rad about, the commanded peg's axes.
        damping: (6,) N s/m, then N m s/rad.
        stamps: (T,) seconds at which wrench and peg pose are read, over the whole probe.
    """

    name: str
    command_times: Array
    command: Array
    stiffness: Array
    damping: Array
    stamps: Array


@dataclass(frozen=True, eq=False)
class ProbeWindow:
    """Action: a stretch of a probe, stamps `first` to `last` (exclusive) of `probe.stamps`."""

    probe: Probe
    first: int
    last: int


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
class Touch:
    """Observation: the raw wrench, and the held peg's measured pose.

    Attributes:
        times: (T,) seconds, increasing.
        wrench: (T, 6) force (N) then torque (N m) that the environment exerts on the peg or finger, in the
            peg's frame about its origin (for a push: in the world's axes, about the tip). Not tared.
        world_from_peg: (T, 7) measured pose of the peg; empty (0, 7) for a push, whose path is in the action.
    """

    times: Array
    wrench: Array
    world_from_peg: Array


@dataclass(frozen=True, eq=False)
class Measurement:
    """One action and what was observed."""

    action: View | ProbeWindow | Push
    observation: DepthImage | Touch

    @property
    def kind(self) -> str:
        """One of "view", "window" and "push"."""
        return {View: "view", ProbeWindow: "window", Push: "push"}[type(self.action)]


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

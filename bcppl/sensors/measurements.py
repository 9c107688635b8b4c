"""Recordings: measurements in order, each an action and its observation.

Units are SI throughout: metres, radians, newtons, newton metres, seconds. Poses are
`[x, y, z, qw, qx, qy, qz]`, named after the frames they take from and to.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from bcppl.arrays import Array
from bcppl.geometry.parts import Guess, Part
from bcppl.sensors.protocol import sensor_of


@dataclass(frozen=True, eq=False)
class Measurement:
    """One action and its observation, of types that a sensor has registered (`bcppl.sensors.protocol`)."""

    action: Any
    observation: Any

    @property
    def kind(self) -> str:
        """The name of the action's kind: "view", "window", "push".

        Raises:
            InputError: the action is of no known kind.
        """
        return sensor_of(self.action).kind


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """One scene: the part that is sought, the prior for its pose, and the measurements.

    Attributes:
        part: the part whose pose is sought.
        guess: the prior.
        measurements: in the order in which they were taken.
        peg: the held peg, its frame's origin where it is held, about which wrenches are stated; None where
            nothing is held.
        background: (by camera name) depth (H, W) in metres of the scene without the part, NaN where unknown.
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
    model: str = "look_and_touch"
    source: str = ""

    def __repr__(self) -> str:
        counts = Counter(type(m.action).__name__ for m in self.measurements)
        measured = ", ".join(f"{count} {name}" for name, count in counts.items()) or "no measurements"
        held = "" if self.peg is None else f", peg {self.peg.name!r}"
        return f"Recording(part {self.part.name!r}{held}, {measured}, model {self.model!r})"

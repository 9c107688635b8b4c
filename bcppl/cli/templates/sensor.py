"""NAME: a kind of measurement. Here a gauge at a known place reads how far it is from the part.

Import this file in your model's file, or name it as an entry point of the group "bcppl.sensors": recordings
with this kind are then saved, checked, described and explained. A candidate for the next measurement, a
drawing, a quadratic approximation (`LinearisedSite` in place of `OneSite`) are further methods
(`bcppl.sensors.protocol`, and docs/new_sensor.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Normal

from bcppl.arrays import Array
from bcppl.distributions.lazy import LazyDistribution
from bcppl.geometry.distance import SignedDistance
from bcppl.poses import inverse, transform
from bcppl.sensors import Measurement, Recording, register
from bcppl.sensors.layout import TEXT, Layout, number, numbers
from bcppl.sensors.protocol import Indexed
from bcppl.sensors.scene import OneSite

NOISE = 0.0005  # m, the standard deviation of a reading


@dataclass(frozen=True, eq=False)
class Place:
    """Action: the gauge is at a point (3,) of the world, m."""

    name: str
    world: Array


@dataclass(frozen=True, eq=False)
class Reading:
    """Observation: metres to the part's surface."""

    metres: float


class ReadingAt(LazyDistribution):
    """A reading for parts at poses (N, 7), computed when its log-probability is asked for."""

    cost = 1  # of delayed acceptance's stages: 1 is cheap, 2 is contact physics

    def __init__(self, distance: SignedDistance, pose: Tensor, place: Place) -> None:
        self.distance, self.pose, self.place = distance, pose, place
        super().__init__(len(pose), ())

    def _true(self) -> Tensor:
        at = torch.as_tensor(self.place.world, dtype=torch.float64)[None]
        return self.distance(transform(inverse(self.pose), at)[:, 0]).distance

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,)."""
        return Normal(self._true(), NOISE).log_prob(value)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """A reading for each particle (N,)."""
        return Normal(self._true(), NOISE).sample()


class Gauge:
    """Readings of a gauge."""

    kind = "NAME"
    names = ("reading", "readings")
    contact = False  # whether the part is touched, so that its mesh has to be closed
    action = Layout(Place, {"name": TEXT, "world": numbers("m m m")})
    observation = Layout(Reading, {"metres": number("m")})

    def problems(self, measurements: Indexed, recording: Recording) -> Iterator[tuple[int, str]]:
        """Everything that is wrong with a recording's readings, one sentence each."""
        for k, measurement in measurements:
            if np.shape(measurement.action.world) != (3,):
                yield k, f"measurement {k}: the gauge's place is not three numbers; give metres in the world."
            if not measurement.observation.metres >= 0.0:
                yield k, f"measurement {k}: the reading is negative or no number; leave it out."

    def describe(self, measurements: Sequence[Measurement], recording: Recording) -> list[tuple[str, str]]:
        """Rows of `bcppl check`."""
        return [("NAME", f"{len(measurements)} places")]

    def prepare(self, recording: Recording) -> OneSite:
        """The likelihood of readings, for models that choose no other."""
        distance = SignedDistance(recording.part)
        return OneSite(
            "NAME",
            lambda pose, place, blur: ReadingAt(distance, pose, place),
            lambda reading: torch.tensor(reading.metres, dtype=torch.float64),
        )


register(Gauge())

"""Measurements that wait to be assimilated: in their order, and joined where several wait."""

from __future__ import annotations

from typing import NamedTuple

from bcppl.sensors.measurements import Measurement
from bcppl.sensors.protocol import InParts, sensor_of


class Arrived(NamedTuple):
    """A measurement, when it arrived (s of a monotonic clock), and of how many it is joined."""

    measurement: Measurement
    time: float
    joined: int = 1


class Waiting:
    """Measurements that were made and are not yet assimilated.

    What comes in parts, such as the windows of a probe, leaves in the order of the parts, in whatever order
    they arrive, and a part that adds nothing to those before it is dropped; everything else leaves in the
    order of arrival.
    """

    def __init__(self) -> None:
        self._left: list[Measurement] = []
        self._waiting: list[Arrived] = []

    def __len__(self) -> int:
        return sum(each.joined for each in self._waiting)

    def add(self, measurement: Measurement, time: float) -> None:
        """One more, that arrived at a time."""
        if not any(_holds(left, measurement) for left in self._left):
            self._waiting.append(Arrived(measurement, time))

    def held_back(self) -> list[Measurement]:
        """Those that wait for an earlier part."""
        return [each.measurement for each in self._waiting if not self._follows(each.measurement)]

    def take(self, *, join: bool) -> Arrived | None:
        """The next measurement, which leaves; None where none can.

        Args:
            join: whether parts that follow one another leave as one measurement.
        """
        taken = self._leave(None)
        while join and taken is not None and (whole := self._leave(taken)) is not None:
            taken = whole
        return taken

    def _leave(self, before: Arrived | None) -> Arrived | None:
        """The next that can leave; after another one, that one joined with it, if the two can be joined."""
        for each in self._waiting:
            if not self._follows(each.measurement):
                continue
            whole = each
            if before is not None:
                both = _joined(before.measurement, each.measurement)
                if both is None:
                    return None
                whole = Arrived(both, each.time, before.joined + each.joined)
            self._waiting = [
                other
                for other in self._waiting
                if other is not each and not _holds(each.measurement, other.measurement)
            ]
            self._left.append(each.measurement)
            return whole
        return None

    def _follows(self, measurement: Measurement) -> bool:
        sensor = sensor_of(measurement.action)
        return not isinstance(sensor, InParts) or sensor.follows(measurement, self._left)


def _joined(first: Measurement, second: Measurement) -> Measurement | None:
    sensor = sensor_of(second.action)
    if isinstance(sensor, InParts) and sensor_of(first.action) is sensor:
        return sensor.joined(first, second)
    return None


def _holds(first: Measurement, second: Measurement) -> bool:
    """Whether a part adds nothing to another one."""
    return _joined(first, second) is first

"""Measurements that a live filter refuses: wrong by themselves, or parts that do not continue a whole."""

from __future__ import annotations

from typing import Any

from bcppl.errors import InputError
from bcppl.sensors import Measurement, Recording, checks
from bcppl.sensors.layout import link
from bcppl.sensors.protocol import InParts, Sensor, sensor_for, sensor_of


def refuse(measurement: Measurement, recording: Recording, shared: dict[str, dict[str, Any]]) -> None:
    """Refuse a measurement that is wrong by itself.

    Args:
        measurement: that has arrived.
        recording: what it would be added to.
        shared: by kind and name, what measurements share, such as cameras; those of this one are added.

    Raises:
        InputError: it has a problem, or another thing has the name of one that it shares.
    """
    sensor = sensor_for(measurement)
    alone = sensor.alone(measurement) if isinstance(sensor, InParts) else measurement
    number = len(recording.measurements)
    for _, problem in sensor.problems([(number, alone)], recording):
        raise InputError(problem)
    for group, thing in _shared(sensor, measurement):
        link(thing.name)  # refuses an empty one
        known = shared.setdefault(group, {})
        for problem in checks.named_alike(f"measurement {number}", group, thing, known):
            raise InputError(problem)


def refuse_part(recording: Recording) -> None:
    """Refuse a recording whose last measurement is a part that does not continue its whole, such as a probe.

    Raises:
        InputError: parts before it are missing, or overlap with it.
    """
    last = recording.measurements[-1]
    sensor = sensor_of(last.action)
    if not isinstance(sensor, InParts):
        return
    whole = _names(sensor, last)
    of_kind = [(k, each) for k, each in enumerate(recording.measurements) if each.kind == last.kind]
    parts = [(k, each) for k, each in of_kind if _names(sensor, each) == whole]
    for _, problem in sensor.problems(parts, recording):
        raise InputError(f"{problem.rstrip('.')}; begin another probe.")


def _shared(sensor: Sensor, measurement: Measurement) -> list[tuple[str, Any]]:
    fields = sensor.action.fields.items()
    return [(kept.group, getattr(measurement.action, name)) for name, kept in fields if kept.group]


def _names(sensor: Sensor, measurement: Measurement) -> list[tuple[str, str]]:
    return [(group, thing.name) for group, thing in _shared(sensor, measurement)]

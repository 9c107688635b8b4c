"""Checks a recording before anything is inferred from it: each problem is one sentence."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from bcppl.errors import InputError
from bcppl.geometry.parts import LARGEST_EXTENT, Guess
from bcppl.sensors import checks
from bcppl.sensors.measurements import Recording
from bcppl.sensors.protocol import by_sensor, sensor_for, sensors


def problems(recording: Recording) -> list[str]:
    """Everything that is wrong with a recording, one sentence each; empty where nothing is."""
    return list(_problems(recording))


def validate(recording: Recording) -> None:
    """Refuse a recording that has a problem.

    Raises:
        InputError: the first of `problems`.
    """
    for problem in _problems(recording):
        raise InputError(problem)


def notes(recording: Recording) -> list[str]:
    """Remarks on a recording that do not stop inference, one sentence each."""
    part = recording.part
    if _touched(recording) or list(checks.part(part, closed=False)) or part.is_closed:
        return []
    return [f"part {part.name!r} has an open mesh: it can be looked at, as here, but not touched."]


def _touched(recording: Recording) -> bool:
    return any(sensor.contact for sensor, _ in by_sensor(recording.measurements))


def _problems(recording: Recording) -> Iterator[str]:
    yield from checks.part(recording.part, closed=_touched(recording))
    if recording.peg is not None:
        yield from checks.part(recording.peg, closed=True)
    yield from _guess(recording.guess)
    if recording.truth is not None:
        yield from checks.pose("the truth (world_from_part)", recording.truth)
    if recording.model.endswith(".py") or "/" in recording.model:
        yield (
            f"the recording names the file {recording.model!r} as its model; name an installed model, and "
            "give a file of your own where the recording is run."
        )
    if not recording.measurements:
        kinds = ", ".join(sensor.names[0] for sensor in sensors())
        yield f"the recording holds no measurement; record at least one ({kinds})."
    found = list(_strays(recording))
    for sensor, measurements in by_sensor(recording.measurements):
        found += sensor.problems(measurements, recording)
    for _, problem in sorted(found, key=lambda each: each[0]):
        yield problem


def _strays(recording: Recording) -> Iterator[tuple[int, str]]:
    """Problems of measurements that no sensor checks."""
    for index, measurement in enumerate(recording.measurements):
        try:
            sensor_for(measurement)
        except InputError as error:
            yield index, f"measurement {index}: {error}"


def _guess(guess: Guess) -> Iterator[str]:
    yield from checks.pose("the guess (world_from_part)", guess.world_from_part)
    widths = np.asarray(guess.translation)
    if widths.shape != (3,) or not np.isfinite(widths).all():
        yield "the guess's translation is not three finite half widths; give them in metres along x, y and z."
    elif (widths < 0).any():
        yield f"the guess has a negative half width ({widths.min():.4g} m); give 0 to hold an axis fixed."
    elif (widths > LARGEST_EXTENT).any():
        yield f"the guess is {widths.max():.4g} m wide, probably in millimetres; scale it by 0.001 to metres."
    for name in ("tilt", "yaw", "angle"):
        limit = getattr(guess, name)
        if limit is None:
            continue
        if not math.isfinite(limit) or limit < 0:
            yield f"the guess's {name} is {limit:.4g}; give a limit of at least 0, in radians."
        elif limit > math.pi + 1e-9:
            yield f"the guess's {name} is {limit:.4g} rad, probably degrees; give radians below pi."

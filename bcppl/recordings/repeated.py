"""Measurements that a recording holds twice: the same numbers are one observation, however often given."""

from __future__ import annotations

import hashlib
import warnings
from contextlib import suppress
from dataclasses import replace

from bcppl.errors import InputError
from bcppl.recordings.fingerprint import add
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.protocol import sensor_of

NAMED = 4  # measurements that a warning names


def repeated(recording: Recording) -> dict[int, int]:
    """The first measurement with the same numbers, for every measurement that repeats one, by their places.

    A sensor's noise never has the same bits twice. Action and observation both have to be equal; of
    touches that hold the measured motion, the observation alone, whatever their probe is named.
    """
    first: dict[bytes, int] = {}
    again: dict[int, int] = {}
    for k, measurement in enumerate(recording.measurements):
        with suppress(InputError):  # of no known kind: `problems` reports it
            again[k] = first.setdefault(_digest(measurement), k)
    return {k: earlier for k, earlier in again.items() if earlier != k}


def once_each(recording: Recording) -> Recording:
    """The recording with every measurement once.

    Warns:
        RuntimeWarning: a measurement is left out, for it repeats an earlier one.
    """
    again = repeated(recording)
    if not again:
        return recording
    named = [f"measurement {k} repeats measurement {earlier}" for k, earlier in again.items()]
    more = f", and {len(named) - NAMED} more" if len(named) > NAMED else ""
    warnings.warn(
        f"{', '.join(named[:NAMED])}{more}, number by number: each is counted once; "
        "if they were recorded separately, record them again.",
        RuntimeWarning,
        stacklevel=2,
    )
    kept = [m for k, m in enumerate(recording.measurements) if k not in again]
    return replace(recording, measurements=kept)


def _digest(measurement: Measurement) -> bytes:
    sensor, digest = sensor_of(measurement.action), hashlib.sha256()
    stored = [sensor.kind, sensor.observation.stored(measurement.observation)]
    if not len(getattr(measurement.observation, "world_from_peg", ())):
        stored.append(sensor.action.stored(measurement.action))
    add(digest, stored)
    return digest.digest()

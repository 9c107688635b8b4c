"""Fingerprints: which recording a belief is of, by its numbers and not by where its file lies."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from bcppl.recordings.layouts import DEPTH, GUESS, PART, PIECE
from bcppl.sensors.measurements import Recording
from bcppl.sensors.protocol import sensor_of

PREFIX = "2:"  # of fingerprints that see actions, peg and background; earlier ones have none


def fingerprint(recording: Recording, count: int) -> str:
    """The same for two recordings whose first `count` measurements, parts, guess and background are equal.

    Numbers count as a file holds them, so a recording has the same fingerprint before and after it was saved.
    The truth, the model's name and the attribution do not count.
    """
    digest = hashlib.sha256()
    parts = [part for part in (recording.part, recording.peg) if part is not None]
    content: list[Any] = [GUESS.stored(recording.guess)]
    for part in parts:
        mesh = PART.stored(part)
        content.append([mesh["vertices"], mesh["faces"], [PIECE.stored(piece) for piece in part.pieces]])
    content.append({name: DEPTH.stored(depth) for name, depth in sorted(recording.background.items())})
    for measurement in recording.measurements[:count]:
        sensor = sensor_of(measurement.action)
        action = sensor.action.stored(measurement.action)
        content.append([sensor.kind, action, sensor.observation.stored(measurement.observation)])
    add(digest, content)
    return PREFIX + digest.hexdigest()


def is_of(stored: str, recording: Recording, count: int) -> bool:
    """Whether a fingerprint of any version is that of a recording's first `count` measurements.

    An empty one, of a belief that was saved without, is that of every recording.
    """
    if not stored:
        return True
    if stored.startswith(PREFIX):
        return stored == fingerprint(recording, count)
    return stored == _first_version(recording, count)


def add(digest: Any, value: Any) -> None:
    """Hash a value with its type and length, so that no two values have the same bytes."""
    if isinstance(value, Mapping):
        add(digest, [[key, each] for key, each in value.items()])
    elif isinstance(value, list):
        digest.update(f"list {len(value)} ".encode())
        for each in value:
            add(digest, each)
    elif isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype.str} {value.shape} ".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    else:
        text = repr(value).encode()
        digest.update(f"{type(value).__name__} {len(text)} ".encode() + text)


def _first_version(recording: Recording, count: int) -> str:
    """The fingerprint without a prefix that earlier beliefs carry: of part, guess and observations alone."""
    numbers = [recording.part.vertices, recording.guess.world_from_part]
    for measurement in recording.measurements[:count]:
        seen = sensor_of(measurement.action).observation.stored(measurement.observation)
        numbers += [seen[name] for name in ("depth", "times", "wrench") if name in seen]
    digest = hashlib.sha256()
    for array in numbers:
        digest.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
    return digest.hexdigest()

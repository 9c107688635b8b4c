"""Which recording a belief is of, by what was measured and not by where the file lies."""

from __future__ import annotations

import hashlib

import numpy as np

from bcppl.sensors.measurements import DepthImage, Recording


def fingerprint(recording: Recording, taken: int) -> str:
    """The same for two recordings whose part, guess and first `taken` observations are the same numbers.

    Args:
        recording: of which the first measurements count, and no others.
        taken: how many.
    """
    found = hashlib.sha256()
    measured = [m.observation for m in recording.measurements[:taken]]
    numbers = [recording.part.vertices, recording.guess.world_from_part]
    for each in measured:  # depth as a file holds it: what was saved and loaded is the same recording
        if isinstance(each, DepthImage):
            numbers.append(each.depth.astype(np.float32))
        else:
            numbers += [each.times, each.wrench]
    for array in numbers:
        found.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
    return found.hexdigest()

"""Which measurements of a recording repeat an earlier one to the bit: they carry no information."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from bcppl.arrays import Array
from bcppl.contact.touch import Touch
from bcppl.traces.dependence.equality import alike, equal

_LEAST = 30  # numbers: fewer, rounded by their sensor, may be equal by chance


def repeated(measurements: Sequence[Any]) -> dict[int, int]:
    """The number of the earlier measurement that each repeated one equals, by its own number.

    Noise makes no two measurements equal: one with the observation and the action of another is that one
    given twice. Touches are equal where times, wrenches and poses are, whatever their probe is named.
    """
    first: dict[bytes, list[int]] = {}
    repeats: dict[int, int] = {}
    for number, measurement in enumerate(measurements):
        arrays = _arrays(getattr(measurement, "observation", None))
        if sum(each.size for each in arrays) < _LEAST:
            continue
        digest = hashlib.blake2b(b"".join(np.ascontiguousarray(each).tobytes() for each in arrays)).digest()
        for earlier in first.setdefault(digest, []):
            if _same(measurements[earlier], measurement):
                repeats[number] = earlier
                break
        else:
            first[digest].append(number)
    return repeats


def _arrays(observation: Any) -> list[Array]:
    if not is_dataclass(observation):
        return []
    values = [getattr(observation, each.name) for each in fields(observation)]
    return [each for each in values if isinstance(each, np.ndarray) and each.dtype.kind == "f"]


def _same(first: Any, second: Any) -> bool:
    observed = alike(first.observation, second.observation, equal)
    if isinstance(first.observation, Touch):
        return observed and type(first.action) is type(second.action)
    return observed and alike(first.action, second.action, equal)

"""What is read of a REASSEMBLE file: arrays with their stamps, segments, and the board's pose beside it.

DATE-TIME.h5
  robot_state/NAME       (T, C), each at its own rate
  timestamps/NAME        (T,) or (T, 1), Unix seconds
  segments_info/0..      start, end (Unix seconds), success, text
  hama1, hand, events .. videos, sound and events, which are not looked at
DATE-TIME_poses.json     NIST_Board1, Hama1, Hama2, DAVIS346: [[x, y, z], [qx, qy, qz, qw]]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.hdf5 import opened
from bcppl.recordings.importers.bench.arrays import Numbers, missing, refuse_axes, table, topics
from bcppl.recordings.importers.bench.configuration.fields import BenchFields
from bcppl.untrusted import strict_json
from bcppl.untrusted.visible_text import visible

STATE, STAMPS, SEGMENTS = "robot_state", "timestamps", "segments_info"
BOARD = "NIST_Board1"
_REMEDY = "copy it from the data set again"
_SENSOR, _BASE = "measured_force", "compensated_base_force"


@dataclass(frozen=True)
class Segment:
    """An action: what was done, from when to when (Unix seconds), and whether it succeeded."""

    text: str
    start: float
    end: float
    success: bool


class ReassembleArrays:
    """The arrays that a configuration names, read once.

    Args:
        path: of the file.
        fields: the configuration.

    Raises:
        InputError: the file is damaged, lacks an array, or no field names one.
    """

    def __init__(self, path: Path, fields: BenchFields) -> None:
        named = list(topics(fields))
        if not named:
            raise InputError(f"no field names an array of {path}; name some, or use bcppl import bench.")
        for camera, each in fields.cameras.items():
            if each.topic:
                raise InputError(f"cameras.{camera} names {each.topic!r}; REASSEMBLE has no depth images.")
        refuse_axes(fields.wrench, _SENSOR, "sensor", "in the sensor's axes, about its origin")
        refuse_axes(fields.wrench, _BASE, "base", "in the base's axes, about its origin")
        if fields.wrench and fields.wrench.topic == _SENSOR and fields.gravity.load == "compensated":
            raise InputError(
                f"gravity.load is 'compensated', and the wrench is {_SENSOR}, with the tool's weight in it; "
                "leave gravity out, or give it load: stated."
            )
        self._held: dict[str, Numbers] = {}
        within = [f"{group}/{name}" for _, name in named for group in (STATE, STAMPS)]
        with opened(path, _REMEDY, within) as file:
            for field, name in named:
                self._held[name] = _numbers(path, file, field, name)

    def numbers(self, field: str, name: str) -> Numbers:
        """The rows of an array."""
        return self._held[name]


def arrays(path: Path) -> dict[str, Numbers]:
    """The arrays of a file with stamps, by name.

    Raises:
        InputError: the file is damaged, or has another layout.
    """
    with opened(path, _REMEDY, [STATE]) as file:
        known = _names(file, STATE)
    within = [STATE, *(f"{STAMPS}/{name}" for name in known)]
    with opened(path, _REMEDY, within) as file:
        return {name: _numbers(path, file, "the list", name) for name in known}


def segments(path: Path) -> list[Segment]:
    """The actions that are marked in a file, in order.

    Raises:
        InputError: the file is damaged, or has another layout.
    """
    with opened(path, _REMEDY, [SEGMENTS]) as file:
        numbered = sorted((int(name), name) for name in _names(file, SEGMENTS) if name.isdecimal())
        return [_segment(path, file[f"{SEGMENTS}/{name}"]) for _, name in numbered]


def board(path: Path) -> tuple[Array, Array] | None:
    """Translation (3,), metres, and quaternion x y z w of the board in the robot's base; None if not stated.

    The file of poses is beside the data, or in a folder `poses` beside theirs.

    Raises:
        InputError: there is such a file, and it is damaged.
    """
    name = f"{path.stem}_poses.json"
    places = [path.with_name(name), path.resolve().parent.parent / "poses" / name]
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        return None
    held = strict_json.read(file, _REMEDY)
    pose = held.get(BOARD) if isinstance(held, dict) else None
    try:
        place, turn = (np.asarray(each, dtype=np.float64) for each in pose)  # type: ignore[union-attr]
        if place.shape != (3,) or turn.shape != (4,) or abs(np.linalg.norm(turn) - 1.0) > 0.01:
            raise ValueError
    except (TypeError, ValueError):
        raise InputError(f"{file} has no {BOARD} of a place and a quaternion; {_REMEDY}.") from None
    return place, turn


def _numbers(path: Path, file: h5py.File, field: str, name: str) -> Numbers:
    for group in (STATE, STAMPS):
        if name not in (known := _names(file, group)):
            raise missing(path, field, name, known)
    values, times = (_dataset(path, file[group][name], f"{group}/{name}") for group in (STATE, STAMPS))
    times = times[:, 0] if times.shape[1:] == (1,) else times
    if times.ndim != 1 or values.ndim != 2 or len(times) != len(values):
        raise InputError(
            f"{path} has {STATE}/{name} of shape {values.shape}, its stamps {times.shape}; {_REMEDY}."
        )
    return Numbers(times, values)


def _names(file: h5py.File, group: str) -> list[str]:
    """The names in a group, none of which is opened."""
    if group not in list(file) or not isinstance(held := file[group], h5py.Group):
        raise InputError(f"{file.filename} has no group {group}; give a file of REASSEMBLE.")
    return sorted(held)


def _dataset(path: Path, node: Any, name: str) -> Array:
    if not isinstance(node, h5py.Dataset):
        raise InputError(f"{path} has a group in place of the array {name}; {_REMEDY}.")
    return table(path, name, node[()])


def _segment(path: Path, group: Any) -> Segment:
    numbers = [_scalar(path, group, name) for name in ("start", "end", "success")]
    held = group["text"]
    text = held[()] if isinstance(held, h5py.Dataset) and held.shape == () else None
    if not isinstance(text, bytes):
        raise InputError(f"{path} has a segment {group.name} without its text; {_REMEDY}.")
    return Segment(visible(text.decode(errors="replace")), numbers[0], numbers[1], bool(numbers[2]))


def _scalar(path: Path, group: Any, name: str) -> float:
    held = group[name]
    value = held[()] if isinstance(held, h5py.Dataset) and held.shape == () else None
    if not isinstance(value, np.number | np.bool_) or not np.isfinite(value):
        raise InputError(f"{path} has a segment {group.name} whose {name} is no number; {_REMEDY}.")
    return float(value)


def span(each: Segment, zero: float) -> Sequence[float]:
    """From when to when a segment lasts, seconds from the first pose."""
    return each.start - zero, each.end - zero

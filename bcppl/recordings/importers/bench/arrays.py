"""A log of which streams are arrays of a published data set, by the names that they have there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields
from bcppl.recordings.importers.bench.configuration.fields import (
    EVERY_JOINT,
    BenchFields,
    JointFields,
    PoseStreamFields,
    StreamFields,
    WrenchFields,
)
from bcppl.recordings.importers.bench.sources import Files

_FORCE, _TORQUE = "force", "torque"


@dataclass(frozen=True, eq=False)
class Numbers:
    """Rows of one array: stamps (T,) in seconds and values (T, C)."""

    times: Array
    values: Array


class Arrays(Protocol):
    """The arrays of a data set's file."""

    def numbers(self, field: str, name: str) -> Numbers:
        """The rows of an array that a field of the configuration names."""


class ArrayLog(Files):
    """Streams whose `topic` is an array's name; those with a file are read from it.

    A wrench's topic is the array of its forces; that of its torques is named alike.

    Args:
        arrays: of the data set's file.
        folder: that the configuration's paths are relative to.
        quaternion: the order of poses in the data set, "xyzw" or "wxyz".
    """

    def __init__(self, arrays: Arrays, folder: Path, quaternion: str) -> None:
        super().__init__(folder)
        self._arrays, self._quaternion = arrays, quaternion

    def rows(self, name: str, fields: StreamFields) -> tuple[Array, list[str]]:
        """Stamps in seconds and columns (T, 1 + C) of a stream, and what was done to read them.

        Raises:
            InputError: the array is missing, has other columns, or the configuration states what it has not.
        """
        if not fields.topic:
            return super().rows(name, fields)
        if isinstance(fields, WrenchFields):
            return self._wrench(name, fields.topic)
        held = self._arrays.numbers(name, fields.topic)
        values = held.values
        if isinstance(fields, PoseStreamFields):
            if fields.parent is not None:
                raise InputError(f"{name} has parent and child, which are for transforms; leave them out.")
            _refuse_columns(name, fields.topic, values, 7)
            values = values[:, [0, 1, 2, 4, 5, 6, 3]] if self._quaternion == "wxyz" else values
        if isinstance(fields, JointFields) and fields.columns != [EVERY_JOINT]:
            raise InputError(f"joints.columns: {fields.topic} holds all joints; leave columns out.")
        return np.column_stack([held.times, values]), []

    def intrinsics(self, name: str, fields: CameraFields) -> CameraFields:
        """The fields as they are stated.

        Raises:
            InputError: they name where the intrinsics are, and no array states them.
        """
        if fields.info:
            raise InputError(f"cameras.{name}.info: the file states no intrinsics; state fx, fy, cx, cy.")
        return fields

    def _wrench(self, name: str, topic: str) -> tuple[Array, list[str]]:
        twin = torques_of(topic)
        force, torque = self._arrays.numbers(name, topic), self._arrays.numbers(name, twin)
        for each, held in ((topic, force), (twin, torque)):
            _refuse_columns(name, each, held.values, 3)
        if np.array_equal(force.times, torque.times):
            return np.column_stack([force.times, force.values, torque.values]), []
        if not len(torque.times) or (np.diff(torque.times) < 0.0).any():
            raise InputError(f"{name}: the stamps of {twin} are not those of {topic}, and run backwards.")
        columns = [
            np.interp(force.times, torque.times, each, left=np.nan, right=np.nan) for each in torque.values.T
        ]
        note = f"{twin} has other stamps, at those of {topic} it is interpolated"
        return np.column_stack([force.times, force.values, *columns]), [note]


def torques_of(topic: str) -> str:
    """The name of the array of torques beside that of forces.

    Raises:
        InputError: the name is not one of forces.
    """
    before, word, after = topic.rpartition(_FORCE)
    if not word:
        raise InputError(f"wrench names {topic!r}; give the array of its forces, whose name has {_FORCE!r}.")
    return f"{before}{_TORQUE}{after}"


def topics(fields: BenchFields) -> Iterator[tuple[str, str]]:
    """The streams that name an array, and its name; of the wrench both."""
    for stream in ("wrench", "pose", "joints", "command"):
        held: StreamFields | None = getattr(fields, stream)
        if held is not None and held.topic:
            yield stream, held.topic
            if stream == "wrench":
                yield stream, torques_of(held.topic)


def refuse_axes(fields: WrenchFields | None, topic: str, axes: str, why: str) -> None:
    """Refuse a topic's wrench in other axes, or about another point, than the set's documents state."""
    if fields is not None and fields.topic == topic and (fields.axes, fields.about) != (axes, axes):
        raise InputError(
            f"wrench states axes: {fields.axes}, about: {fields.about}, but {fields.topic} is {why}; state "
            f"axes: {axes}, about: {axes}."
        )


def missing(path: Path, field: str, name: str, known: list[str]) -> InputError:
    """The error of an array that is not in a file."""
    close = get_close_matches(name, known, 1)
    meant = (
        f"write {close[0]!r} if that is meant" if close else f"its arrays are {', '.join(known) or 'none'}"
    )
    return InputError(f"{path} has no array {name!r}, which {field} names; {meant}.")


def table(path: Path, name: str, values: Any) -> Array:
    """An array of numbers, float64.

    Raises:
        InputError: it holds something else.
    """
    held = np.asarray(values)
    if held.dtype.kind not in "iuf":
        raise InputError(f"{path} holds {held.dtype} in {name}; give numbers.")
    return np.asarray(held, dtype=np.float64)


def _refuse_columns(field: str, topic: str, values: Array, count: int) -> None:
    if values.ndim != 2 or values.shape[1] != count:
        raise InputError(
            f"{field} names {topic}, of shape {values.shape}, and needs {count} columns; name another array."
        )

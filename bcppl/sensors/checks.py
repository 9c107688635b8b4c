"""Checks that kinds of measurement share: each problem is one sentence that names the place."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from bcppl.arguments import POSE_NUMBERS, pose_problem
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.robot.plan import FARTHEST, WIDEST
from bcppl.sensors.layout import same

LEAVE_OUT, FILL = "leave that row out", "fill it by interpolation, or cut the recording there"
SLOWEST, FASTEST = 0.5, 1e-5  # s: medians of a sensor's intervals beyond these are in another unit
UNITS = (("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9))
POSE_COLUMNS = "x y z qw qx qy qz"


def first(where: npt.ArrayLike) -> int:
    """The first place at which a condition holds."""
    return int(np.argmax(where))


def pose(what: str, values: object) -> Iterator[str]:
    """Problems of one pose (7,)."""
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        yield f"{what} is of type {type(values).__name__}; a pose is seven numbers {POSE_NUMBERS}."
        return
    if numbers.shape != (7,):  # a pose in a list of one is none: what is read after the checks adds numbers
        yield f"{what} has shape {numbers.shape}; a pose is seven numbers {POSE_NUMBERS}."
    elif problem := pose_problem(what, numbers):
        yield problem
    elif (away := float(np.abs(numbers[:3]).max())) > FARTHEST:
        yield (
            f"{what} is {away:.4g} m from its frame's origin, probably millimetres; scale x, y and z by "
            "0.001 to metres."
        )


def times(what: str, values: Array, remedy: str = LEAVE_OUT) -> Iterator[str]:
    """Problems of times (T,), which have to increase."""
    if np.ndim(values) != 1 or values.size == 0:
        yield f"{what} has times of shape {np.shape(values)}; give at least one time (T,), in seconds."
    elif not (finite := np.isfinite(values)).all():
        yield f"{what} has a time that is not finite at row {first(~finite)}; {remedy}."
    elif (np.diff(values) <= 0).any():
        row = first(np.diff(values) <= 0) + 1
        verb = "stand still" if values[row] == values[row - 1] else "run backwards"
        yield (
            f"{what} has times that {verb} at row {row} ({values[row]:.6f} s after {values[row - 1]:.6f} s); "
            "sort the rows and drop doubles."
        )


def readings(what: str, values: Array) -> Iterator[str]:
    """A problem of the unit of times (T,) at which a sensor was read: any start will do, no interval will."""
    step = float(np.median(np.diff(values))) if np.ndim(values) == 1 and np.size(values) > 1 else math.nan
    if step > SLOWEST:
        unit, scale = next((each for each in UNITS if step * each[1] <= SLOWEST), UNITS[-1])
        yield f"{what} are {step:.4g} s apart, probably {unit}; scale the times by {scale:g} to seconds."
    elif 0 < step < FASTEST:
        yield f"{what} are {step:.4g} s apart, as of no sensor, probably scaled twice; give times in seconds."


def rows(what: str, values: Array, at: Array, columns: str, remedy: str = LEAVE_OUT) -> Iterator[str]:
    """Problems of rows of numbers, one row for each time; `columns` names their columns, one word each."""
    if np.ndim(at) != 1 or np.shape(values) != (*np.shape(at), len(columns.split())):
        yield f"{what} has shape {np.shape(values)} for {np.shape(at)} times; give {columns} for each time."
    elif not (finite := np.isfinite(values).all(axis=1)).all():
        yield f"{what} has a number that is not finite at row {first(~finite)}; {remedy}."


def poses(what: str, values: Array, at: Array, remedy: str = LEAVE_OUT) -> Iterator[str]:
    """Problems of poses (T, 7), one for each time."""
    if wrong := list(rows(what, values, at, POSE_COLUMNS, remedy)):
        yield from wrong
        return
    length = np.linalg.norm(values[:, 3:], axis=1)
    if (np.abs(length - 1) > 1e-3).any():
        row = first(np.abs(length - 1) > 1e-3)
        yield f"{what} has a quaternion of length {length[row]:.4g} at row {row}; give it unit length."
    away = np.abs(values[:, :3]).max(axis=1)
    if (away > FARTHEST).any():
        yield (
            f"{what} is {away.max():.4g} m from the world's origin at row {int(away.argmax())}, probably "
            "millimetres; scale x, y and z by 0.001 to metres."
        )
    elif len(values) and (extent := float(np.ptp(values[:, :3], axis=0).max())) > WIDEST:
        yield f"{what} spans {extent:.4g} m, probably millimetres; scale x, y and z by 0.001 to metres."


def part(body: Part, closed: bool) -> Iterator[str]:
    """Problems of a part's mesh, which with `closed` has to enclose a solid."""
    shapes = np.shape(body.vertices), np.shape(body.faces)
    if not all(len(shape) == 2 and shape[1] == 3 for shape in shapes):
        yield (
            f"part {body.name!r} has vertices {shapes[0]} and faces {shapes[1]}; "
            "give (V, 3) and triangles (F, 3)."
        )
        return
    try:
        body.check(closed=closed)
    except InputError as error:
        yield str(error)


def named_alike(where: str, word: str, thing: Any, known: dict[str, Any]) -> Iterator[str]:
    """A problem where an object differs from an earlier one of its name, which `known` collects."""
    if not same(known.setdefault(thing.name, thing), thing):
        yield f"{where}: {word} {thing.name!r} differs from an earlier one; name it otherwise."

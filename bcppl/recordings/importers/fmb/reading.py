"""The arrays of an FMB trajectory in an .npz file, and a log of them.

obs/tcp_pose                   (N, 7), base_from_end_effector: m, and a quaternion x y z w
obs/tcp_force, obs/tcp_torque  (N, 3) each, N and N m in the end effector's frame
obs/q                          (N, 7) joint positions
obs/side_1_depth ..            (N, 256, 256), also of side_2, wrist_1 and wrist_2
primitive                      (N,) text: the skill of each row
"""

from __future__ import annotations

import functools
import itertools
from pathlib import Path
from typing import Any

import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError, reason_of
from bcppl.recordings import array_files
from bcppl.recordings.importers.bench.arrays import ArrayLog, Numbers, missing, refuse_axes, table, topics
from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields, ImageFields
from bcppl.recordings.importers.bench.configuration.field_types import factor
from bcppl.recordings.importers.bench.configuration.fields import BenchFields, StreamFields
from bcppl.recordings.importers.bench.depth_images import in_metres
from bcppl.recordings.importers.bench.sources import Shot

POSE, FORCE, PRIMITIVE = "obs/tcp_pose", "obs/tcp_force", "primitive"
_MAGIC = b"\x93NUMPY"
_HALF = 0.5  # rows from an image's time within which a row is


class Trajectory:
    """The arrays of a file, each read when it is asked for.

    Args:
        path: of the .npz file.
        rate: rows per second.

    Raises:
        InputError: the file is an .npy file, or no .npz file whose checksums are right.
    """

    def __init__(self, path: Path, rate: float) -> None:
        self.path, self.rate = path, rate
        if not path.is_file():
            raise InputError(f"there is no file {path}; give a trajectory of FMB.")
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) == _MAGIC:
                raise InputError(
                    f"{path} is an .npy file, in which FMB pickles a dictionary, and data never runs code; "
                    "convert it to .npz once, by the line in docs/import_bench.md."
                )
        try:
            self.names = array_files.members(path, checksums=True)
        except Exception as error:  # zip files have errors of many types
            raise _unreadable(path, error) from error

    def array(self, field: str, name: str) -> Any:
        """An array of numbers or text.

        Raises:
            InputError: it is not there, or holds objects.
        """
        if name not in self.names:
            raise missing(self.path, field, name, self.names)
        try:
            with np.load(self.path, allow_pickle=False) as arrays:
                return arrays[name]
        except Exception as error:  # numpy has errors of many types
            raise _unreadable(self.path, error, f" in {name}") from error

    def numbers(self, field: str, name: str) -> Numbers:
        """The rows of an array, at even stamps from zero on."""
        values = table(self.path, name, self.array(field, name))
        if values.ndim != 2:
            raise InputError(f"{self.path} has {name} of shape {values.shape}; {field} needs rows (N, C).")
        return Numbers(np.arange(len(values)) / self.rate, values)

    def skills(self) -> list[tuple[str, float, float]]:
        """The stretches of rows of one skill: its name, and from when to when (s); none if not stated."""
        if PRIMITIVE not in self.names:
            return []
        held = self.array("the list", PRIMITIVE)
        if held.ndim != 1 or held.dtype.kind != "U":
            return []
        stretches = []
        for name, rows in itertools.groupby(enumerate(held.tolist()), key=lambda row: row[1]):
            numbers = [number for number, _ in rows]
            stretches.append((str(name), numbers[0] / self.rate, numbers[-1] / self.rate))
        return stretches


class FmbLog(ArrayLog):
    """A trajectory as a log, whose cameras' topics are arrays of depth.

    Args:
        trajectory: its arrays.
        fields: the configuration.
        folder: that the configuration's paths are relative to.

    Raises:
        InputError: no field names an array, or the wrench is stated in other axes than the end effector's.
    """

    def __init__(self, trajectory: Trajectory, fields: BenchFields, folder: Path) -> None:
        super().__init__(trajectory, folder, "xyzw")
        self._trajectory = trajectory
        cameras = any(camera.topic for camera in fields.cameras.values())
        if not cameras and not list(topics(fields)):
            raise InputError(f"no field names an array of {trajectory.path}; name some.")
        refuse_axes(fields.wrench, FORCE, "frame", "in the end effector's axes, about its origin")

    def rows(self, name: str, fields: StreamFields) -> tuple[Array, list[str]]:
        """Stamps in seconds and columns (T, 1 + C) of a stream, and that its stamps are made.

        Raises:
            InputError: as `ArrayLog.rows`.
        """
        made, notes = super().rows(name, fields)
        return made, [*notes, *self._made(fields.topic)]

    def shots(self, name: str, fields: CameraFields) -> tuple[list[Shot], list[str]]:
        """The images of a camera at its times, or `every` so many seconds.

        Raises:
            InputError: the array is no stack of images, its unit is not stated, or a time is outside it.
        """
        if not fields.topic:
            return super().shots(name, fields)
        field = f"cameras.{name}"
        if fields.unit is None and fields.scale is None:
            raise InputError(f"{field} needs unit, or scale (metres per count): FMB states no unit of depth.")
        stack = self._trajectory.array(field, fields.topic)
        if stack.ndim != 3 or stack.dtype.kind not in "iuf" or not len(stack):
            raise InputError(
                f"{field} names {fields.topic}, {stack.dtype} of shape {stack.shape}; name a stack of depth "
                "images (N, H, W)."
            )
        unit = factor(fields.time_unit)
        shots = []
        for label, row in self._chosen(field, fields, len(stack)):
            time = row / self._trajectory.rate
            where = f"the image of {time:.3f} s in {fields.topic}"
            read = functools.partial(_depth, where, stack[row].copy(), fields)
            shots.append(Shot(label, ImageFields(time=time / unit), read))
        return shots, self._made(fields.topic)

    def _chosen(self, field: str, fields: CameraFields, count: int) -> list[tuple[str, int]]:
        """Labels of images, and their rows."""
        rate = self._trajectory.rate
        if fields.every is not None:
            step = max(1, round(fields.every * rate))
            return [(f"row {row}", row) for row in range(0, count, step)]
        chosen: dict[int, str] = {}
        for k, image in enumerate(fields.images):
            where, time = f"{field}.images[{k}]", factor(fields.time_unit) * (image.time or 0.0)
            row = round(time * rate)
            if not 0 <= row < count or abs(time * rate - row) > _HALF:
                raise InputError(
                    f"{where}.time is {time:.3f} s, and {fields.topic} has rows from 0 to "
                    f"{(count - 1) / rate:.3f} s; give a time in between."
                )
            if row in chosen:
                raise InputError(f"{where} is in the row of {chosen[row]}; leave one of them out.")
            chosen[row] = where
        return [(f"row {row}", row) for row in chosen]

    def _made(self, topic: str) -> list[str]:
        return [f"no stamps in the file, rows taken as {self._trajectory.rate:g} Hz"] if topic else []


def _depth(where: str, counts: Any, fields: CameraFields) -> Array:
    return in_metres(where, np.asarray(counts, dtype=np.float64), fields)


def _unreadable(path: Path, error: Exception, place: str = "") -> InputError:
    reason = reason_of(error)
    return InputError(
        f"{path} is no .npz file of plain arrays ({reason}{place}); convert the trajectory again."
    )

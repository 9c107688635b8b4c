"""Poses from what a configuration or a log states: translations with quaternions, vectors or matrices."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.field_types import PoseFields, factor
from bcppl.recordings.importers.bench.configuration.fields import JointFields, PoseStreamFields
from bcppl.recordings.importers.bench.in_order import read_stream
from bcppl.recordings.importers.bench.sources import Log
from bcppl.recordings.streams import Stream

UNIT = 0.01  # of a quaternion's length, or a matrix' columns: rounding in a log is less
_ROWS = 20_000  # of joint angles whose kinematics are computed at once


def stated_pose(name: str, fields: PoseFields) -> Array:
    """The pose (7,) of a field of the configuration.

    Raises:
        InputError: its quaternion is not of unit length, its matrix is no rotation or column by column, or
            its rotation vector is in degrees.
    """
    if fields.matrix is not None:
        rows = np.array([fields.matrix])
        return _poses(name, rows, "matrix", factor(fields.length), 1.0)[0]
    translation = np.array([fields.xyz])
    for rotation in ("xyzw", "wxyz", "vector"):
        if (numbers := getattr(fields, rotation)) is not None:
            rows = np.concatenate([translation, np.array([numbers])], axis=1)
            return _poses(name, rows, rotation, factor(fields.length), factor(fields.angle))[0]
    return np.append(factor(fields.length) * translation[0], [1.0, 0.0, 0.0, 0.0])


def read_poses(name: str, fields: PoseStreamFields, log: Log, report: list[str]) -> Stream:
    """The stream of poses (T, 7), `base_from_frame`.

    Raises:
        InputError: as `read_stream`, or a row is no pose.
    """
    stream = read_stream(name, fields, log, report)
    values = _poses(name, stream.values, fields.rotation, factor(fields.length), factor(fields.angle))
    return Stream(name, stream.times, values)


def read_joints(fields: JointFields, log: Log, report: list[str]) -> Stream:
    """The stream of poses (T, 7) of a robot's tip, `base_from_frame`, by its forward kinematics.

    Columns that bear the joints' names are the joints' in any order; others are in the order of the joints.

    Raises:
        InputError: as `read_stream`; the robot cannot be read, or has another number of joints up to its tip.
    """
    from bcppl.robot.kinematics import Robot  # reads URDF files, which takes seconds to import

    stream = read_stream("joints", fields, log, report)
    robot = Robot(log.folder / fields.urdf, tip=fields.tip)
    names = [joint.name for joint in robot.joints]
    if len(robot.joints) != stream.values.shape[1]:
        raise InputError(
            f"joints.columns names {stream.values.shape[1]} joints; {fields.urdf} has {len(robot.joints)} up "
            f"to {fields.tip!r}: give one column for each of {', '.join(names)}, in this order."
        )
    columns, values = [str(column) for column in fields.columns], stream.values
    if columns != names and set(columns) == set(names):
        values = values[:, [columns.index(name) for name in names]]
        report.append(f"joints: the columns are ordered by the names of the joints in {fields.urdf}")
    scale = np.array([1.0 if j.kind == "prismatic" else factor(fields.angle) for j in robot.joints])
    angles = torch.from_numpy(scale * values)
    tips = [robot.base_from_link(fields.tip, rows).numpy() for rows in angles.split(_ROWS)]
    return Stream("joints", stream.times, np.concatenate(tips))


def composed(first: Array, second: Array) -> Array:
    """`a_from_c` (..., 7) of `a_from_b` and `b_from_c`."""
    return poses.compose(torch.from_numpy(first), torch.from_numpy(second)).numpy()


def inverted(pose: Array) -> Array:
    """`b_from_a` of poses (..., 7)."""
    return poses.inverse(torch.from_numpy(pose)).numpy()


def _poses(name: str, rows: Array, rotation: str, length: float, angle: float) -> Array:
    """Poses (T, 7) of rows of numbers as they are stated."""
    if rotation == "matrix":
        _refuse_columnwise(name, rows)
        matrix = rows[:, :12].reshape(-1, 3, 4)
        turn = matrix[:, :, :3]
        off = np.abs(turn @ np.swapaxes(turn, 1, 2) - np.eye(3)).max(axis=(1, 2))
        if (wrong := (off > UNIT) | (np.linalg.det(turn) < 0.0)).any():
            raise InputError(
                f"{name} has a matrix that is no rotation, first in row {int(wrong.argmax())}; give "
                "its numbers row by row (a matrix column by column is its transpose)."
            )
        translation, quaternion = matrix[:, :, 3], Rotation.from_matrix(turn).as_quat()
    elif rotation == "vector":
        turned = np.linalg.norm(rows[:, 3:], axis=1)
        if angle == 1.0 and (wrong := turned > 2.0 * np.pi).any():
            row = int(wrong.argmax())
            raise InputError(
                f"{name} has a rotation vector of {turned[row]:.4g} rad in row {row}, more than a whole "
                "turn; state angle: deg."
            )
        translation, quaternion = rows[:, :3], Rotation.from_rotvec(angle * rows[:, 3:]).as_quat()
    else:
        translation = rows[:, :3]
        quaternion = rows[:, 3:] if rotation == "xyzw" else rows[:, [4, 5, 6, 3]]
        size = np.linalg.norm(quaternion, axis=1, keepdims=True)
        if (wrong := np.abs(size[:, 0] - 1.0) > UNIT).any():
            row = int(wrong.argmax())
            raise InputError(
                f"{name} has a quaternion of length {size[row, 0]:.4g} in row {row}; give four columns of "
                "unit length, and the order in which they are named."
            )
        quaternion = quaternion / size
    return np.concatenate([length * translation, quaternion[:, [3, 0, 1, 2]]], axis=1)


def _refuse_columnwise(name: str, rows: Array) -> None:
    """Refuse matrices of 16 numbers (T, 16) whose last row is not 0 0 0 1."""
    wrong = (np.abs(rows[:, 12:] - [0.0, 0.0, 0.0, 1.0][: rows.shape[1] - 12]) > 1e-6).any(axis=1)
    if wrong.any():
        row = int(wrong.argmax())
        columnwise = not rows[row, [3, 7, 11]].any()
        order = "they are column by column, as of libfranka" if columnwise else "their last is 0 0 0 1"
        raise InputError(
            f"{name} has a matrix whose last row is {rows[row, 12:].tolist()}, first in row {row}; give its "
            f"numbers row by row ({order})."
        )

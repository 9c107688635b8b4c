"""Poses and joint angles that are stated otherwise than a configuration says are not taken for others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.field_types import PoseFields
from bcppl.recordings.importers.bench.configuration.fields import JointFields, PoseStreamFields, TimeFields
from bcppl.recordings.importers.bench.pose_columns import read_joints, read_poses, stated_pose
from bcppl.recordings.importers.bench.sources import Files
from bcppl.robot.kinematics import Robot

URDF, TIP = Path(__file__).parents[3] / "models/robots/panda/panda.urdf", "panda_hand_tcp"
MATRIX = np.eye(4)
MATRIX[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
MATRIX[:3, 3] = [0.1, 0.2, 0.3]


def read(folder: Path, rows: Any, **fields: Any) -> Any:
    np.savez(folder / "poses.npz", t=np.arange(20) / 100.0, v=np.tile(rows, (20, 1)))
    columns = [f"v[{k}]" for k in range(len(rows))]
    time = TimeFields(column="t", unit="s")
    stated = PoseStreamFields(file="poses.npz", time=time, columns=columns, length="m", **fields)
    return read_poses("pose", stated, Files(folder), []).values


def test_a_matrix_column_by_column_is_refused(tmp_path: Path) -> None:
    assert read(tmp_path, MATRIX.ravel(), rotation="matrix")[0, :3] == pytest.approx([0.1, 0.2, 0.3])
    with pytest.raises(InputError, match=r"pose has a matrix whose last row is \[0\.1, 0\.2, 0\.3, 1\.0\]"):
        read(tmp_path, MATRIX.T.ravel(), rotation="matrix")
    with pytest.raises(InputError, match="they are column by column, as of libfranka"):
        stated_pose("frame_from_peg", PoseFields(matrix=MATRIX.T.ravel().tolist()))
    other = [*MATRIX[:3].ravel(), 5.0, 6.0, 7.0, 8.0]
    with pytest.raises(InputError, match=r"row by row \(their last is 0 0 0 1\)"):
        stated_pose("frame_from_peg", PoseFields(matrix=other))


def test_rotation_vectors_in_degrees_are_not_read_as_radians(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a rotation vector of 180 rad in row 0, .*; state angle: deg"):
        stated_pose("frame_from_peg", PoseFields(vector=[180.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="pose has a rotation vector of 35 rad"):
        read(tmp_path, [0.1, 0.2, 0.3, 0.0, 0.0, 35.0], rotation="vector")
    assert read(tmp_path, [0.1, 0.2, 0.3, 0.0, 0.0, 35.0], rotation="vector", angle="deg").shape == (20, 7)


def test_columns_with_the_joints_names_are_in_any_order(tmp_path: Path) -> None:
    robot = Robot(URDF, tip=TIP)
    names = [joint.name for joint in robot.joints]
    middle = [0.5 * (joint.lower + joint.upper) for joint in robot.joints]
    angles = middle + np.random.default_rng(0).uniform(-0.1, 0.1, (20, len(names)))
    np.savez(tmp_path / "joints.npz", t=np.arange(20) / 10.0, **dict(zip(names, angles.T, strict=True)))
    expected, time = robot.base_from_link(TIP, torch.from_numpy(angles)), TimeFields(column="t", unit="s")
    for columns, words in ((names, 0), (names[::-1], 1)):
        fields = JointFields(
            file="joints.npz", time=time, columns=columns, urdf=str(URDF), tip=TIP, angle="rad"
        )
        report: list[str] = []
        stream = read_joints(fields, Files(tmp_path), report)
        np.testing.assert_allclose(stream.values, expected.numpy(), atol=1e-9)
        assert "\n".join(report).count("ordered by the names of the joints") == words

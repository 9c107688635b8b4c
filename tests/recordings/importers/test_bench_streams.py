"""Rows of a bench's log: stamps that repeat or run backwards, rates, joint angles, common stamps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.fields import (
    ArmFields,
    CutFields,
    JointFields,
    StreamFields,
    TimeFields,
)
from bcppl.recordings.importers.bench.cutting import Rows, probes
from bcppl.recordings.importers.bench.in_order import read_stream
from bcppl.recordings.importers.bench.pose_columns import read_joints
from bcppl.recordings.importers.bench.sources import Files
from bcppl.recordings.streams import Stream, common_stamps, is_known, poses_at, values_at
from bcppl.robot.kinematics import Robot

URDF, TIP = Path(__file__).parents[3] / "models/robots/panda/panda.urdf", "panda_hand_tcp"


def read(folder: Path, times: Any, values: Any, unit: Any = "s") -> tuple[Stream, str]:
    np.savez(folder / "log.npz", t=times, v=values)
    fields = StreamFields(file="log.npz", time=TimeFields(column="t", unit=unit), columns=["v"])
    report: list[str] = []
    return read_stream("pose", fields, Files(folder), report), report[0]


def test_repeated_backward_and_unknown_rows_are_left_out_and_counted(tmp_path: Path) -> None:
    times, values = np.arange(1000) / 100.0, np.arange(1000.0)
    times[10] = times[9]
    times[20], values[20] = times[19], values[19]
    times[500] = times[495] + 0.001
    values[700] = np.nan
    stream, line = read(tmp_path, 1000.0 * times, values, "ms")
    assert len(stream.times) == 996 and (np.diff(stream.times) > 0).all()
    assert not {10.0, 500.0} & set(stream.values[:, 0])
    for words in (
        "1 row with a number that is not finite",
        "2 rows with a repeated stamp left out (1 of other values: its clock is coarse, or",
        "before an earlier",
    ):
        assert words in line
    assert "4 rows lost in 4 gaps" in line and "100 Hz" in line


def test_wrong_clocks_are_refused(tmp_path: Path) -> None:
    times, values = np.arange(1000) / 100.0, np.arange(1000.0)
    with pytest.raises(InputError, match=r"run backwards at 499 rows, first from 4\.990000 to 0\.000000 s"):
        read(tmp_path, np.concatenate([times[:500], times[:500]]), values)
    for right, scale, stated in (
        ("ms", 1e3, ["s", "ns"]),
        ("us", 1e6, ["s", "ms"]),
        ("ns", 1e9, ["ms", "us"]),
    ):
        for unit in stated:
            with pytest.raises(InputError, match=rf"probably they are in {right}: state pose\.time\.unit"):
                read(tmp_path, scale * times, values, unit)
    with pytest.raises(InputError, match=r"are 1e\+09 ns apart \(1 s\), as of no sensor\."):
        read(tmp_path, 1e11 * times, values, "ns")
    with pytest.raises(InputError, match="has 0 usable rows"):
        read(tmp_path, times, np.full(1000, np.nan))


def test_held_values_are_reported(tmp_path: Path) -> None:
    _, line = read(tmp_path, np.arange(1000) / 100.0, np.repeat(np.arange(250.0), 4))
    assert "75 % of the rows repeat the one before" in line


@pytest.mark.parametrize("rate", [20.0, 125.0, 333.3, 1000.0, 2000.0])
def test_a_line_is_a_line_at_any_rate(rate: float) -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.8, 1.2, round(4 * rate)) / rate)
    turned = Rotation.from_rotvec(np.outer(times, [0.3, -0.2, 0.5])).as_quat()[:, [3, 0, 1, 2]]
    signs = np.where(rng.uniform(size=(len(times), 1)) < 0.5, -1.0, 1.0)  # q and -q are one rotation
    values = np.column_stack([times, 2.0 * times, 0.0 * times, signs * turned])
    stream = Stream("pose", times, values)
    other = Stream("wrench", np.arange(4000) / 1000.0, np.zeros((4000, 6)))
    stamps = common_stamps(stream, other, None)
    step = np.diff(stamps)
    assert step == pytest.approx(np.full(len(step), 1.0 / np.clip(min(rate, 1000.0), 100.0, 500.0)), rel=0.03)
    inside = stamps[(stamps > times[0] + 0.01) & (stamps < times[-1] - 0.01)]
    at = poses_at(stream, inside)
    np.testing.assert_allclose(at[:, :2], np.stack([inside, 2.0 * inside], axis=1), atol=1e-9)
    there = Rotation.from_rotvec(np.outer(inside, [0.3, -0.2, 0.5])).as_quat()[:, [3, 0, 1, 2]]
    apart = poses.local(torch.from_numpy(at), torch.from_numpy(np.column_stack([at[:, :3], there])))
    assert float(apart.abs().max()) < 1e-5
    assert is_known(stream, inside, None).all()


def test_a_fast_stream_is_right_at_its_ends_too() -> None:
    times = np.arange(2001) / 2000.0
    stamps = np.arange(101) / 100.0
    line = values_at(Stream("pose", times, np.stack([times, -3.0 * times], axis=1)), stamps)
    np.testing.assert_allclose(line, np.stack([stamps, -3.0 * stamps], axis=1), atol=1e-5)


def test_a_fast_streams_noise_is_averaged() -> None:
    rng = np.random.default_rng(0)
    stream = Stream("wrench", np.arange(20_000) / 2000.0, rng.normal(size=(20_000, 1)))
    mean = values_at(stream, np.arange(10, 990) / 100.0)  # of twenty rows
    assert mean.std() == pytest.approx(1.0 / np.sqrt(20.0), rel=0.1)


def test_joint_angles_become_poses_of_the_tip(tmp_path: Path) -> None:
    robot = Robot(URDF, tip=TIP)
    count = len(robot.joints)
    angles = np.random.default_rng(0).uniform(-0.5, 0.5, (20, count))
    angles = np.clip(angles, [j.lower for j in robot.joints], [j.upper for j in robot.joints])
    columns = {f"q{k}": np.degrees(angles[:, k]) for k in range(count)}
    np.savez(tmp_path / "joints.npz", t=np.arange(20) / 10.0, **columns)
    fields = JointFields(
        file="joints.npz",
        time=TimeFields(column="t", unit="s"),
        columns=list(columns),
        angle="deg",
        urdf=str(URDF),
        tip=TIP,
    )
    stream = read_joints(fields, Files(tmp_path), [])
    expected = robot.base_from_link(TIP, torch.from_numpy(angles))
    np.testing.assert_allclose(stream.values, expected.numpy(), atol=1e-9)
    short = fields.model_copy(update={"columns": list(columns)[:-1]})
    with pytest.raises(InputError, match="give one column for each of"):
        read_joints(short, Files(tmp_path), [])


def test_touches_are_found_while_the_sensors_zero_drifts() -> None:
    stamps = np.arange(0.0, 60.0, 0.01)
    wrench = np.zeros((len(stamps), 6))
    wrench[:, 0] = 6.0 * stamps / 60.0  # N: three times the threshold
    for begin in (20.0, 40.0):
        wrench[(stamps >= begin) & (stamps < begin + 1.5), 2] += 5.0
    pose = np.tile([0.5, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0], (len(stamps), 1))
    rows = Rows(stamps, wrench, pose, np.ones(len(stamps), dtype=bool))
    report: list[str] = []
    windows = probes(rows, CutFields(find="touches"), ArmFields(), None, report)
    made = {m.action.probe.name: m.action.probe.stamps for m in windows}
    for found, begin in zip(made.values(), (20.0, 40.0), strict=True):
        assert found[[0, -1]] == pytest.approx([begin - 0.5, begin + 1.5 + 0.3], abs=0.03)
    assert "2 stretches with touches" in report[0] and "touches 2: begins 4.0 N" in report[-1]

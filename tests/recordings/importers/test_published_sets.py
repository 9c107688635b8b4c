"""REASSEMBLE and FMB files in their published layouts, written here; what is imported is what was the case.

The truth is a peg on an arm at smooth poses, with a smooth wrench on it; its numbers in each data set's own
axes and order come from SciPy alone.
"""

import json
import os
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
import typer
import yaml
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from bcppl.cli import app
from bcppl.errors import InputError
from bcppl.recordings import problems
from bcppl.recordings.importers import fmb, reassemble
from bcppl.recordings.importers.bench.configuration.reading import read_configuration
from bcppl.recordings.importers.fmb.reading import Trajectory
from tests.recordings.importers.bench_logs import touches

ZERO = 1736427594.25  # s, Unix time of the first row
EE_FROM_PEG = (np.array([0.003, -0.002, 0.09]), Rotation.from_rotvec([np.pi, 0.0, 0.0]))

COMMON = """\
part: {mesh: part.stl, length: mm, pieces: none}
peg: {round: [10, 60], length: mm}
guess:
  world_from_part: {xyz: [0.5, 0.1, 0.02]}
  translation: [20, 20, 20]
  length: mm
  tilt: 5
  yaw: 20
  angle: deg
frame_from_peg: {xyz: [3, -2, 90], length: mm, vector: [180, 0, 0], angle: deg}
clock: {wrench_late: 0}
gravity: {load: compensated}
"""


def motion(times: Any) -> tuple[Any, Rotation, Any]:
    """Places (T, 3) and rotations of the end effector in the base, and wrenches (T, 6) on the peg, in it."""
    place = np.stack([0.5 + 0.02 * np.sin(times), 0.1 + 0.01 * np.cos(times), 0.25 - 0.01 * times], axis=1)
    turn = Rotation.from_rotvec(np.stack([3.0 + 0.0 * times, 0.1 * np.sin(times), 0.05 * times], axis=1))
    wrench = np.stack([np.sin(times), 2.0 * np.cos(times), 5.0 + times], axis=1)
    return place, turn, np.concatenate([wrench, 0.02 * wrench[:, ::-1]], axis=1)


def peg(times: Any) -> tuple[Any, Rotation]:
    """Places (T, 3) and rotations of the peg in the base."""
    place, turn, _ = motion(times)
    return place + turn.apply(EE_FROM_PEG[0]), turn * EE_FROM_PEG[1]


def wrench_about(times: Any, point: Any, axes: Rotation | None) -> tuple[Any, Any]:
    """Force and torque (T, 3) on the peg about points of the base, in axes (of the base if None)."""
    place, turn = peg(times)
    wrench = motion(times)[2]
    force, torque = turn.apply(wrench[:, :3]), turn.apply(wrench[:, 3:])
    torque = torque + np.cross(place - point, force)
    return (force, torque) if axes is None else (axes.inv().apply(force), axes.inv().apply(torque))


def assert_touches(recording: Any, every: int = 1) -> None:
    """The recording's rows, or every so many of them, are those of the truth."""
    times, wrench, world_from_peg = (each[::every] for each in touches(recording))
    place, turn = peg(times)
    np.testing.assert_allclose(world_from_peg[:, :3], place, atol=1e-7)
    assert (turn.inv() * Rotation.from_quat(world_from_peg[:, [4, 5, 6, 3]])).magnitude().max() < 1e-6
    np.testing.assert_allclose(wrench, motion(times)[2], atol=1e-5)
    assert problems(recording) == []


def part(folder: Path) -> None:
    trimesh.creation.box((80.0, 60.0, 40.0)).export(folder / "part.stl")


# ---- REASSEMBLE


def write_reassemble(folder: Path) -> tuple[Path, Path]:
    """A file of the data set, its poses beside it, and a configuration."""
    part(folder)
    path = folder / "2025-01-09-13-59-54.h5"
    slow, fast = np.arange(2000) / 500.0, np.arange(4000) / 1000.0
    place, turn, _ = motion(slow)
    force, torque = wrench_about(slow, np.zeros(3), None)
    with h5py.File(path, "w") as file:
        file["hama1"] = np.void(b"\x00\x00\x00 ftypmp4" * 100)
        file["hand_audio"] = np.arange(300, dtype=np.int64) % 256
        file["events"] = h5py.ExternalLink("elsewhere.h5", "/x")  # never opened
        state = {
            "pose": (slow, np.column_stack([place, turn.as_quat()[:, [3, 0, 1, 2]]])),
            "compensated_base_force": (slow, force),
            "compensated_base_torque": (slow, torque),
            "measured_force": (fast, np.ones((4000, 3))),
            "measured_torque": (fast, np.ones((4000, 3))),
            "joint_positions": (fast, np.zeros((4000, 7))),
        }
        for name, (times, values) in state.items():
            file[f"robot_state/{name}"] = values
            file[f"timestamps/{name}"] = ZERO + (times[:, None] if name == "measured_force" else times)
        actions = [
            ("Pick peg.", 0.2, 1.0, True),
            ("Insert peg.", 1.0, 3.5, True),
            ("Insert nut.", 3.5, 3.9, False),
        ]
        for number, (text, start, end, success) in enumerate(actions):
            group = file.create_group(f"segments_info/{number}")
            group["text"], group["success"] = text, success
            group["start"], group["end"], group["index"] = ZERO + start, ZERO + end, number
            group["low_level/0/text"] = "Approach"
    pose = [[0.5, 0.1, 0.02], [0.0, 0.0, 0.6, 0.8]]
    (folder / f"{path.stem}_poses.json").write_text(json.dumps({"NIST_Board1": pose, "Hama1": pose}))
    config = folder / "reassemble.yaml"
    config.write_text(
        COMMON
        + "wrench: {topic: compensated_base_force, axes: base, about: base, sign: on_peg}\n"
        + "pose: {topic: pose}\n"
    )
    return path, config


def test_a_reassemble_file_becomes_its_touches(tmp_path: Path) -> None:
    path, config = write_reassemble(tmp_path)
    imported = reassemble.command(path, config)
    times, _, _ = touches(imported.recording)
    assert len(times) in (1999, 2000)  # Unix stamps are rounded to a quarter of a microsecond
    assert_touches(imported.recording)


def test_torques_on_another_clock_are_interpolated(tmp_path: Path) -> None:
    path, config = write_reassemble(tmp_path)
    with h5py.File(path, "r+") as file:
        times = file["timestamps/compensated_base_torque"][:-3] + 0.001
        _, torque = wrench_about(times - ZERO, np.zeros(3), None)
        for name, values in (("timestamps", times), ("robot_state", torque)):
            del file[f"{name}/compensated_base_torque"]
            file[f"{name}/compensated_base_torque"] = values
    imported = reassemble.command(path, config)
    assert "compensated_base_torque has other stamps" in "\n".join(imported.report)
    assert_touches(imported.recording)


def test_a_reassemble_file_is_listed_and_a_configuration_drafted(tmp_path: Path) -> None:
    path, _ = write_reassemble(tmp_path)
    new = tmp_path / "new.yaml"
    words = ["import", "reassemble", str(path), "--write", str(new)]
    shown = CliRunner().invoke(app, words, catch_exceptions=False, env={"COLUMNS": "200"})
    assert shown.exit_code == 0
    for line in ("measured_force +3 +4000 +1000 Hz", r"1 +1\.00 s +3\.50 s +yes +Insert peg"):
        assert re.search(line, shown.output), shown.output
    assert "the board is at {xyz: [0.5, 0.1, 0.02], xyzw: [0, 0, 0.6, 0.8]}" in shown.output
    fields = read_configuration(new)
    assert fields.cut.spans == [[1.0, 3.5]] and fields.gravity.load == "compensated"
    assert (fields.wrench.topic, fields.wrench.axes) == ("compensated_base_force", "base")
    with pytest.raises(typer.Exit):
        reassemble.command(path)


def changed(name: str, value: Any) -> Callable[[Path, Path], None]:
    """Puts something in place of a part of the HDF5 file."""

    def change(path: Path, config: Path) -> None:
        with h5py.File(path, "r+") as file:
            del file[name]
            if value is not None:
                file[name] = value

    return change


def stated(**fields: Any) -> Callable[[Path, Path], None]:
    """Changes the configuration."""

    def change(path: Path, config: Path) -> None:
        content = yaml.safe_load(config.read_text())
        for name, value in fields.items():
            content[name] = {**content.get(name, {}), **value}
        config.write_text(yaml.safe_dump(content))

    return change


def cut_off(path: Path, config: Path) -> None:
    path.write_bytes(path.read_bytes()[:-3000])


CAMERA = {"fx": 200.0, "fy": 200.0, "cx": 3.5, "cy": 2.5, "near": 0.1, "far": 2.0}
REASSEMBLE_MISTAKES: dict[str, Callable[[Path, Path], None]] = {
    "has no array 'compensated_base_torque', which wrench names": changed(
        "robot_state/compensated_base_torque", None
    ),
    "has no array 'pos', which pose names; write 'pose'": stated(pose={"topic": "pos"}),
    r"has robot_state/pose of shape \(2000, 7\), its stamps \(4,\)": changed("timestamps/pose", np.zeros(4)),
    r"/robot_state/pose is a link to another place": changed(
        "robot_state/pose", h5py.ExternalLink("elsewhere.h5", "/x")
    ),
    "holds neither numbers nor text": changed("robot_state/pose", np.void(b"abc")),
    r"holds .* in robot_state/pose; give numbers": changed("robot_state/pose", ["a", "b"]),
    "has no group timestamps": changed("timestamps", None),
    "pose has a quaternion of length 0 in row 0": stated(pose={"topic": "joint_positions"}),
    "wrench names 'pose'; give the array of its forces": stated(wrench={"topic": "pose"}),
    "compensated_base_force is in the base's axes, .* state axes: base, about: base": stated(
        wrench={"axes": "frame"}
    ),
    "cameras.hand names 'hand'; REASSEMBLE has no depth images": stated(
        cameras={"hand": {**CAMERA, "topic": "hand", "every": 1.0, "world_from_camera": {}}}
    ),
    "is not an HDF5 file|is damaged or cut off": cut_off,
}


@pytest.mark.long
@pytest.mark.parametrize("words", REASSEMBLE_MISTAKES)
def test_damage_to_a_reassemble_file_is_one_sentence(words: str, tmp_path: Path) -> None:
    path, config = write_reassemble(tmp_path)
    REASSEMBLE_MISTAKES[words](path, config)
    with pytest.raises(InputError, match=words) as failure:
        reassemble.command(path, config)
    assert "\n" not in str(failure.value) and str(failure.value).endswith(".")


# ---- FMB

WRIST = {"xyz": [0.06, 0.01, 0.03], "xyzw": [0.0, 0.0, 0.6, 0.8]}


def trajectory() -> dict[str, Any]:
    """The arrays of a trajectory, as FMB names them: 60 rows at 10 Hz, depth in counts of 0.1 mm."""
    times = np.arange(60) / 10.0
    place, turn, _ = motion(times)
    force, torque = wrench_about(times, place, turn)
    depth = np.zeros((60, 6, 8), np.uint16)
    depth += (3000 + 10 * np.arange(60)[:, None, None] + np.arange(8)).astype(np.uint16)
    depth[:, 2, 3] = 0
    return {
        "obs/tcp_pose": np.column_stack([place, turn.as_quat()]),
        "obs/tcp_force": force,
        "obs/tcp_torque": torque,
        "obs/wrist_1_depth": depth,
        "obs/side_1": np.zeros((60, 6, 8, 3), np.uint8),
        "primitive": np.array(["grasp"] * 20 + ["insert"] * 30 + ["move_up"] * 10),
    }


def write_fmb(folder: Path, **more: Any) -> tuple[Path, Path]:
    """A trajectory as .npz, and a configuration."""
    part(folder)
    path, config = folder / "trajectory.npz", folder / "fmb.yaml"
    np.savez(path, **{**trajectory(), **more})
    camera = {**CAMERA, "topic": "obs/wrist_1_depth", "scale": 1e-4, "frame_from_camera": WRIST}
    content = {
        **yaml.safe_load(COMMON),
        "wrench": {"topic": "obs/tcp_force", "axes": "frame", "about": "frame", "sign": "on_peg"},
        "pose": {"topic": "obs/tcp_pose"},
        "cameras": {"wrist_1": {**camera, "images": [{"time": 2.0}, {"time": 4.5}]}},
    }
    config.write_text(yaml.safe_dump(content))
    return path, config


def test_an_fmb_trajectory_becomes_its_views_and_touches(tmp_path: Path) -> None:
    path, config = write_fmb(tmp_path)
    imported = fmb.command(path, config)
    assert "no stamps in the file, rows taken as 10 Hz" in "\n".join(imported.report)
    times, _, _ = touches(imported.recording)
    assert len(times) == 591  # at 100 a second, between rows by straight lines
    assert_touches(imported.recording, every=10)
    views = [m for m in imported.recording.measurements if m.kind == "view"]
    for view, row in zip(views, (20, 45), strict=True):
        depth, camera = view.observation.depth, view.action.camera
        assert depth[1, 5] == pytest.approx(1e-4 * (3000 + 10 * row + 5), abs=1e-7)
        assert np.isnan(depth[2, 3]) and depth.shape == (6, 8)
        place, turn, _ = motion(np.array([0.1 * row]))
        expected = place[0] + turn.apply([WRIST["xyz"]])[0]
        np.testing.assert_allclose(camera.world_from_camera[:3], expected, atol=1e-9)
        turned = turn * Rotation.from_quat(WRIST["xyzw"])
        got = Rotation.from_quat(camera.world_from_camera[[4, 5, 6, 3]])
        assert (turned.inv() * got).magnitude().max() < 1e-9


def test_an_fmb_trajectory_is_listed_and_a_configuration_drafted(tmp_path: Path) -> None:
    path, _ = write_fmb(tmp_path)
    new = tmp_path / "new.yaml"
    shown = CliRunner().invoke(app, ["import", "fmb", str(path), "--write", str(new)], catch_exceptions=False)
    assert shown.exit_code == 0 and "obs/wrist_1_depth" in shown.output and "move_up" in shown.output
    fields = read_configuration(new)
    assert fields.cut.spans == [[2.0, 4.9]] and fields.cameras["wrist_1"].topic == "obs/wrist_1_depth"


def test_a_name_of_an_array_is_no_line_of_the_drafted_configuration(tmp_path: Path) -> None:
    name = "obs/side 1: x\nsource: 'injected'\n#\x1b_depth"
    path, _ = write_fmb(tmp_path, **{name: trajectory()["obs/wrist_1_depth"]})
    named = path.rename(tmp_path / "a\nsource: 'injected'\n#.npz")
    new = tmp_path / "new.yaml"
    with pytest.raises(typer.Exit):
        fmb.command(named, write=new)
    fields = read_configuration(new)
    assert fields.source == ""
    assert sorted(camera.topic for camera in fields.cameras.values()) == [name, "obs/wrist_1_depth"]
    assert new.read_text().replace("\n", "").isprintable()


def test_the_line_of_the_docs_converts_a_pickled_trajectory(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs/import_bench.md").read_text(encoding="utf-8")
    (line,) = re.findall(r'^python -c "(.*)" trajectory\.npy trajectory\.npz$', page, re.MULTILINE)
    pickled: Any = {**trajectory(), "object_info": {"shape": 2, "length": "L"}}
    np.save(tmp_path / "a.npy", pickled, allow_pickle=True)
    subprocess.run([sys.executable, "-c", line, tmp_path / "a.npy", tmp_path / "a.npz"], check=True)
    made = Trajectory(tmp_path / "a.npz", 10.0)
    assert made.names == sorted(trajectory())
    for name, values in trajectory().items():
        np.testing.assert_array_equal(made.array("test", name), values)
    assert made.skills()[1] == ("insert", 2.0, 4.9)


class Hostile:
    """Makes a folder when it is unpickled."""

    def __init__(self, made: Path) -> None:
        self.made = str(made)

    def __reduce__(self) -> Any:
        return os.mkdir, (self.made,)


@pytest.mark.parametrize("kind", ["npy", "member"])
def test_pickled_trajectories_are_refused_and_run_nothing(kind: str, tmp_path: Path) -> None:
    path, config = write_fmb(tmp_path)
    made = tmp_path / "made"
    hostile = np.array({"obs/tcp_pose": Hostile(made)}, dtype=object)
    if kind == "npy":
        path = tmp_path / "trajectory.npy"
        np.save(path, hostile, allow_pickle=True)
        words = r"is an \.npy file, in which FMB pickles a dictionary, and data never runs code"
    else:
        np.savez(path, **{**trajectory(), "obs/tcp_pose": hostile})
        words = r"is no \.npz file of plain arrays \(Object arrays cannot be loaded"
    with pytest.raises(InputError, match=words) as failure:
        fmb.command(path, config)
    assert "\n" not in str(failure.value) and str(failure.value).endswith(".")
    assert not made.exists()
    pickle.loads(pickle.dumps(hostile))
    assert made.is_dir()  # that is what reading it would have done


FMB_MISTAKES: dict[str, Callable[[Path, Path], None]] = {
    "cameras.wrist_1 needs unit, or scale .*: FMB states no unit of depth": lambda path, config: (
        config.write_text(config.read_text().replace("    scale: 0.0001\n", ""))
    ),
    r"images\[0\].time is 7.000 s, and obs/wrist_1_depth has rows from 0 to 5.900 s": (
        lambda path, config: config.write_text(config.read_text().replace("time: 2.0", "time: 7.0"))
    ),
    r"images\[1\] is in the row of cameras.wrist_1.images\[0\]": (
        lambda path, config: config.write_text(config.read_text().replace("time: 2.0", "time: 4.48"))
    ),
    "median depth of 0.003": lambda path, config: config.write_text(
        config.read_text().replace("scale: 0.0001", "scale: 0.000001")
    ),
    "obs/tcp_force is in the end effector's axes": stated(wrench={"axes": "base"}),
    "has no array 'obs/tcp_pos', which pose names; write 'obs/tcp_pose'": stated(
        pose={"topic": "obs/tcp_pos"}
    ),
    "pose names obs/tcp_torque, of shape .* needs 7 columns": stated(pose={"topic": "obs/tcp_torque"}),
    r"is no \.npz file of plain arrays": cut_off,
    r"the checksum of obs/tcp_pose\.npy is wrong": lambda path, config: path.write_bytes(
        bytes(byte ^ (255 if k == 900 else 0) for k, byte in enumerate(path.read_bytes()))
    ),
}


@pytest.mark.parametrize("words", FMB_MISTAKES)
def test_damage_to_an_fmb_trajectory_is_one_sentence(words: str, tmp_path: Path) -> None:
    path, config = write_fmb(tmp_path)
    FMB_MISTAKES[words](path, config)
    with pytest.raises(InputError, match=words) as failure:
        fmb.command(path, config)
    assert "\n" not in str(failure.value) and str(failure.value).endswith(".")

"""Logs that know nothing of the importer come back as what was the case; mistakes in frames are seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from typer.testing import CliRunner

from bcppl import poses
from bcppl.cli import app
from bcppl.errors import InputError
from bcppl.recordings import load, problems
from bcppl.recordings.importers import Imported
from bcppl.recordings.importers.bench import command
from tests.recordings.importers import bench_logs

STATED = {"clock": "{wrench_late: 8, unit: ms}"}


def agrees(imported: Imported, there: bench_logs.Truth) -> bool:
    """Whether the wrench, but for its zero, and the pose are those that were the case."""
    times, wrench, peg = bench_logs.touches(imported.recording)
    true_wrench, true_peg = bench_logs.truth_at(there, times, 0.002)
    off = wrench - true_wrench
    off -= off.mean(axis=0)
    apart = poses.local(torch.from_numpy(peg), torch.from_numpy(true_peg)).abs().max()
    limits = np.array([0.005] * 3 + [0.0005] * 3)  # N, N m; contacts exert up to 58 N
    return bool((np.abs(off) < limits).all() and apart < 1e-6)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bench_logs.Truth]:
    there = bench_logs.truth(0)
    return bench_logs.write(tmp_path_factory.mktemp("log"), there, bench_logs.Log(more=STATED)), there


def test_a_log_becomes_what_was_the_case(written: tuple[Path, bench_logs.Truth]) -> None:
    path, there = written
    imported = command(path)
    recording = imported.recording
    assert problems(recording) == [] and agrees(imported, there)
    assert recording.part.extent == pytest.approx(there.scene.part.extent, abs=1e-8)
    assert recording.peg is not None and recording.peg.pieces and recording.model == "look_and_touch"
    np.testing.assert_allclose(recording.guess.world_from_part, there.scene.guess.world_from_part, atol=1e-9)
    assert recording.guess.yaw == pytest.approx(there.scene.guess.yaw)
    for mine, view in zip(recording.measurements, there.scene.look().measurements, strict=False):
        off = mine.observation.depth - view.observation.depth
        assert np.nanmax(np.abs(off)) < 0.00051  # images are of whole millimetres
        assert (np.isnan(mine.observation.depth) == np.isnan(view.observation.depth)).all()
        np.testing.assert_allclose(mine.action.camera.world_from_camera, view.action.camera.world_from_camera)
    report = "\n".join(imported.report)
    assert "pose: 5998 rows at 500 Hz" in report and "1000 Hz" in report and "8 ms late, as stated" in report
    assert "0.900 ± 0.000 kg" in report and "common stamps" in report


def test_images_alone_are_a_recording_before_any_touch(written: tuple[Path, bench_logs.Truth]) -> None:
    path, _ = written
    whole, fields = command(path).recording, yaml.safe_load(path.read_text())
    for name in ("wrench", "frame_from_peg", "frame_from_sensor", "gravity", "clock", "cut", "arm"):
        fields.pop(name, None)
    seen = path.with_name("seen.yaml")
    seen.write_text(yaml.safe_dump(fields))
    recording = command(seen).recording
    views = [m for m in whole.measurements if m.kind == "view"]
    assert [m.kind for m in recording.measurements] == ["view"] * len(views) and recording.peg is not None
    for mine, theirs in zip(recording.measurements, views, strict=True):
        np.testing.assert_array_equal(mine.observation.depth, theirs.observation.depth)
        np.testing.assert_array_equal(
            mine.action.camera.world_from_camera, theirs.action.camera.world_from_camera
        )
    del fields["pose"]  # the cameras stand
    seen.write_text(yaml.safe_dump(fields))
    assert len(command(seen).recording.measurements) == len(views)


MISTAKES = {
    "sign": ("sign: on_peg", "sign: by_peg"),
    "order of the quaternion": ("rotation: xyzw", "rotation: wxyz"),
    "order of its columns": ("qx, qy, qz, qw]", "qw, qx, qy, qz]"),
    "lever arm of the sensor": ("xyz: [0.0, 2.0, 30.0]", "xyz: [0.0, 2.0, 31.0]"),
    "lever arm of the peg": ("-3.0, 120.0]", "-3.0, 119.0]"),
    "turn of the sensor": ("axes: sensor", "axes: frame"),
    "point of the torques": ("about: sensor", "about: frame"),
    "axes of the base": ("axes: sensor", "axes: base"),
    "clock": ("wrench_late: 8", "wrench_late: 7"),
    "its sign": ("wrench_late: 8", "wrench_late: -8"),
    "unit of torques": ("torque: Nmm", "torque: Ncm"),
    "weight": ("clock:", "gravity: {load: compensated}\nclock:"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_each_mistake_in_the_configuration_is_seen(name: str, written: tuple[Path, bench_logs.Truth]) -> None:
    path, there = written
    text, (right, wrong) = path.read_text(), MISTAKES[name]
    assert text.count(right) == 1
    mistaken = path.with_name("mistaken.yaml")
    mistaken.write_text(text.replace(right, wrong))
    assert not agrees(command(mistaken), there)


@pytest.mark.long
def test_a_controllers_wrench_in_the_bases_axes(tmp_path: Path) -> None:
    there = bench_logs.truth(1)
    path = bench_logs.write(tmp_path, there, bench_logs.Log(in_base=True, more=STATED))
    assert agrees(command(path), there)
    path.write_text(path.read_text().replace("about: frame", "about: peg"))
    assert not agrees(command(path), there)


def test_a_stated_drift_is_taken_off(tmp_path: Path) -> None:
    there = bench_logs.truth(0)
    stated = {"clock": "{wrench_late: 8, unit: ms, drift: 300}"}
    path = bench_logs.write(tmp_path, there, bench_logs.Log(drift=300.0, more=stated))
    assert agrees(command(path), there)
    path.write_text(path.read_text().replace("drift: 300", "drift: -300"))
    assert not agrees(command(path), there)


def test_a_stated_load_is_given_in_the_sensors_frame(written: tuple[Path, bench_logs.Truth]) -> None:
    path, there = written
    stated = path.with_name("stated.yaml")
    gravity = f"gravity: {{load: stated, mass: {bench_logs.MASS}, center: {bench_logs.CENTER.tolist()}}}\n"
    stated.write_text(path.read_text() + gravity)
    assert agrees(command(stated), there)


@pytest.mark.long
def test_a_clock_that_is_set_between_two_touches_is_named(tmp_path: Path) -> None:
    log = bench_logs.Log(noise=(0.1, 0.005, 0.00002), bends=2e-5, jumps=(9.5, 0.03), seed=3003)
    report = "\n".join(command(bench_logs.write(tmp_path, bench_logs.truth(3003), log)).report)
    assert "put its lateness elsewhere than the others" in report
    assert "which is taken off" not in report.split("clocks:")[1].splitlines()[0]


@pytest.mark.long
@pytest.mark.parametrize(("seed", "late"), [(0, 0.008), (2, -0.05), (5, 0.05)])
def test_the_clock_is_estimated_from_contacts(seed: int, late: float, tmp_path: Path) -> None:
    there = bench_logs.truth(seed)
    log = bench_logs.Log(late=late, noise=(0.1, 0.005, 0.00002), bends=2e-5, seed=seed)
    report = "\n".join(command(bench_logs.write(tmp_path, there, log)).report)
    stated = report.partition("clocks: the wrench is ")[2].split()
    assert abs(float(stated[0]) - 1000.0 * late) < min(2.0, 2.5 * float(stated[2])), report


def test_a_log_without_contacts_does_not_show_its_clock(tmp_path: Path) -> None:
    there = bench_logs.truth(0)
    air = slice(0, 5500)
    free = bench_logs.Truth(there.scene, there.times[air], there.world_from_peg[air], there.wrench[air])
    imported = command(bench_logs.write(tmp_path, free, bench_logs.Log(noise=(0.1, 0.005, 0.00005))))
    assert "does not show how late the wrench is (from -100 to 100 ms)" in "\n".join(imported.report)


def test_lost_rows_are_reported_and_left_out(tmp_path: Path) -> None:
    there = bench_logs.truth(0)
    log = bench_logs.Log(skip=((3000, 3040), (7000, 7100)), more=STATED)
    imported = command(bench_logs.write(tmp_path, there, log))
    report = "\n".join(imported.report)
    assert "140 rows lost in 2 gaps, the longest 101 ms at 7.00 s" in report
    assert "touches: 70 of 5996 stamps are left out" in report
    assert agrees(imported, there) and problems(imported.recording) == []
    path = bench_logs.write(tmp_path, there, bench_logs.Log(skip=((7000, 7400),), more=STATED))
    with pytest.raises(InputError, match=r"touches lacks data from 7\.00 to 7\.40 s; state cut\.spans"):
        command(path)
    text = path.read_text()
    path.write_text(text + "cut: {spans: [[0.5, 6.9], [3.0, 6.0]]}\n")
    with pytest.raises(InputError, match=r"begins at 3 s, before another ends at 6\.9 s"):
        command(path)
    path.write_text(text + "cut: {spans: [[0.5, 6.9], [7.5, 11.5]]}\n")
    imported = command(path)
    assert agrees(imported, there) and problems(imported.recording) == []
    names = {m.action.probe.name for m in imported.recording.measurements if m.kind == "window"}
    assert names == {"touches 1", "touches 2"}


def test_touches_are_found_by_their_force(written: tuple[Path, bench_logs.Truth]) -> None:
    path, there = written
    found = path.with_name("found.yaml")
    found.write_text(path.read_text() + "cut: {find: touches, before: 0.3, after: 0.2, window: 0.25}\n")
    imported = command(found)
    windows = [m for m in imported.recording.measurements if m.kind == "window"]
    first = windows[0].action.probe.stamps[0]
    onset = there.times[np.argmax(np.linalg.norm(there.wrench[:, :3], axis=1) > 2.0)]
    assert first == pytest.approx(onset - 0.3, abs=0.05) and problems(imported.recording) == []
    times, wrench, _ = bench_logs.touches(imported.recording)
    assert len(times) < 3500 and np.ptp(np.linalg.norm(wrench[:, :3], axis=1)) > 20.0
    assert max(len(m.observation.times) for m in windows) == 125


def test_a_camera_on_the_arm_is_where_the_arm_was(written: tuple[Path, bench_logs.Truth]) -> None:
    path, there = written
    text = path.read_text()
    cameras = text.index("cameras:")
    wrist = (
        "cameras:\n  wrist: {fx: 160, fy: 160, cx: 79.5, cy: 59.5, near: 0.1, far: 2, unit: mm,\n"
        "    frame_from_camera: {xyz: [60, 0, 40], length: mm},\n"
        "    images: [{file: view_0.png, time: 5122.4007}, {file: view_1.png, time: 5123.4}]}\n"
    )
    moving = path.with_name("moving.yaml")
    moving.write_text(text[:cameras] + wrist + "clock: {wrench_late: 8, unit: ms}\n")
    imported = command(moving)
    assert problems(imported.recording) == [] and "the arm moved at up to" in "\n".join(imported.report)
    _, peg = bench_logs.truth_at(there, np.array([2.0007]), 0.002)
    turn, place = bench_logs.flanges(peg)
    camera = imported.recording.measurements[0].action.camera
    assert camera.name == "wrist 0" and camera.instrument == "wrist"
    np.testing.assert_allclose(
        camera.world_from_camera[:3], place[0] + turn.apply([0.06, 0.0, 0.04])[0], atol=3e-6
    )
    moving.write_text(moving.read_text().replace("5123.4", "123.4"))
    with pytest.raises(InputError, match=r"images\[1\]\.time is 123\.400 s, when no pose was logged"):
        command(moving)


def test_commands_write_the_configuration_and_import_it(written: tuple[Path, Any], tmp_path: Path) -> None:
    path, _ = written
    out = tmp_path / "recording.h5"
    done = CliRunner().invoke(app, ["import", "bench", str(path), "-o", str(out)], catch_exceptions=False)
    assert done.exit_code == 0 and "common stamps: 5996 at 500 Hz" in done.output
    assert problems(load(out)) == []
    over = CliRunner().invoke(app, ["import", "bench", str(path), "-o", str(path)]).exception
    assert (
        isinstance(over, InputError)
        and "would overwrite" in str(over)
        and path.read_text().startswith("part")
    )
    new = tmp_path / "new.yaml"
    assert CliRunner().invoke(app, ["new", "bench", str(new)], catch_exceptions=False).exit_code == 0
    lines = [line for line in new.read_text().splitlines() if not line.startswith("#")]
    assert len(lines) <= 40
    with pytest.raises(InputError, match="there is no mesh file"):  # as far as files that are not there
        command(new)
    assert isinstance(CliRunner().invoke(app, ["new", "bench", str(new)]).exception, InputError)

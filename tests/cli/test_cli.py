"""The command line: what is wrong is one sentence and exit code 2, and leaves nothing behind."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from bcppl.geometry.camera import Camera
from bcppl.recordings import DepthImage, Measurement, Recording, View, load, problems, save
from bcppl.sensors.push import PushSensor
from tests.command_line import SHIPPED, Ran, short

DATA = Path(__file__).parents[3] / "shared/data"
replace = dataclasses.replace


def assert_refused(ran: Ran, message: str) -> None:
    lines = ran.err.strip().splitlines()
    assert ran.code == 2, (ran.code, ran.err)
    assert len(lines) == 1 and lines[0].startswith("bcppl: ") and lines[0].endswith("."), ran.err
    assert message in lines[0], lines[0]
    assert "Traceback" not in ran.err + ran.out


def changed(values: Any, place: Any, to: float) -> Any:
    values = np.array(values)
    values[place] = to
    return values


def first_push(**changes: Any) -> Recording:
    """The recording with the first push's action or touch changed."""
    whole = short()
    first = whole.measurements[0]
    action = {k: v for k, v in changes.items() if k == "world_from_tip"}
    touch = {k: v for k, v in changes.items() if k not in action}
    new = Measurement(replace(first.action, **action), replace(first.observation, **touch))
    return replace(whole, measurements=[new, *whole.measurements[1:]])


def viewed(height: float = 0.5, rows: int = 6) -> Recording:
    """One depth image from above the part."""
    camera = Camera("above", 8, 6, 9.0, 9.0, 4.0, 3.0, np.array([0.03, 0.03, height, 0, 1, 0, 0]), 0.05, 4.0)
    return replace(
        short(),
        measurements=[Measurement(View(camera), DepthImage(np.full((rows, 8), 0.45)))],
        model="part_in_view",
    )


def part(**changes: Any) -> Recording:
    whole = short()
    return replace(whole, part=replace(whole.part, **changes))


def touch_of(recording: Recording) -> Any:
    return recording.measurements[0].observation


BAD: dict[str, tuple[Callable[[], Recording], str]] = {
    "mesh in millimetres": (lambda: part(vertices=1e3 * short().part.vertices), "millimetres"),
    "open mesh": (lambda: part(faces=short().part.faces[1:]), "open mesh"),
    "empty mesh": (lambda: part(faces=np.zeros((0, 3), dtype=np.int64)), "empty mesh"),
    "camera inside the part": (lambda: viewed(height=0.01), "inside it"),
    "camera in millimetres": (lambda: viewed(height=500.0), "probably millimetres"),
    "depth image of another size": (lambda: viewed(rows=5), "8×5"),
    "times that run backwards": (
        lambda: first_push(times=changed(touch_of(short()).times, 7, 0.0)),
        "run backwards at row 7",
    ),
    "NaN in a wrench": (
        lambda: first_push(wrench=changed(touch_of(short()).wrench, (4, 1), np.nan)),
        "measurement 0's wrench has a number that is not finite at row 4",
    ),
    "no measurement": (lambda: short(0), "no measurement"),
    "unknown model in the file": (lambda: replace(short(), model="nobody"), "no model 'nobody': give one of"),
    "a model for other measurements": (lambda: replace(short(), model="part_in_view"), "(it explains view)"),
    "views for a model of pushes": (lambda: replace(viewed(), model="point_probe"), "(it explains push)"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_recording_is_refused_before_anything_is_written(
    case: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    make, message = BAD[case]
    save(make(), tmp_path / "bad.h5")
    assert_refused(bcppl("run", "bad.h5", "--particles", 5), message)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.h5"]


@pytest.mark.parametrize("case", [c for c in BAD if problems(BAD[c][0]())])
def test_check_lists_what_is_wrong(case: str, bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    make, message = BAD[case]
    save(make(), tmp_path / "bad.h5")
    ran = bcppl("check", "bad.h5")
    assert ran.code == 2 and "Traceback" not in ran.err + ran.out, ran
    assert message in " ".join(ran.out.split()), ran.out
    assert "no problem" not in ran.out


def test_check_lists_all_problems(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    bad = first_push(wrench=changed(touch_of(short()).wrench, (4, 1), np.nan))
    bad = replace(bad, part=replace(bad.part, faces=bad.part.faces[1:]), truth=np.full(7, np.nan))
    save(bad, tmp_path / "bad.h5")
    ran = bcppl("check", "bad.h5")
    assert ran.code == 2 and ran.out.count("wrong:") == 3
    for message in ("open mesh", "the truth", "measurement 0's wrench"):
        assert message in ran.out
    listed = json.loads(bcppl("check", "bad.h5", "--json").out)
    assert len(listed["problems"]) == 3 and "point finger" not in listed["description"]
    assert bcppl("check", SHIPPED).code == 0


# Large enough to be looked at for doubts.
LARGE = Measurement(
    View(Camera("large", 80, 60, 90.0, 90.0, 40.0, 30.0, np.array([0.03, 0.03, 0.5, 0, 1, 0, 0]))),
    DepthImage(np.full((60, 80), 0.45)),
)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("measurements/000000/observation/times", np.arange(20.0)[:, None], "has times of shape (20, 1)"),
        ("guess/translation", np.array(0.02), "the guess's translation is not three finite half widths"),
        ("guess/world_from_part", np.eye(7)[3:4], "the guess (world_from_part) has shape (1, 7)"),
        ("truth/world_from_part", np.eye(7)[3:4], "the truth (world_from_part) has shape (1, 7)"),
    ],
)
def test_check_lists_an_odd_shape_as_what_is_wrong(
    name: str, value: Any, message: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    save(replace(short(), measurements=[*short().measurements, LARGE]), tmp_path / "bad.h5")
    with h5py.File(tmp_path / "bad.h5", "a") as file:
        units = file[name].attrs["units"]
        del file[name], file.attrs["sha256"]
        file.create_dataset(name, data=value).attrs["units"] = units
    ran = bcppl("check", "bad.h5")
    assert ran.code == 2 and "Traceback" not in ran.err + ran.out, ran
    assert "wrong:" in ran.out and message in " ".join(ran.out.split())
    assert "3 pushes" in ran.out  # the description, where it can be made


def test_check_lists_problems_where_nothing_can_be_described(
    bcppl: Callable[..., Ran], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with a kind of measurement whose package describes what has no problem alone."""

    def fails(*given: Any) -> Any:
        raise TypeError

    monkeypatch.setattr(PushSensor, "describe", fails)
    save(replace(short(), truth=np.full(7, np.nan)), tmp_path / "bad.h5")
    ran = bcppl("check", "bad.h5", "--json")
    assert ran.code == 2 and len(json.loads(ran.out)["problems"]) == 1
    assert bcppl("check", SHIPPED).code == 1  # a mistake of the package is one


def newer(path: Path) -> None:
    path.write_bytes(SHIPPED.read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = 99


def truncated(path: Path) -> None:
    content = SHIPPED.read_bytes()
    path.write_bytes(content[: len(content) // 2])


FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "newer schema": (newer, "schema version 99"),
    "truncated": (truncated, "file.h5"),
    "text": (lambda path: path.write_text("not a recording"), "not an HDF5 file"),
    "missing": (lambda path: None, "not a file"),
    "directory": (lambda path: path.mkdir(), "not a file"),
}


@pytest.mark.parametrize("command", ["run", "check"])
@pytest.mark.parametrize("case", FILES)
def test_a_file_that_is_no_recording_is_refused(
    case: str, command: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    make, message = FILES[case]
    make(tmp_path / "file.h5")
    before = sorted(tmp_path.iterdir())
    assert_refused(bcppl(command, "file.h5"), message)
    assert sorted(tmp_path.iterdir()) == before


NO_MODEL = "import math\n"
USER_FILES = {
    "syntax error": ("def model(:\n", "no valid Python", "line 1"),
    "nothing defined": (NO_MODEL, "defines no", "named"),
    "raises": ("raise ValueError('no\\nthing')\n", "stopped with ValueError", "no thing"),
    "exits": ("import sys\nsys.exit(0)\n", "stopped with SystemExit", "0"),
    "imports what is missing": ("import no_such_package\n", "no_such_package", "stopped with"),
    "of another kind": ("model = 3\ninfer = 3\n", "defines no", "needs"),
    "binary": ("\0\1", "is no valid Python", "null"),
}


@pytest.mark.parametrize("option", ["--model", "--inference"])
@pytest.mark.parametrize("case", USER_FILES)
def test_a_users_file_that_cannot_be_run(
    case: str, option: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    text, *message = USER_FILES[case]
    (tmp_path / "mine.py").write_text(text)
    ran = bcppl("run", SHIPPED, option, "mine.py")
    for each in ("mine.py", *message):
        assert_refused(ran, each)
    assert not (tmp_path / "runs").exists()


OPTIONS = {
    "unknown model": (["--model", "nobody"], "no model 'nobody': give one of "),
    "unknown inference": (
        ["--inference", "magic"],
        "no inference program 'magic': give one of bayes_contact",
    ),
    "missing model file": (["--model", "nowhere.py"], "no model file nowhere.py"),
    "missing inference file": (["--inference", "nowhere.py"], "no inference program file nowhere.py"),
    "model file is a folder": (["--model", "./"], "no model file"),
    "inference given as model": (["--model", "tempered_smc"], "no model 'tempered_smc'"),
    "no particles": (["--particles", "0"], "'--particles': Input should be greater than or equal to 2"),
    "fewer than none": (["--particles", "-3"], "'--particles': Input should be greater than or equal to 2"),
    "negative seed": (["--seed", "-1"], "'--seed': Input should be greater than or equal to 0"),
    "endless seed": (
        ["--seed", "9" * 30],
        "'--seed': Input should be less than or equal to",
    ),
    "out is a file": (["--out", "file"], "'file' is a file"),
    "out is in a file": (["--out", "file/deep/er"], "file is a file"),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_a_bad_option_is_refused(case: str, bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    words, message = OPTIONS[case]
    (tmp_path / "file").write_text("mine")
    assert_refused(bcppl("run", SHIPPED, *words), message)
    assert [p.name for p in tmp_path.iterdir()] == ["file"] and (tmp_path / "file").read_text() == "mine"


def test_an_unknown_name_lists_the_recordings_that_ship(bcppl: Callable[..., Ran]) -> None:
    assert_refused(bcppl("run", "nothing"), "point_probe_10_pushes")


IMPORTS = {
    "missing log": (["point-probe", "nowhere.txt"], "nowhere.txt"),
    "log that is none": (["point-probe", "words.txt"], "words.txt"),
    "missing scene": (["bop", "nowhere", "--object", "5"], "scene_gt.json is missing"),
}


@pytest.mark.parametrize("case", IMPORTS)
def test_a_bad_import_writes_nothing(case: str, bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    words, message = IMPORTS[case]
    (tmp_path / "words.txt").write_text("no numbers here")
    assert_refused(bcppl("import", *words, "--out", "made.h5"), message)
    assert [p.name for p in tmp_path.iterdir()] == ["words.txt"]


@pytest.mark.skipif(
    not (DATA / "lmo_scene2_frame3").is_dir(), reason="the BOP scene is not beside the repository"
)
def test_an_unknown_object_is_refused(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    scene = DATA / "lmo_scene2_frame3"
    assert_refused(
        bcppl("import", "bop", scene, "--object", 7, "--out", "made.h5"), "no object 7; give --object one"
    )
    assert list(tmp_path.iterdir()) == []
    assert_refused(bcppl("import", "bop", scene, "--object", 5, "--translation", "nan"), "half width")
    for out, message in (("no/where.h5", "no folder no"), (".", "is a directory")):
        assert_refused(bcppl("import", "bop", scene, "--object", 5, "--out", out), message)
        assert list(tmp_path.iterdir()) == []


def test_simulate_refuses(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    assert_refused(bcppl("simulate", "nobody"), "no model 'nobody'")
    assert_refused(bcppl("simulate", "part_in_view"), "simulates no recordings")
    assert_refused(bcppl("simulate", "point_probe", "--out", "no/where.h5"), "no folder no")
    assert_refused(bcppl("simulate", "point_probe", "--out", "."), "is a directory")
    assert_refused(bcppl("simulate", "point_probe", "--seed", -1), "'--seed'")
    assert list(tmp_path.iterdir()) == []


def test_a_recording_without_a_name_takes_the_place_of_none(
    bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    assert "wrote recording.h5" in bcppl("simulate", "point_probe").out
    first = (tmp_path / "recording.h5").read_bytes()
    assert "wrote recording_2.h5" in bcppl("simulate", "point_probe", "--seed", 1).out
    assert (tmp_path / "recording.h5").read_bytes() == first
    assert not problems(load(tmp_path / "recording_2.h5"))


def test_as_a_program() -> None:
    """The entry point in a process of its own: exit code, and no traceback on either stream."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    ran = subprocess.run(
        [sys.executable, "-m", "bcppl", "check", "nowhere.h5"],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert ran.returncode == 2 and ran.stdout == ""
    assert ran.stderr == "bcppl: nowhere.h5 is not a file; give the path of a recording (.h5).\n"

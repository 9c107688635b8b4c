"""Files that are damaged, or hostile: each is read as it was, or refused in one sentence."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import random
import re
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from bcppl.cli.posterior import run_record
from bcppl.errors import InputError
from bcppl.geometry.parts import load_mesh
from bcppl.recordings import DepthImage, Measurement, View, hdf5, load, save
from bcppl.recordings.action_file import load_actions
from bcppl.recordings.importers import bop
from tests.command_line import Ran
from tests.made_recordings import assert_identical, assert_one_sentence, camera, full
from tests.recordings.damage import flipped
from tests.recordings.whole_files import MODELS, _save_plans, _scene

ROOT = Path(__file__).parents[2]


def campaign(folder: Path, count: int, seed: int) -> None:
    """Run `tests.recordings.damaged_files` in a process of its own, which may fork."""
    report = folder / "report.json"
    command = [
        sys.executable,
        "-m",
        "tests.recordings.damaged_files",
        "--count",
        str(count),
        "--seed",
        str(seed),
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, "--json", str(report)], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    bad = [line for line in report.read_text().splitlines() if not _fine(json.loads(line)["outcome"])]
    assert done.returncode == 0 and not bad, "\n".join([done.stdout, done.stderr[-2000:], *bad])


def _fine(outcome: str) -> bool:
    return outcome in ("equal", "refused", "edited")


@pytest.mark.long
def test_damaged_files_are_read_as_they_were_or_refused(tmp_path: Path) -> None:
    campaign(tmp_path, 115, 0)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(1, 5))
def test_many_damaged_files_are_read_as_they_were_or_refused(seed: int, tmp_path: Path) -> None:
    campaign(tmp_path, 1400, seed)


# ---- checksums


def refusal(read: Callable[[Path], object], path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read(path)
    text = str(caught.value)
    assert path.name in text
    assert_one_sentence(text.replace(str(path), "it"))
    return text


def test_every_byte_of_a_saved_recording_counts(tmp_path: Path) -> None:
    path = tmp_path / "saved.h5"
    save(full(), path)
    whole = path.read_bytes()
    (_, sealed) = hdf5._checksum(path)
    assert sealed
    for seed in range(200):
        path.write_bytes(flipped(whole, random.Random(seed)))
        assert not hdf5._checksum(path)[1]


def test_an_edit_by_another_program_is_noticed_and_can_be_accepted(tmp_path: Path) -> None:
    path = tmp_path / "saved.h5"
    save(full(), path)
    with h5py.File(path, "r+") as file:
        file["measurements/000001/observation/wrench"][0, 2] += 1.0
    assert "was changed after it was saved" in refusal(load, path)
    with h5py.File(path, "r+") as file:
        del file.attrs["sha256"]
    changed, original = load(path).measurements[1].observation, full().measurements[1].observation
    assert changed.wrench[0, 2] == original.wrench[0, 2] + 1.0  # type: ignore[attr-defined]


def test_a_file_without_a_checksum_is_read_elsewhere_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As are those of earlier versions, once for each content in a process."""
    read: list[Path] = []
    elsewhere = hdf5._read_elsewhere
    monkeypatch.setattr(
        hdf5, "_read_elsewhere", lambda path, *more: (read.append(path), elsewhere(path, *more))
    )
    monkeypatch.setattr(hdf5, "_read_before", set())
    save(full(), tmp_path / "sealed.h5")
    load(tmp_path / "sealed.h5")
    assert read == []
    shipped = MODELS / "recordings/peg_probe.h5"
    before = os.times()
    load(shipped)
    after = os.times()
    assert sum(after[2:4]) - sum(before[2:4]) < 0.6  # s of a core, which is 0.15 s where it has one to itself
    load(shipped)
    assert read == [shipped]


def test_a_file_that_takes_too_long_is_not_called_damaged_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hdf5, "_read_before", set())
    monkeypatch.setattr(hdf5, "WAIT", 1e-4)
    sentence = refusal(load, MODELS / "recordings/peg_probe.h5")
    assert "the machine is busy or the file is damaged; try again" in sentence


def test_a_recording_of_an_earlier_version_is_read_to_the_bit(tmp_path: Path) -> None:
    path = tmp_path / "earlier.h5"
    save(full(), path)
    with h5py.File(path, "r+") as file:
        del file.attrs["sha256"]
    assert not hdf5._checksum(path)[1]
    assert_identical(load(path), full())


@pytest.mark.long
def test_numbers_that_compress_too_well_are_written_as_they_are(tmp_path: Path) -> None:
    """Compressed, 80 MB of one depth would lie in 100 kB, which is refused as a bomb."""
    wide = dataclasses.replace(camera("wide"), width=5000, height=4200)
    recording = dataclasses.replace(
        full(), measurements=[Measurement(View(wide), DepthImage(np.full((4200, 5000), 0.5)))], background={}
    )
    path = tmp_path / "flat.h5"
    save(recording, path)
    image = load(path).measurements[0].observation
    assert isinstance(image, DepthImage) and (image.depth == 0.5).all()


LONG, SHORT = 1_000_001, 333  # characters of words


@pytest.mark.parametrize("kind", ["dataset", "attribute", "attributes"])
@pytest.mark.parametrize("sealed", [False, True])
def test_a_word_that_many_refer_to_is_counted_each_time(kind: str, sealed: bool, tmp_path: Path) -> None:
    """A file of a megabyte, with a right checksum too, would take hundreds."""
    path = tmp_path / "actions.h5"
    _save_plans(path)
    path.write_bytes(path.read_bytes()[: -hdf5.LENGTH])
    words, text = ["x" * LONG, *200 * [SHORT * "y"]], h5py.string_dtype()
    with h5py.File(path, "r+") as file:
        if kind == "dataset":
            del file["actions/000000/manners"]
            file["actions/000000"].create_dataset("manners", data=words, dtype=text)
        elif kind == "attribute":
            file.attrs.create("words", words, dtype=text)
        else:
            for k, word in enumerate(words):
                file.attrs.create(f"word {k}", word, dtype=text)
    content = bytearray(path.read_bytes())
    # A reference is the word's length, an address, which is not zero, and a number.
    (long,), short = (
        [match.start() for match in re.finditer(struct.pack("<I", length) + rb"(?!\0{4})", content)]
        for length in (LONG, SHORT)
    )
    assert len(short) == 200
    for place in short:
        content[place : place + 16] = content[long : long + 16]
    seal = hdf5.MARK + hashlib.sha256(content).hexdigest().encode() + b"\n"
    path.write_bytes(content + (seal if sealed else b""))
    assert len(content) < 1.2 * LONG
    assert re.search("claims? more (numbers )?than a file of", refusal(load_actions, path))


# ---- what is refused, by name


def edited(tmp_path: Path, edit: Callable[[h5py.File], object]) -> str:
    path = tmp_path / "edited.h5"
    save(full(), path)
    with h5py.File(path, "r+") as file:
        edit(file)
    return refusal(load, path)


@pytest.mark.parametrize(
    ("name", "units", "said"),
    [
        ("part/vertices", "mm", "vertices is in 'mm'; give a dataset in 'm'"),
        ("measurements/000001/observation/wrench", "kN", "wrench is in 'kN'"),
        ("guess/yaw", "deg", "yaw is in 'deg'; give a dataset in 'rad'"),
    ],
)
def test_other_units_are_refused_by_name(tmp_path: Path, name: str, units: str, said: str) -> None:
    assert said in edited(tmp_path, lambda file: file[name].attrs.__setitem__("units", units))
    assert "states no units" in edited(tmp_path, lambda file: file[name].attrs.__delitem__("units"))


def test_what_a_recording_does_not_hold_is_named(tmp_path: Path) -> None:
    assert "'truht'" in edited(tmp_path, lambda file: file.move("truth", "truht"))
    assert "'angel'" in edited(tmp_path, lambda file: file.move("guess/angle", "guess/angel"))
    assert "'000003'" in edited(tmp_path, lambda file: file.__delitem__("measurements/000003"))
    loop = edited(tmp_path, lambda file: file["part"].__setitem__("again", file["/"]))
    assert "linked twice" in loop
    other = edited(tmp_path, lambda file: file.__setitem__("peg2", h5py.ExternalLink("x.h5", "/")))
    assert "link to another place" in other
    text: Any = {"data": ["a"], "dtype": h5py.string_dtype(), "chunks": (1,)}
    chunks = edited(tmp_path, lambda file: file.create_dataset("part/words", **text))
    assert "is text in chunks; write it without them" in chunks


def test_a_mesh_is_one_file_of_a_known_format(tmp_path: Path) -> None:
    (tmp_path / "part.zip").write_bytes(b"PK")
    assert "none of" in refusal(load_mesh, tmp_path / "part.zip")
    (tmp_path / "part.ply").write_text("ply\nformat ascii 1.0\nelement vertex 900000000\nend_header\n")
    assert "claims 900000000" in refusal(load_mesh, tmp_path / "part.ply")


# ---- JSON

odd = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
@pytest.mark.parametrize("name", ["actions.json", "run.json", "camera.json", "scene_gt.json"])
def test_any_value_anywhere_in_json_is_read_or_refused(
    name: str, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("json")
    readers: dict[str, Callable[[Path], Any]] = {
        "actions.json": load_actions,
        "run.json": run_record,
        "camera.json": lambda path: bop.command(path.parent, 1),
        "scene_gt.json": lambda path: bop.command(path.parent, 1),
    }
    path = folder / name
    if name == "actions.json":
        _save_plans(path)
    elif name == "run.json":
        path.write_text(json.dumps({"recording": "peg_probe", "model": "m", "settings": {"a": 1}}))
    else:
        path = folder / "scene" / name
        _scene(path.parent)
    tree = json.loads(path.read_text())
    node: Any = tree
    while True:
        key = data.draw(st.sampled_from(list(node) if isinstance(node, dict) else range(len(node))))
        if not (isinstance(node[key], dict | list) and node[key] and data.draw(st.booleans())):
            break
        node = node[key]
    node[key] = data.draw(odd)
    path.write_text(json.dumps(tree))
    try:
        readers[name](path)
    except InputError as error:
        assert "\n" not in str(error) and str(error).endswith(".")


# ---- text, and disks


def test_text_of_a_file_cannot_steer_a_terminal(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    part = dataclasses.replace(full().part, name="\x1b[2J[bold]x[/bold]")
    save(dataclasses.replace(full(), part=part, model="\x1b]0;a\x07", source="[/red]"), tmp_path / "a.h5")
    ran = bcppl("check", "a.h5")
    assert "\x1b" not in ran.out + ran.err and "\x07" not in ran.out + ran.err
    assert r"\x1b[2J[bold]x[/bold]" in ran.out and "[/red]" in ran.out


def test_check_notes_a_file_without_a_checksum(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(full(), tmp_path / "a.h5")
    assert "checksum" not in bcppl("check", "a.h5").out
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file.attrs["sha256"]
    ran = bcppl("check", "a.h5")
    assert ran.code == 0 and "note: the file has no checksum" in " ".join(ran.out.split())


FULL = """
import resource, signal, sys
from pathlib import Path
from bcppl.errors import InputError
from bcppl.recordings import save
from bcppl.recordings.action_file import save_actions
from tests.made_recordings import full
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
folder = Path(sys.argv[1])
writers = {"a.h5": lambda path: save(full(), path), "plan.json": lambda path: save_actions([], path)}
for name, write in writers.items():
    write(folder / name)
for size in (0, 50):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    for name, write in writers.items():
        for path in (folder / name, folder / f"new_{name}"):
            try:
                write(path)
            except InputError as error:
                print(error)
"""


@pytest.mark.long
def test_a_full_disk_is_a_sentence_and_leaves_what_was_there(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path)], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    lines = done.stdout.splitlines()
    assert len(lines) == 8 and all("cannot be written" in line and line.endswith(".") for line in lines)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.h5", "plan.json"]
    assert_identical(load(tmp_path / "a.h5"), full())


def test_reading_a_large_claim_takes_no_time(tmp_path: Path) -> None:
    path = tmp_path / "edited.h5"
    save(full(), path)
    with h5py.File(path, "r+") as file:
        del file["part/vertices"]
        file.create_dataset("part/vertices", shape=(2**40, 3), dtype="f8", chunks=(2**16, 3))
    start = time.process_time()
    assert "claims more numbers" in refusal(load, path)
    assert time.process_time() - start < 1.0

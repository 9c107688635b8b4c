"""Files of a bench that are not what they seem: images of colours or windows, tables with commas, holes."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from bcppl.cli import app
from bcppl.errors import InputError
from bcppl.geometry.parts import load_mesh
from bcppl.recordings.importers.bench import log
from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields
from bcppl.recordings.importers.bench.contacts import STEP, Contact
from bcppl.recordings.importers.bench.depth_images import read_depth
from bcppl.recordings.importers.bench.resting import log_evidence
from bcppl.recordings.importers.bench.table import read_columns
from bcppl.recordings.streams import Stream

DOWN = np.array([0.0, 0.0, 1.0])
CAMERA = CameraFields.model_validate(
    {"fx": 160.0, "fy": 160.0, "cx": 79.5, "cy": 59.5, "near": 0.1, "far": 2.0, "unit": "mm",
     "world_from_camera": {}, "images": [{"file": "x"}]}
)  # fmt: skip


@pytest.mark.parametrize(("colour", "channels", "words"), [(2, 3, "red, green and blue"), (4, 2, "alpha")])
def test_a_png_of_several_channels_is_named_as_such(
    colour: int, channels: int, words: str, tmp_path: Path
) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    raw = b"".join(b"\0" + np.full((160, channels), 500, ">u2").tobytes() for _ in range(120))
    header = struct.pack(">IIBBBBB", 160, 120, 16, colour, 0, 0, 0)
    chunks = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(raw)), chunk(b"IEND", b""))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    with pytest.raises(
        InputError, match=rf"a PNG of 16 bits with .*{words}; export its depth as one channel"
    ):
        read_depth(tmp_path / "a.png", CAMERA)


def test_a_window_of_an_exr_image_is_refused(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR", reason="pip install 'bcppl[bench]'")
    window = (np.array([0, 20], np.int32), np.array([159, 109], np.int32))
    whole = (np.array([0, 0], np.int32), np.array([159, 119], np.int32))
    for data, height in ((whole, 120), (window, 90)):
        header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        windows = {"dataWindow": data, "displayWindow": whole}
        with exr.File({**header, **windows}, {"Z": np.full((height, 160), 500.0, np.float32)}) as file:
            file.write(str(tmp_path / f"{height}.exr"))
    assert read_depth(tmp_path / "120.exr", CAMERA).shape == (120, 160)
    with pytest.raises(InputError, match=r"pixels from \[0, 20\] to \[159, 109\] of an image from"):
        read_depth(tmp_path / "90.exr", CAMERA)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t;x\n0,5;1,5\n0,6;2\n", "write decimal points, not commas"),
        ("t,x\n0,5,1,5\n0,6,2,0\n", "has 2 fields in its first line and 4 in its first row"),
        ("t,x\n2025-01-09T13:59:54,1\n2025-01-09T13:59:55,1\n", "write times as numbers"),
        ("t,x\ns,N\n0.5,1\n0.6,2\n", "take out the line below the names, if it holds units"),
        ("t,x\n0.5,\n0.6,2\n", "write nan where nothing was measured"),
        ("t,x\n0.5,1\n0.6,2\n0.7", "line 3 of the numbers ends after 1, as where a log is cut off"),
    ],
)
def test_what_is_no_number_is_named_by_its_shape(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_columns(tmp_path / "log.csv", ["t", "x"])


@pytest.mark.parametrize("text", ["t,x\n0.5,1,\n0.6,2,\n", "t,x,\n0.5,1\n0.6,2\n", "t,x,y\n0.5,1,\n0.6,2,\n"])
def test_a_delimiter_may_end_a_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(text)
    np.testing.assert_array_equal(read_columns(tmp_path / "log.csv", ["t", "x"]), [[0.5, 1.0], [0.6, 2.0]])


def test_a_clock_that_is_set_forward_is_refused() -> None:
    times = np.arange(1000) / 100.0
    times[200:] += 1.7e9
    with pytest.raises(
        InputError, match=r"pose has no row for 1\.7e\+09 s, after 200 rows; cut the log there"
    ):
        log._refuse_holes(Stream("pose", times, np.zeros((1000, 7))))


def test_a_gap_after_the_first_row_is_not_the_interval_of_poses() -> None:
    times = np.append(-5.0, np.arange(0.0, 2.0, 0.002))
    after = STEP * np.arange(200)
    felt = Contact(1.0, DOWN, 1.0 + after, 1e3 * np.minimum(after, 0.02))
    path = np.zeros((len(times), 3))
    path[:, 2] = 0.05 * np.minimum(times, 1.0)
    streams = Stream("position", times[1:], path[1:]), Stream("position", times, path)
    evidence = [log_evidence([felt], each, 2e-5, np.array([0.0])) for each in streams]
    np.testing.assert_allclose(*evidence)


def test_a_truncated_mesh_is_called_damaged(tmp_path: Path) -> None:
    whole = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="stl")
    (tmp_path / "box.stl").write_bytes(whole[:300])
    with pytest.raises(InputError, match=r"box\.stl cannot be read .*; export it again") as failure:
        load_mesh(tmp_path / "box.stl")
    assert "No module" not in str(failure.value)


def test_a_recording_is_not_written_over_what_is_none(tmp_path: Path) -> None:
    (tmp_path / "wrench.csv").write_text("t,fx\n0,1\n")
    out = str(tmp_path / "wrench.csv")
    done = CliRunner().invoke(app, ["import", "bench", str(tmp_path / "bench.yaml"), "-o", out])
    assert isinstance(done.exception, InputError) and "which is no recording" in str(done.exception)
    assert (tmp_path / "wrench.csv").read_text() == "t,fx\n0,1\n"

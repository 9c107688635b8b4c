"""Every mistake in a bench's configuration, and in the files that it names, is one sentence."""

from __future__ import annotations

import io
import struct
import sys
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import EpsImagePlugin, Image

from bcppl.errors import InputError
from bcppl.recordings.importers.bench.configuration.fields import BenchFields
from bcppl.recordings.importers.bench.configuration.reading import read_configuration
from bcppl.recordings.importers.bench.depth_images import read_depth
from bcppl.recordings.importers.bench.pose_columns import stated_pose
from bcppl.recordings.importers.bench.table import read_columns
from tests.made_recordings import assert_one_sentence

TEMPLATE = (
    Path(__file__).parents[3] / "bcppl/recordings/importers/bench/configuration/template.yaml"
).read_text(encoding="utf-8")  # fmt: skip


def changed(*place: Any, value: Any = None, of: str = TEMPLATE) -> str:
    """A text with another value at a place; without one, the field is left out."""
    content: Any = yaml.safe_load(of)
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    if value is None:
        del inner[place[-1]]
    else:
        inner[place[-1]] = value
    return yaml.safe_dump(content)


WRONG = {
    "lacks 'file'": changed("wrench", "file"),
    r"wrench has no field 'fil'; write 'file' if": changed("wrench", "fil", value="a.csv"),
    r"wrench.axes is 'senor'; give 'sensor', 'frame' or 'base'": changed("wrench", "axes", value="senor"),
    "wrench.columns has 5 entries; give at least 6": changed("wrench", "columns", value=list("abcde")),
    "wrench.columns is 3; give a list": changed("wrench", "columns", value=3),
    "wrench is 'w.csv'; give fields of its own": changed("wrench", value="w.csv"),
    "pose has 7 columns for the rotation 'matrix'; give 12 or 16": changed(
        "pose", "rotation", value="matrix"
    ),
    "guess.tilt is -1; give a number of at least 0": changed("guess", "tilt", value=-1),
    "guess.tilt is '1e-3', which YAML reads as text; write 0.001": changed("guess", "tilt", value="1e-3"),
    "guess.tilt is 'ten'; give a number": changed("guess", "tilt", value="ten"),
    "guess.tilt is inf; give a finite number": changed("guess", "tilt", value=float("inf")),
    "frame_from_peg has its rotation as xyzw and as vector": changed(
        "frame_from_peg", "xyzw", value=[0, 0, 0, 1]
    ),
    "the configuration needs either pose .* or joints": changed("pose"),
    "the configuration lacks frame_from_sensor": changed("frame_from_sensor"),
    "the configuration lacks peg, which is held": changed("peg"),
    "the configuration lacks frame_from_peg, where": changed("frame_from_peg"),
    r"needs either pose \(of a frame": changed("pose", of=changed("wrench")),  # its camera is on the arm
    "lacks both wrench .* and cameras": changed("cameras", of=changed("wrench")),
    r"cameras.wrist needs either unit .* or scale": changed("cameras", "wrist", "unit"),
    r"cameras.wrist is on the arm: give its image view_0.png": changed(
        "cameras", "wrist", "images", 0, "time"
    ),
    "clock states a drift but not wrench_late": changed("clock", value={"drift": 20.0}),
    "clock has both wrench_late and within": changed(
        "clock", value={"wrench_late": 8, "unit": "ms", "within": 10}
    ),
    "clock has wrench_late without its unit": changed("clock", value={"wrench_late": 8}),
    "cut has both find and spans": changed("cut", value={"find": "touches", "spans": [[0.5, 2.0]]}),
    "cut has no span in spans": changed("cut", value={"spans": []}),
    "wrench names the column 'x' twice": changed("wrench", "columns", value=list("axxyzw")),
    "gravity needs mass": changed("gravity", value={"load": "stated"}),
    "part needs one of mesh": changed("part", "mesh"),
    "holds no fields": "just text",
    "is no valid YAML": "a: [1, 2",
    "the field 'a' stands there twice": "a: 1\na: 2\n",
    "could not determine a constructor": "a: !!python/object/apply:os.system ['false']\n",
    "the alias 'a' has to be written out in line 2": "a: &a [x, x]\nb: &b [*a, *a]\nsource: [*b, *b]\n",
    "'2025-31-01' is no timestamp, and text needs quotes, in line 2": "model: m\nsource: 2025-31-01\n",
    "'foo' is no int, .* in line 1": "source: !!int foo\n",
    "'foo' is no bool": "source: !!bool foo\n",
    "'foo' is no timestamp": "source: !!timestamp foo\n",
    r"'9+... \(5002 characters\) is no int": f"source: {'9' * 5000}\n",
    r"'1:1:[:1]+... \(603 characters\) is no float": f"source: {'1:' * 299}1.0\n",
    r"wrench.columns is 'x+... \(50002 characters\); give a list": changed(
        "wrench", "columns", value=50000 * "x"
    ),
    r"wrench.axes is \['x', .* characters\); give 'sensor'": changed("wrench", "axes", value=["x"] * 999),
    "has no field 'x+…'; its fields": changed("x" * 5000, value=1),
    "could not determine a constructor for the tag .*x+… in line 1": f"a: !!python/{5000 * 'x'} 1\n",
    r"cameras.a b.x1b is 3": changed("cameras", "a\nb\x1b", value=3),
}


@pytest.mark.parametrize("words", [words for words, text in WRONG.items() if text is not None])
def test_each_mistake_is_one_sentence(words: str, tmp_path: Path) -> None:
    path = tmp_path / "bench.yaml"
    text = WRONG[words]
    assert text is not None
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=words) as failure:
        read_configuration(path)
    assert_one_sentence(str(failure.value).replace("... (", " ("))
    assert "bench.yaml" in str(failure.value) and len(str(failure.value)) < 400


def test_the_template_is_a_configuration(tmp_path: Path) -> None:
    path = tmp_path / "bench.yaml"
    path.write_text(TEMPLATE, encoding="utf-8")
    fields = read_configuration(path)
    assert fields.wrench.sign == "on_peg" and fields.cut.window == 0.5 and fields.clock.wrench_late is None
    with pytest.raises(InputError, match="there is no configuration"):
        read_configuration(tmp_path / "none.yaml")


def test_poses_are_read_as_they_are_stated(tmp_path: Path) -> None:
    path = tmp_path / "bench.yaml"
    half = float(np.sqrt(0.5))
    expected = [0.1, 0.2, 0.3, half, 0.0, 0.0, half]  # a quarter turn about z
    for rotation in (
        {"xyz": [100, 200, 300], "length": "mm", "xyzw": [0, 0, half, half]},
        {"xyz": [10, 20, 30], "length": "cm", "wxyz": [half, 0, 0, half]},
        {"xyz": [0.1, 0.2, 0.3], "vector": [0, 0, 90], "angle": "deg"},
        {"matrix": [0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3]},
        {"matrix": [0, -1, 0, 100, 1, 0, 0, 200, 0, 0, 1, 300, 0, 0, 0, 1], "length": "mm"},
    ):
        path.write_text(changed("frame_from_peg", value=rotation), encoding="utf-8")
        pose = stated_pose("frame_from_peg", read_configuration(path).frame_from_peg)
        np.testing.assert_allclose(pose, expected, atol=1e-7)
    path.write_text(changed("frame_from_peg", value={"xyzw": [0, 0, 1, 1]}), encoding="utf-8")
    with pytest.raises(InputError, match=r"frame_from_peg has a quaternion of length 1\.414"):
        stated_pose("frame_from_peg", read_configuration(path).frame_from_peg)


# ---- tables

ROWS = np.arange(12.0).reshape(4, 3)


def test_columns_are_the_same_from_every_kind_of_file(tmp_path: Path) -> None:
    def check(name: str, names: list[str | int]) -> None:
        np.testing.assert_array_equal(read_columns(tmp_path / name, names), ROWS[:, [2, 0]])

    (tmp_path / "a.csv").write_text("t,x,frame,y\n" + "".join(f"{a},{b},tool,{c}\n" for a, b, c in ROWS))
    check("a.csv", ["y", "t"])
    np.savetxt(tmp_path / "b.csv", ROWS, delimiter=";", header="t;x;y")  # "# t;x;y"
    check("b.csv", ["y", "t"])
    np.savetxt(tmp_path / "c.txt", ROWS)
    check("c.txt", [2, 0])
    np.save(tmp_path / "d.npy", ROWS)
    check("d.npy", [2, 0])
    structured = np.array([tuple(row) for row in ROWS], dtype=[(n, "f8") for n in "txy"])
    np.save(tmp_path / "e.npy", structured)
    check("e.npy", ["y", "t"])
    np.savez(tmp_path / "f.npz", t=ROWS[:, 0], w=ROWS[:, 1:])
    check("f.npz", ["w[1]", "t"])


def test_parquet_files_are_read_where_pyarrow_is_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.parquet"
    path.write_bytes(b"")
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pyarrow", None)
        with pytest.raises(InputError, match=r"needs pyarrow: pip install 'bcppl\[bench\]'"):
            read_columns(path, ["t"])
    arrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    parquet.write_table(arrow.table({n: ROWS[:, k] for k, n in enumerate("txy")}), path)
    np.testing.assert_array_equal(read_columns(path, ["y", "t"]), ROWS[:, [2, 0]])
    with pytest.raises(InputError, match="has no column 'z'"):
        read_columns(path, ["z"])


@pytest.mark.parametrize(
    ("name", "content", "columns", "words"),
    [
        ("a.csv", "t,fx\n0,1\n1,2\n", ["t", "fy"], "no column 'fy'; its columns are t, fx"),
        ("a.csv", "t,fx\n0,1\n1,\n", ["t", "fx"], "holds what is no number .*; write nan"),
        ("a.csv", "t,fx\n0,one\n1,2\n", ["t", "fx"], "holds what is no number .*'one'"),
        ("a.csv", "0,1\n1,2\n", ["t"], "has no names of columns; give 't' as its number"),
        ("a.csv", "0,1\n1,2\n", [5], "has 2 columns, and none of the number 5"),
        ("a.csv", "t,t\n0,1\n1,2\n", ["t"], "has the column 't' twice"),
        ("a.csv", "t\n0\n", ["t"], "holds 1 rows"),
        ("a.xlsx", "", ["t"], r"ends in '\.xlsx'"),
        ("a.npy", "no array", ["t"], "holds no plain numbers"),
        ("a.npz", "no array", ["t"], "holds no plain numbers"),
        ("a.csv", f"t,{200000 * 'x'}\n0,1\n1,2\n", ["t"], "is no table .field larger than .*; export it"),
    ],
)
def test_a_wrong_table_is_refused(
    name: str, content: str, columns: list[Any], words: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=words) as failure:
        read_columns(tmp_path / name, columns)
    assert_one_sentence(str(failure.value))


def test_pickled_objects_are_not_read(tmp_path: Path) -> None:
    objects = np.array([{"a": 1}, None], dtype=object)
    np.save(tmp_path / "a.npy", objects, allow_pickle=True)
    np.savez(tmp_path / "a.npz", a=objects)
    for name in ("a.npy", "a.npz"):
        with pytest.raises(InputError, match=r"holds no plain numbers \(.*bject.*\); save it again"):
            read_columns(tmp_path / name, ["a"])


def claimed(count: int) -> bytes:
    """The header of an .npy file of so many rows of one number."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (count, 1)})
    return file.getvalue()


def zipped(path: Path, *members: bytes, **options: Any) -> None:
    with zipfile.ZipFile(path, "w", **options) as file:
        for member in members:
            file.writestr("a.npy", member)


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    "kind", ["claim", "claim in a zip", "bomb", "twice", "cut off", "changed", "renamed"]
)
def test_a_damaged_file_of_arrays_is_refused(kind: str, tmp_path: Path) -> None:
    path, whole, words = tmp_path / "a.npz", claimed(4) + ROWS[:, 0].tobytes(), "holds no plain numbers"
    zipped(path, whole)
    if kind == "claim":
        path = tmp_path / "a.npy"
        path.write_bytes(claimed(10**13) + bytes(99))
        words = "mmap length is greater than file size"  # and no memory is asked for
    elif kind == "claim in a zip":
        zipped(path, claimed(10**13) + bytes(99))
    elif kind == "bomb":
        zipped(path, claimed(9 << 20) + bytes(72 << 20), compression=zipfile.ZIP_DEFLATED, compresslevel=1)
        words = "claims more numbers than its size explains"
    elif kind == "twice":
        zipped(path, whole, whole)
        words = "a name is given twice"
    elif kind == "cut off":
        path.write_bytes(path.read_bytes()[:-30])
    elif kind == "changed":
        content = bytearray(path.read_bytes())
        content[content.index(ROWS[3:, 0].tobytes())] ^= 1
        path.write_bytes(content)
        words = "Bad CRC-32"
    else:
        path = path.rename(tmp_path / "a.npy")
    with pytest.raises(InputError, match=words) as failure:
        read_columns(path, ["a[0]"])
    assert_one_sentence(str(failure.value).replace(str(path), "it"))
    if path.suffix == ".npy":
        with pytest.raises(InputError, match=r"holds no plain numbers \(.*\); save it again"):
            read_depth(path, CAMERA)


# ---- images

CAMERA = BenchFields.model_validate(yaml.safe_load(TEMPLATE)).cameras["wrist"]


def png(width: int, height: int) -> bytes:
    """A PNG of 16 bits whose pixels are missing."""

    def chunk(name: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(name + content))
        return struct.pack(">I", len(content)) + name + content + check

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def test_a_depth_image_is_read_by_its_own_formats_reader_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Data never runs code: Pillow gives PostScript to Ghostscript."""
    ran: list[Any] = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *given, **more: ran.append(given))
    files = {
        "cannot identify": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 2 2\n%%EndComments\n",
        "exceeds limit of": png(40000, 40000),
        "claims 4000 x 4000 pixels in 65 bytes": png(4000, 4000),
        "truncated": png(2, 2),
    }
    for words, content in files.items():
        (tmp_path / "view_0.png").write_bytes(content)
        with pytest.raises(InputError, match=rf"is no image \(.*{words}.*\); export the depth") as failure:
            read_depth(tmp_path / "view_0.png", CAMERA)
        assert_one_sentence(str(failure.value).replace(str(tmp_path), ""))
    assert not ran


@pytest.mark.parametrize(
    ("name", "kind"), [("a.png", "u2"), ("a.tif", "u2"), ("a.tiff", "i4"), ("a.TIF", "f4"), ("a.tif", ">u2")]
)
def test_depth_images_of_integers_and_floats(name: str, kind: str, tmp_path: Path) -> None:
    Image.fromarray(np.full((2, 3), 700, kind)).save(tmp_path / name)
    np.testing.assert_allclose(read_depth(tmp_path / name, CAMERA), np.full((2, 3), 0.7), atol=1e-7)


def test_a_depth_image_of_8_bits_is_refused(tmp_path: Path) -> None:
    for shape in ((2, 3), (2, 3, 3)):
        Image.fromarray(np.full(shape, 70, np.uint8)).save(tmp_path / "a.png")
        with pytest.raises(InputError, match="8 bits"):
            read_depth(tmp_path / "a.png", CAMERA)


def test_depth_images_of_other_kinds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bench.yaml"
    path.write_text(changed("cameras", "wrist", "unit", value="m"), encoding="utf-8")
    fields = read_configuration(path).cameras["wrist"]
    depth = np.array([[0.5, 0.0], [np.nan, 0.75]])
    np.save(tmp_path / "a.npy", depth)
    np.testing.assert_array_equal(read_depth(tmp_path / "a.npy", fields), [[0.5, np.nan], [np.nan, 0.75]])
    np.save(tmp_path / "b.npy", 1000.0 * depth)
    with pytest.raises(InputError, match=r"median depth of 625 m.* state the unit"):
        read_depth(tmp_path / "b.npy", fields)
    (tmp_path / "c.exr").write_bytes(b"")
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "OpenEXR", None)
        with pytest.raises(InputError, match="needs OpenEXR"):
            read_depth(tmp_path / "c.exr", fields)
    exr = pytest.importorskip("OpenEXR")
    channels = {"Z": depth.astype(np.float32)}
    exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, channels).write(
        str(tmp_path / "d.exr")
    )
    np.testing.assert_array_equal(read_depth(tmp_path / "d.exr", fields), [[0.5, np.nan], [np.nan, 0.75]])

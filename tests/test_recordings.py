"""Recordings on disk: what comes back is what went in, and what is wrong is said in one sentence."""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from bcppl.errors import InputError
from bcppl.parts import Part, Piece
from bcppl.recordings import (
    DepthImage,
    Guess,
    Measurement,
    Probe,
    ProbeWindow,
    Push,
    Recording,
    Touch,
    View,
    describe,
    load,
    notes,
    problems,
    save,
    validate,
)
from bcppl.simulators.camera import Camera

HALF = math.sqrt(0.5)


def block(name: str, side: float = 0.1) -> Part:
    mesh = trimesh.creation.box((side, 0.8 * side, 0.3 * side))
    pieces = (
        Piece("box", np.array([0.05, 0.04, 0.015])),
        Piece("hull", np.asarray(mesh.vertices), np.ones(3)),
    )
    return Part(name, np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64), pieces, "made here")


def poses(rows: int, rng: np.random.Generator) -> Any:
    quaternion = rng.normal(size=(rows, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return np.concatenate([rng.normal(scale=0.1, size=(rows, 3)), quaternion], axis=1)


def camera(name: str, height: float = 0.5) -> Camera:
    return Camera(name, 8, 6, 9.0, 9.5, 3.7, 2.4, np.array([0.0, 0, height, 0, 1, 0, 0]), 0.06, 4.0)


def depth(rng: np.random.Generator) -> Any:
    image = rng.uniform(0.3, 0.6, (6, 8)).astype(np.float32).astype(np.float64)
    image[1, 2] = np.nan
    return image


def probe(name: str, rng: np.random.Generator) -> Probe:
    return Probe(
        name,
        np.linspace(0, 1, 5),
        poses(5, rng),
        rng.uniform(1, 9, 6),
        rng.uniform(1, 9, 6),
        np.arange(20) * 0.05,
    )


def touch(times: Any, rng: np.random.Generator, held: bool = True) -> Touch:
    return Touch(times, rng.normal(size=(len(times), 6)), poses(len(times) if held else 0, rng))


def full(seed: int = 0) -> Recording:
    """A recording with something of everything."""
    rng = np.random.default_rng(seed)
    left, right = camera("left"), camera("wrist/right.2", 0.6)
    slide, press = probe("slide", rng), probe("press", rng)
    times = np.cumsum(rng.uniform(0.01, 0.02, 400))
    windows = [
        Measurement(ProbeWindow(p, a, b), touch(p.stamps[a:b], rng))
        for p, a, b in ((slide, 0, 7), (press, 0, 9), (slide, 7, 20))
    ]
    colour = rng.integers(0, 255, (6, 8, 3)).astype(np.uint8)
    views = [
        Measurement(View(c), DepthImage(depth(rng), rgb))
        for c, rgb in ((left, colour), (right, None), (left, None))
    ]
    push = Measurement(Push(times[::3], poses(len(times[::3]), rng)), touch(times, rng, held=False))
    return Recording(
        part=block("block"),
        guess=Guess(np.array([0.01, 0.02, 0, HALF, 0, 0, HALF]), np.array([0.02, 0.01, 0.0]), 0.1, 0.3, 0.2),
        measurements=[views[0], windows[0], views[1], push, windows[1], windows[2], views[2]],
        peg=block("peg", 0.02),
        background={"left": depth(rng)},
        truth=np.array([0.012, 0.018, 0, HALF, 0, 0, HALF]),
        model="peg_in_hole",
        source="nowhere, ©",
    )


def assert_identical(first: Any, second: Any, where: str = "recording") -> None:
    """Equal to the last bit, all the way down."""
    if dataclasses.is_dataclass(first):
        assert type(first) is type(second), where
        for field in dataclasses.fields(first):
            assert_identical(getattr(first, field.name), getattr(second, field.name), f"{where}.{field.name}")
    elif isinstance(first, np.ndarray):
        assert first.dtype == second.dtype and first.shape == second.shape, where
        assert first.tobytes() == second.tobytes(), where
    elif isinstance(first, Mapping):
        assert first.keys() == second.keys(), where
        for key in first:
            assert_identical(first[key], second[key], f"{where}[{key!r}]")
    elif isinstance(first, Sequence) and not isinstance(first, str):
        assert len(first) == len(second), where
        for k, (ours, theirs) in enumerate(zip(first, second, strict=True)):
            assert_identical(ours, theirs, f"{where}[{k}]")
    else:
        assert first == second and type(first) is type(second), where


def assert_one_sentence(text: str) -> None:
    assert "\n" not in text and text.endswith(".") and ". " not in text.rstrip("."), text


def test_everything_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    recording = full()
    assert problems(recording) == []
    save(recording, tmp_path / "a.h5")
    loaded = load(tmp_path / "a.h5")
    assert_identical(recording, loaded)
    windows = [m.action for m in loaded.measurements if isinstance(m.action, ProbeWindow)]
    assert windows[0].probe is windows[2].probe is not windows[1].probe
    assert [m.kind for m in loaded.measurements] == [
        "view",
        "window",
        "view",
        "push",
        "window",
        "window",
        "view",
    ]


def test_a_camera_keeps_its_lens_and_its_wrist(tmp_path: Path) -> None:
    """What version 1 did not know makes the file one of version 2; without it, it stays one of version 1."""
    hand = dataclasses.replace(
        camera("hand"),
        distortion=(0.01, -0.02, 0.001, 0.0, 0.003),
        wrist_from_camera=np.array([0.05, 0, 0.07, 1, 0, 0, 0]),
    )
    places = [np.array([0.0, 0, z, 0, 1, 0, 0]) for z in (0.5, 0.6)]
    views = [hand.on(place, name=f"hand {k}") for k, place in enumerate(places)]
    recording = dataclasses.replace(
        full(), measurements=[Measurement(View(c), DepthImage(np.ones((6, 8)))) for c in views]
    )
    for made, version in ((recording, 2), (full(), 1)):
        save(made, tmp_path / "lens.h5")
        with h5py.File(tmp_path / "lens.h5") as file:
            assert file.attrs["schema_version"] == version
        assert_identical(load(tmp_path / "lens.h5"), made)
    assert {view.instrument for view in views} == {"hand"}


def test_saving_again_gives_the_same_bytes(tmp_path: Path) -> None:
    save(full(), tmp_path / "a.h5")
    save(load(tmp_path / "a.h5"), tmp_path / "b.h5")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_units_and_frames_are_in_the_file(tmp_path: Path) -> None:
    save(full(), tmp_path / "a.h5")
    without: list[str] = []
    with h5py.File(tmp_path / "a.h5") as file:
        file.visititems(
            lambda name, node: (
                without.append(name) if isinstance(node, h5py.Dataset) and "units" not in node.attrs else None
            )
        )
        assert file["measurements/000001/observation/world_from_peg"].attrs["units"] == "m m m 1 1 1 1"
        assert file["measurements/000000/observation/depth"].dtype == np.float32
    assert without == []


printable = st.text(st.characters(exclude_categories=("Cs", "Cc")), min_size=1, max_size=8)


@settings(max_examples=25, deadline=None)
@given(
    name=st.one_of(st.sampled_from([".", "..", "a/b", "/", "%2F", "../x"]), printable),
    image=arrays.arrays(np.float32, (6, 8), elements=st.floats(width=32, allow_infinity=False)),
    wrench=arrays.arrays(np.float64, (3, 6), elements=st.floats(allow_nan=False)),
)
def test_any_name_any_depth_any_wrench(
    tmp_path_factory: pytest.TempPathFactory, name: str, image: Any, wrench: Any
) -> None:
    path = tmp_path_factory.mktemp("any") / "a.h5"
    times = np.array([0.0, 0.1, 0.2])
    recording = dataclasses.replace(
        full(),
        background={name: image.astype(np.float64)},
        measurements=[
            Measurement(View(camera(name)), DepthImage(image.astype(np.float64))),
            Measurement(
                Push(times, poses(3, np.random.default_rng(0))), Touch(times, wrench, np.zeros((0, 7)))
            ),
        ],
    )
    save(recording, path)
    loaded = load(path)
    np.testing.assert_array_equal(loaded.background[name], image)
    assert isinstance(loaded.measurements[0].action, View)
    assert loaded.measurements[0].action.camera.name == name
    assert_identical(recording.measurements[1], loaded.measurements[1])


def test_depth_is_rounded_to_float32_and_no_further(tmp_path: Path) -> None:
    image = np.random.default_rng(0).uniform(0.2, 4, (6, 8))
    recording = dataclasses.replace(full(), background={"left": image})
    save(recording, tmp_path / "a.h5")
    np.testing.assert_array_equal(load(tmp_path / "a.h5").background["left"], image.astype(np.float32))


# ---- files that cannot be written or read


def test_a_failed_save_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    measurements = list(full().measurements)
    unwritable: Any = np.full((6, 8), object())
    measurements[-1] = Measurement(View(camera("left")), DepthImage(unwritable))
    for bad in (
        dataclasses.replace(full(), measurements=measurements),
        dataclasses.replace(
            full(),
            measurements=[Measurement(View(camera("left", h)), DepthImage(np.ones((6, 8)))) for h in (1, 2)],
        ),
    ):
        with pytest.raises(InputError) as failure:
            save(bad, path)
        assert_one_sentence(str(failure.value))
        assert list(tmp_path.iterdir()) == []
    save(full(), path)
    before = path.read_bytes()
    with pytest.raises(InputError):
        save(dataclasses.replace(full(), measurements=measurements), path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"] and path.read_bytes() == before
    with pytest.raises(InputError, match="no folder"):
        save(full(), tmp_path / "missing" / "a.h5")


def test_a_truncated_file_is_refused_at_any_length(tmp_path: Path) -> None:
    save(full(), tmp_path / "a.h5")
    whole = (tmp_path / "a.h5").read_bytes()
    cut = tmp_path / "cut.h5"
    for length in (0, 4, 100, 2000, len(whole) // 4, len(whole) // 2, int(0.9 * len(whole)), len(whole) - 1):
        cut.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"cut\.h5") as failure:
            load(cut)
        assert "\n" not in str(failure.value)


def edited(tmp_path: Path, edit: Callable[[h5py.File], None]) -> str:
    path = tmp_path / "edited.h5"
    save(full(), path)
    with h5py.File(path, "a") as file:
        edit(file)
    with pytest.raises(InputError, match=r"edited\.h5") as failure:
        load(path)
    return str(failure.value)


def test_a_newer_schema_says_which_and_what_to_do(tmp_path: Path) -> None:
    message = edited(tmp_path, lambda file: file.attrs.__setitem__("schema_version", 7))
    assert "schema version 7" in message and "reads version 2" in message and "upgrade" in message


@pytest.mark.parametrize(
    "name",
    ["guess", "part/faces", "cameras", "probes/slide/stamps", "measurements/000003/action", "background"],
)
def test_what_is_missing_is_named(tmp_path: Path, name: str) -> None:
    assert repr(name.split("/")[-1]) in edited(tmp_path, lambda file: file.__delitem__(name))


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a file"):
        load(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("depth 1 2 3\n" * 1000)
    with pytest.raises(InputError, match=r"text\.h5 is not an HDF5 file"):
        load(tmp_path / "text.h5")
    assert "not a bcppl recording" in edited(tmp_path, lambda file: file.attrs.__delitem__("format"))
    assert "'left'" in edited(tmp_path, lambda file: file["cameras"].__delitem__("left"))
    assert "unknown kind" in edited(
        tmp_path, lambda file: file["measurements/000003"].attrs.__setitem__("kind", "sniff")
    )


# ---- recordings that are wrong


def with_measurement(index: int, **changes: Any) -> Recording:
    """`full()` with fields of one measurement's action, camera, probe or observation replaced."""
    recording = full()
    measurements = list(recording.measurements)
    action, observation = measurements[index].action, measurements[index].observation
    for name, value in changes.items():
        if isinstance(action, View) and hasattr(action.camera, name):
            action = View(dataclasses.replace(action.camera, **{name: value}))
        elif isinstance(action, ProbeWindow) and hasattr(action.probe, name):
            action = dataclasses.replace(action, probe=dataclasses.replace(action.probe, **{name: value}))
        elif hasattr(action, name) and name != "times":
            action = dataclasses.replace(action, **{name: value})
        else:
            observation = dataclasses.replace(observation, **{name: value})
    measurements[index] = Measurement(action, observation)
    return dataclasses.replace(recording, measurements=measurements)


def changed(values: Any, *place: int, to: float) -> Any:
    values = np.array(values)
    values[place] = to
    return values


def at(index: int, name: str) -> Any:
    measurement = full().measurements[index]
    if isinstance(measurement.action, ProbeWindow) and hasattr(measurement.action.probe, name):
        return getattr(measurement.action.probe, name)
    return getattr(measurement.action if hasattr(measurement.action, name) else measurement.observation, name)


def opened(part: Part) -> Part:
    return dataclasses.replace(part, faces=part.faces[:-1])


def scaled(part: Part) -> Part:
    return dataclasses.replace(part, vertices=1e3 * part.vertices)


def push_with_path_times(times: Any) -> Recording:
    recording = full()
    measurements = list(recording.measurements)
    push: Any = measurements[3].action
    measurements[3] = Measurement(dataclasses.replace(push, times=times), measurements[3].observation)
    return dataclasses.replace(recording, measurements=measurements)


replace = dataclasses.replace
WRONG: dict[str, tuple[Recording, str]] = {
    "mesh in millimetres": (replace(full(), part=scaled(full().part)), "millimetres"),
    "open mesh": (replace(full(), part=opened(full().part)), "open mesh"),
    "open peg": (replace(full(), peg=opened(block("rod"))), "'rod' has an open mesh"),
    "empty mesh": (replace(full(), part=replace(full().part, faces=np.zeros((0, 3), int))), "empty mesh"),
    "mesh of quads": (replace(full(), part=replace(full().part, faces=np.zeros((2, 4), int))), "triangles"),
    "no measurement": (replace(full(), measurements=[]), "no measurement"),
    "no peg": (replace(full(), peg=None), "measurement 1 is a probe window but the recording has no peg"),
    "negative width": (
        replace(full(), guess=replace(full().guess, translation=np.array([0.1, -0.1, 0]))),
        "negative half width",
    ),
    "angle in degrees": (replace(full(), guess=replace(full().guess, angle=25.0)), "degrees"),
    "guess not unit": (
        replace(full(), guess=replace(full().guess, world_from_part=np.array([0.0, 0, 0, 1, 1, 0, 0]))),
        "the guess .* quaternion of length 1.414",
    ),
    "truth not finite": (replace(full(), truth=np.array([np.nan, 0, 0, 1, 0, 0, 0])), "the truth .* finite"),
    "camera inside": (
        with_measurement(2, world_from_camera=np.array([0.01, 0.02, 0.0006, 0, 1, 0, 0])),
        "measurement 2: camera 'wrist/right.2' stands .* inside it .* wrong units",
    ),
    "camera in millimetres": (
        with_measurement(2, world_from_camera=np.array([0.0, 0, 600, 0, 1, 0, 0])),
        "measurement 2: camera .* wrong units",
    ),
    "camera of nine coefficients": (
        with_measurement(2, distortion=[0.1] * 8),
        "measurement 2: camera .* not Brown's k1 k2 p1 p2",
    ),
    "camera folded": (
        with_measurement(2, distortion=(-3.0, 0.5, 0.0, 0.0)),
        "measurement 2: camera .* folds the image over: .* pixels",
    ),
    "camera with a coefficient that is no number": (
        with_measurement(2, distortion=(0.1, np.nan, 0.0, 0.0)),
        "measurement 2: camera .* finite numbers",
    ),
    "camera on a wrist in another's place": (
        with_measurement(2, wrist_from_camera=np.array([0, 0, 0.1, 0, 3, 0, 0])),
        "measurement 2: camera .* wrist_from_camera has a quaternion of length 3",
    ),
    "camera not unit": (
        with_measurement(2, world_from_camera=np.array([0, 0, 0.6, 0, 2, 0, 0])),
        "measurement 2: camera .* quaternion of length 2",
    ),
    "two cameras, one name": (
        with_measurement(6, world_from_camera=np.array([0, 0, 0.7, 0, 1, 0, 0])),
        "measurement 6: camera 'left' differs",
    ),
    "depth size": (with_measurement(2, depth=np.ones((8, 6))), "measurement 2: .* 6×8, .* 8×6 pixels"),
    "depth missing": (
        with_measurement(2, depth=np.full((6, 8), np.nan)),
        "measurement 2: .* missing in every",
    ),
    "depth zero": (with_measurement(2, depth=np.zeros((6, 8))), "measurement 2: .* missing in every"),
    "depth in millimetres": (
        with_measurement(2, depth=np.full((6, 8), 480.0)),
        "measurement 2: .* millimetres",
    ),
    "depth out of range": (with_measurement(2, depth=np.full((6, 8), 4.5)), "measurement 2: .* range"),
    "depth negative": (with_measurement(2, depth=np.full((6, 8), -0.5)), "measurement 2: .* negative"),
    "wrench times": (
        with_measurement(3, times=changed(at(3, "times"), 20, to=0.0)),
        "measurement 3's wrench .* backwards at row 20",
    ),
    "path times": (
        push_with_path_times(changed(full().measurements[3].action.times, 5, to=0.0)),  # type: ignore[union-attr]
        "measurement 3's finger path .* backwards at row 5",
    ),
    "path on another clock": (
        push_with_path_times(full().measurements[3].action.times + 1e9),  # type: ignore[union-attr]
        "measurement 3: .* one clock",
    ),
    "path not unit": (
        with_measurement(3, world_from_tip=changed(at(3, "world_from_tip"), 4, 5, to=9.0)),
        "measurement 3's finger path .* quaternion .* row 4",
    ),
    "command times": (
        with_measurement(4, command_times=changed(at(4, "command_times"), 2, to=0.25)),
        "measurement 4: probe 'press''s command .* stand still at row 2",
    ),
    "command not unit": (
        with_measurement(4, command=changed(at(4, "command"), 2, 4, to=3.0)),
        "measurement 4: .* quaternion .* row 2",
    ),
    "stamps": (
        with_measurement(4, stamps=changed(at(4, "stamps"), 15, to=0.1)),
        "measurement 4: .* stamps .* backwards at row 15",
    ),
    "stiffness": (with_measurement(4, stiffness=-np.ones(6)), "measurement 4: .* stiffness"),
    "two probes, one name": (with_measurement(5, damping=np.ones(6)), "measurement 5: probe 'slide' differs"),
    "window beyond stamps": (with_measurement(5, last=25), "measurement 5: .* within its 20 stamps"),
    "window overlaps": (with_measurement(5, first=6), "measurement 5: .* without overlap"),
    "window times": (
        with_measurement(5, times=at(5, "stamps")[7:20] + 0.001),
        "measurement 5: .* wrench time 0.351",
    ),
    "peg not unit": (
        with_measurement(5, world_from_peg=changed(at(5, "world_from_peg"), 3, 3, to=4.0)),
        "measurement 5's peg pose .* row 3",
    ),
    "peg poses short": (with_measurement(5, world_from_peg=np.zeros((2, 7))), "measurement 5's peg pose"),
    "wrench NaN": (
        with_measurement(1, wrench=changed(at(1, "wrench"), 4, 2, to=np.nan)),
        "measurement 1 has a wrench that is not finite at row 4; fill it by interpolation, or cut",
    ),
    "wrench NaN in a push": (
        with_measurement(3, wrench=changed(at(3, "wrench"), 9, 2, to=np.nan)),
        "measurement 3 has a wrench that is not finite at row 9; leave that row out",
    ),
    "wrench too large": (
        with_measurement(3, wrench=changed(at(3, "wrench"), 9, 2, to=-2e4)),
        "measurement 3 has a wrench of 2e[+]04 at row 9",
    ),
    "view with a touch": (
        replace(full(), measurements=[Measurement(View(camera("left")), full().measurements[3].observation)]),
        "measurement 0 pairs a View with a Touch",
    ),
    "window left out": (
        replace(full(), measurements=[m for m in full().measurements if getattr(m.action, "last", 0) != 7]),
        "leaves out stamps 0 to 7",
    ),
    "background size": (replace(full(), background={"left": np.ones((3, 3))}), "background of camera 'left'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_each_problem_is_one_sentence_that_says_where(case: str) -> None:
    recording, pattern = WRONG[case]
    found = problems(recording)
    matching = [problem for problem in found if re.search(pattern, problem)]
    assert len(matching) == 1, found
    for problem in found:
        assert_one_sentence(problem)
    with pytest.raises(InputError) as failure:
        validate(recording)
    assert str(failure.value) == found[0]
    assert describe(recording)


def test_an_open_mesh_may_be_looked_at() -> None:
    recording = full()
    seen = replace(recording, part=opened(recording.part), measurements=[recording.measurements[0]], peg=None)
    assert problems(seen) == []
    assert len(notes(seen)) == 1 and "open mesh" in notes(seen)[0]
    assert notes(recording) == []


def test_describe_says_what_is_there() -> None:
    rows = dict(describe(full()))
    assert "100.0 × 80.0 × 30.0 mm" in rows["part"] and "closed" in rows["part"]
    assert rows["measurements"] == "3 views, 3 probe windows, 1 push"
    assert rows["camera left"] == "8×6 pixels, 0.06 to 4 m, background known"
    assert "20 Hz" in rows["probe slide"] and rows["truth"] == "known"

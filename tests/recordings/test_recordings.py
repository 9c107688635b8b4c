"""Recordings on disk: what comes back is what went in, and a refusal is one sentence."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as arrays

from bcppl.errors import InputError
from bcppl.recordings import (
    DepthImage,
    Measurement,
    ProbeWindow,
    Push,
    Touch,
    View,
    load,
    problems,
    save,
)
from tests.made_recordings import assert_identical, assert_one_sentence, camera, full, poses

SHIPPED = Path(__file__).parents[2] / "models/recordings/peg_probe.h5"


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


def test_each_is_printed_on_a_line() -> None:
    recording = full()
    printed = [recording, recording.part, recording.peg]
    printed += [each for m in recording.measurements for each in (m.action, m.observation)]
    lines = [repr(each) for each in printed]
    assert max(map(len, lines)) < 400 and not any("\n" in line for line in lines)
    assert "3 ProbeWindow" in lines[0] and "Push" in lines[0]


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


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
def test_what_is_no_file_is_not_replaced_by_one(tmp_path: Path) -> None:
    """As root, a device would be gone for all programs."""
    os.mkfifo(tmp_path / "pipe.h5")
    (tmp_path / "link.h5").symlink_to("pipe.h5")
    (tmp_path / "folder.h5").mkdir()
    before = sorted(tmp_path.iterdir())
    for path in before:
        with pytest.raises(
            InputError, match=rf"{path.name} cannot be written: .* give a file's name"
        ) as failure:
            save(full(), path)
        assert_one_sentence(str(failure.value).replace(str(path), "it"))
    assert sorted(tmp_path.iterdir()) == before
    assert (tmp_path / "pipe.h5").is_fifo() and (tmp_path / "link.h5").is_symlink()


def test_a_link_stays_and_its_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link.h5").symlink_to("there/a.h5")
    for seed in (0, 1):  # at first the file is yet to be made
        save(full(seed), tmp_path / "link.h5")
        assert (tmp_path / "link.h5").is_symlink() and not (tmp_path / "there/a.h5").is_symlink()
        assert_identical(load(tmp_path / "there/a.h5"), full(seed))
    assert sorted(each.name for each in tmp_path.rglob("*")) == ["a.h5", "link.h5", "there"]
    (tmp_path / "lost.h5").symlink_to("nowhere/a.h5")
    with pytest.raises(InputError, match=r"no folder .*nowhere; make it first"):
        save(full(), tmp_path / "lost.h5")


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


def test_a_newer_schema_is_named_with_what_to_do(tmp_path: Path) -> None:
    message = edited(tmp_path, lambda file: file.attrs.__setitem__("schema_version", 7))
    assert "schema version 7" in message and "reads versions 1 to 2" in message and "upgrade" in message


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

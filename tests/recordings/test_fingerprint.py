"""Fingerprints: recordings that differ in a number that a belief depends on have different ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bcppl.recordings import Measurement, Recording, load, save
from bcppl.recordings.fingerprint import fingerprint, is_of
from tests.made_recordings import full

SHIPPED = Path(__file__).parents[2] / "models/recordings/peg_probe.h5"
# Of the shipped recording's first five measurements, as beliefs carried it when no prefix was written.
FIRST_VERSION = "50f07283f14b7155e7326282935220856ba05b572ed3ab9b81d773104d2ced63"


def changed(index: int, *path: str, by: float = 1e-9) -> Recording:
    """`full()` with a number moved: that of a measurement's action or observation, at a path of fields."""
    recording = full()
    measurements = list(recording.measurements)
    measurements[index] = moved(measurements[index], path, by)
    return replace(recording, measurements=measurements)


def moved(thing: Any, path: tuple[str, ...], by: float) -> Any:
    if not path:
        values = np.array(thing)
        values.flat[-1] += by
        return values
    return replace(thing, **{path[0]: moved(getattr(thing, path[0]), path[1:], by)})


def with_camera(**changes: Any) -> Recording:
    recording = full()
    first = recording.measurements[0]
    action = replace(first.action, camera=replace(first.action.camera, **changes))
    return replace(
        recording, measurements=[Measurement(action, first.observation), *recording.measurements[1:]]
    )


def with_window(**changes: Any) -> Recording:
    recording = full()
    measurements = list(recording.measurements)
    action = replace(measurements[5].action, **changes)
    measurements[5] = Measurement(action, measurements[5].observation)
    return replace(recording, measurements=measurements)


WHOLE = full()
assert WHOLE.peg is not None
OTHER = {
    "command": changed(1, "action", "probe", "command"),
    "command times": changed(1, "action", "probe", "command_times"),
    "stiffness": changed(1, "action", "probe", "stiffness"),
    "damping": changed(1, "action", "probe", "damping"),
    "stamps": changed(1, "action", "probe", "stamps"),
    "window": with_window(first=8),
    "path": changed(3, "action", "world_from_tip"),
    "path times": changed(3, "action", "times"),
    "wrench": changed(1, "observation", "wrench"),
    "wrench times": changed(1, "observation", "times"),
    "peg pose": changed(1, "observation", "world_from_peg"),
    "depth": changed(0, "observation", "depth", by=1e-4),
    "colour": changed(0, "observation", "rgb", by=1),
    "camera pose": changed(0, "action", "camera", "world_from_camera"),
    "camera name": with_camera(name="right"),
    "camera device": with_camera(device="wrist"),
    "camera focal length": with_camera(fx=9.1),
    "camera range": with_camera(far=9.1),
    "camera distortion": with_camera(distortion=(0.01, 0.0, 0.0, 0.0)),
    "background": replace(WHOLE, background={"left": WHOLE.background["left"] + 1e-4}),
    "background name": replace(WHOLE, background={"right": WHOLE.background["left"]}),
    "guess": replace(WHOLE, guess=replace(WHOLE.guess, yaw=0.31)),
    "guess without angle": replace(WHOLE, guess=replace(WHOLE.guess, angle=None)),
    "part": replace(WHOLE, part=replace(WHOLE.part, vertices=moved(WHOLE.part.vertices, (), 1e-9))),
    "part's pieces": replace(WHOLE, part=replace(WHOLE.part, pieces=WHOLE.part.pieces[:1])),
    "peg": replace(WHOLE, peg=replace(WHOLE.peg, vertices=moved(WHOLE.peg.vertices, (), 1e-9))),
    "no peg": replace(WHOLE, peg=None),
}


@pytest.mark.parametrize("case", OTHER)
def test_a_number_that_differs_is_seen(case: str) -> None:
    count = len(WHOLE.measurements)
    assert fingerprint(OTHER[case], count) != fingerprint(WHOLE, count)
    assert not is_of(fingerprint(OTHER[case], count), WHOLE, count)


def test_what_no_belief_depends_on_is_not_seen() -> None:
    same = replace(
        WHOLE, truth=None, model="look_and_touch", source="elsewhere", part=replace(WHOLE.part, source="")
    )
    assert fingerprint(same, 7) == fingerprint(WHOLE, 7)
    assert fingerprint(changed(6, "observation", "depth", by=1.0), 6) == fingerprint(WHOLE, 6)
    assert len({fingerprint(WHOLE, count) for count in range(8)}) == 8


def test_a_recording_has_the_same_fingerprint_before_and_after_it_was_saved(tmp_path: Path) -> None:
    sharp = np.random.default_rng(0).uniform(0.2, 4.0, (6, 8))  # no float32
    recording = replace(changed(0, "observation", "depth", by=1e-10), background={"left": sharp})
    save(recording, tmp_path / "a.h5")
    loaded = load(tmp_path / "a.h5")
    assert [fingerprint(loaded, k) for k in range(8)] == [fingerprint(recording, k) for k in range(8)]


def test_fingerprints_of_earlier_beliefs_are_recognised() -> None:
    recording = load(SHIPPED)
    assert is_of(FIRST_VERSION, recording, 5) and not is_of(FIRST_VERSION, recording, 6)
    touched = list(recording.measurements)
    touched[3] = moved(touched[3], ("observation", "wrench"), 1e-9)
    assert not is_of(FIRST_VERSION, replace(recording, measurements=touched), 5)
    assert is_of("", recording, 5)

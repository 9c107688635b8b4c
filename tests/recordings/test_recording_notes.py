"""Recordings that may be right but rarely are: a sentence each, and inference goes on."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from bcppl.models import load_recording
from bcppl.recordings import Measurement, Touch, notes, problems
from tests.made_recordings import assert_one_sentence, full
from tests.recordings.test_recording_problems import opened

replace = dataclasses.replace


def test_an_open_mesh_may_be_looked_at() -> None:
    recording = full()
    seen = replace(recording, part=opened(recording.part), measurements=[recording.measurements[0]], peg=None)
    assert problems(seen) == []
    assert len(notes(seen)) == 1 and "open mesh" in notes(seen)[0]
    assert notes(recording) == []
    held = replace(recording, guess=replace(recording.guess, tilt=0.0, yaw=0.0, angle=None))
    assert "holds the part's rotation fixed" in notes(held)[0]


@pytest.mark.parametrize("name", ["peg_probe", "point_probe_10_pushes"])
def test_a_shipped_recording_gives_no_cause_for_a_note(name: str) -> None:
    assert notes(load_recording(name)) == []


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_a_wrench_that_never_changes_is_noted(value: float) -> None:
    def constant(each: Measurement) -> Measurement:
        if isinstance(each.observation, Touch):
            still = np.full_like(each.observation.wrench, value)
            return replace(each, observation=replace(each.observation, wrench=still))
        return each

    dead = [constant(each) for each in full().measurements]
    found = notes(replace(full(), measurements=dead))
    assert len(found) == 2  # of probes and of pushes
    for note in found:
        assert_one_sentence(note)
        assert f"no force was measured: the wrench is {value:g} {value:g}" in note
    one_felt = [*dead[:-2], full().measurements[-2], dead[-1]]
    assert len(notes(replace(full(), measurements=one_felt))) == 1
    assert notes(replace(full(), measurements=[full().measurements[0], None])) == []


def noted(**changes: Any) -> list[str]:
    """The notes on `full()` with some fields replaced, each checked to be one sentence."""
    changed = replace(full(), **changes)
    assert problems(changed) == []
    found = notes(changed)
    for note in found:
        assert_one_sentence(note)
    return found


def test_a_background_of_no_camera_is_noted() -> None:
    (found,) = noted(background={"lefd": full().background["left"]})
    assert "background of 'lefd' is not used" in found and "'left', 'wrist/right.2'" in found


def test_a_model_that_is_not_installed_is_noted_with_the_one_meant() -> None:
    (found,) = noted(model="look_and_tuch")
    assert "'look_and_tuch', which is not installed ('look_and_touch' is)" in found
    (found,) = noted(model="mine")
    assert "'mine', which is not installed: give your own file" in found


def test_a_calibration_of_another_image_size_is_noted_with_both_sizes() -> None:
    def seen_by(**intrinsics: float) -> list[Measurement]:
        first, *others = full().measurements[:-1]  # the last view is of the first one's camera
        there = replace(first.action, camera=replace(first.action.camera, **intrinsics))
        return [replace(first, action=there), *others]

    (found,) = noted(measurements=seen_by(fx=18.0, fy=19.0, cx=7.5, cy=5.5))
    assert "camera 'left'" in found and "16×12 pixels, but its images are 8×6" in found
    assert noted(measurements=seen_by(cx=5.0, cy=1.0)) == []


def test_a_truth_that_the_guess_excludes_is_noted() -> None:
    recording = load_recording("peg_probe")
    assert recording.truth is not None
    truth = np.array(recording.truth)
    truth[0] += 0.3
    elsewhere = replace(recording, truth=truth)
    (note,) = notes(elsewhere)
    assert_one_sentence(note)
    assert "the truth, 295 mm from the guess, is impossible" in note

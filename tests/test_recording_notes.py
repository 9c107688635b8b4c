"""Recordings that may be right but rarely are: a sentence each, and inference goes on."""

import dataclasses

import numpy as np
import pytest

from bcppl.models import load_recording
from bcppl.recordings import Measurement, Touch, notes, problems
from tests.made_recordings import assert_one_sentence, full
from tests.test_recording_problems import opened

replace = dataclasses.replace


def test_an_open_mesh_may_be_looked_at() -> None:
    recording = full()
    seen = replace(recording, part=opened(recording.part), measurements=[recording.measurements[0]], peg=None)
    assert problems(seen) == []
    assert len(notes(seen)) == 1 and "open mesh" in notes(seen)[0]
    assert notes(recording) == []


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

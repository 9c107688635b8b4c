"""A measurement that a recording holds twice is one observation."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bcppl.inference import infer
from bcppl.models import load_recording
from bcppl.models.point_probe import model
from bcppl.recordings import once_each, repeated
from bcppl.recordings.fingerprint import fingerprint
from bcppl.sensors import Measurement


@pytest.mark.parametrize("name", ["peg_probe", "point_probe_10_pushes"])
def test_repetitions_of_any_kind_are_named_and_left_out(name: str) -> None:
    recording = load_recording(name)
    assert repeated(recording) == {} and once_each(recording) is recording
    kept = list(recording.measurements)
    copies = replace(recording, measurements=[*kept, kept[0], kept[-1]])
    last = len(kept) - 1
    assert repeated(copies) == {len(kept): 0, len(kept) + 1: last}
    with pytest.warns(RuntimeWarning, match=f"measurement {len(kept)} repeats measurement 0, measurement"):
        once = once_each(copies)
    assert fingerprint(once, 99) == fingerprint(recording, 99)


def test_one_different_number_makes_another_measurement() -> None:
    recording = load_recording("point_probe_10_pushes")
    first = recording.measurements[0]
    wrench = first.observation.wrench.copy()
    wrench[0, 0] += 1e-9
    other = Measurement(first.action, replace(first.observation, wrench=wrench))
    assert repeated(replace(recording, measurements=[first, other])) == {}
    # The same reading of another motion, too.
    moved = replace(first.action, world_from_tip=first.action.world_from_tip + 0.0)
    assert repeated(replace(recording, measurements=[first, replace(first, action=moved)])) == {1: 0}
    moved.world_from_tip[:, 0] += 1e-6
    assert repeated(replace(recording, measurements=[first, replace(first, action=moved)])) == {}


def test_the_same_push_three_times_leaves_the_belief_of_one() -> None:
    recording = load_recording("point_probe_10_pushes")
    once = replace(recording, measurements=recording.measurements[:1])
    thrice = replace(once, measurements=[*once.measurements] * 3)
    few = {"particles": 15, "sweeps": 1, "search_climbs": 0, "always_search": False}
    *_, alone = infer(model, once, **few)
    with pytest.warns(RuntimeWarning, match="counted once"):
        *_, together = infer(model, thrice, **few)
    assert torch.equal(alone.belief.world_from_part, together.belief.world_from_part)
    assert together.taken == 1

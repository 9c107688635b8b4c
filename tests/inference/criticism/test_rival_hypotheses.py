"""Rival hypotheses on kinematic touches, without any physics: what was wrong is named, else nothing."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, box_peg, cylinder_peg
from bcppl.geometry.parts import Part
from bcppl.inference.approximations.laplace import QuadraticApproximation
from bcppl.inference.criticism import explanations
from bcppl.inference.criticism.hypotheses import VERY_STRONG
from bcppl.inference.criticism.rival_hypotheses import _with_contacts, approximated, log_evidence
from bcppl.models import look_and_touch
from bcppl.recordings import Guess, Measurement, Probe, ProbeWindow, Recording
from bcppl.sensors.altered import (
    with_peg_along,
    with_peg_thicker,
    with_peg_turned,
    with_wrench_earlier,
    with_wrench_reversed,
)

model = look_and_touch.model.with_settings(profile="perfect")
PART, PEG = block((0.05, 0.04, 0.02)), box_peg(0.014, 0.06, 0.010)
RATE, STEP = 0.01, 50
# Where the peg's tip is pressed against the block: a point and the outward normal; twice on two sides.
PLACES = (
    ((0.025, 0.010, -0.008), (1, 0, 0)),
    ((0.025, -0.012, -0.008), (1, 0, 0)),
    ((0.010, 0.020, -0.008), (0, 1, 0)),
    ((-0.012, 0.020, -0.008), (0, 1, 0)),
    ((0.0, 0.0, 0.0), (0, 0, 1)),
    ((-0.025, 0.0, -0.008), (-1, 0, 0)),
    ((0.0, -0.020, -0.008), (0, -1, 0)),
)


TRUTH = np.array([0.0, 0.0, 0.0, *Rotation.from_euler("z", 0.35).as_quat(scalar_first=True)])


def touched(moved: float = 0.0, turn: float = 0.0, seed: int = 0) -> Recording:
    """The peg goes up to each place in 0.4 s, rests there for 0.2 s, pressed by 5 N, and goes back.

    From the fifth place on the block is farther along x by `moved`. The peg is turned in the hand by `turn`
    degrees, which its measured pose, that of the hand, does not say.
    """
    rng = np.random.default_rng(seed)
    axes = Rotation.from_euler("z", turn, degrees=True)
    corners = axes.apply([[x, y, 0.0] for x in (-0.007, 0.007) for y in (-0.005, 0.005)])
    block_turn = Rotation.from_quat(TRUTH[3:], scalar_first=True)
    place, force = [], []
    for k, (point, normal) in enumerate(block_turn.apply(np.array(PLACES, dtype=np.float64))):
        # The peg's origin is 60 mm above its tip, of which the corner nearest to the block touches.
        contact = point + (-corners @ normal).max() * normal + [moved * (k >= 4), 0.0, 0.06]
        away = np.concatenate([np.linspace(0.03, 0.0, 40), np.zeros(20), np.linspace(0.0, 0.03, 40)])
        place.append(contact + away[:, None] * normal)
        force.append(np.where(away == 0.0, 5.0, 0.0)[:, None] * normal)
    position = np.concatenate(place) + 1e-5 * rng.normal(size=(len(PLACES) * 100, 3))
    felt = np.concatenate(force) + 0.05 * rng.normal(size=position.shape)
    torque = np.cross([0.0, 0.0, -0.06], felt) + 0.002 * rng.normal(size=position.shape)
    pose = np.hstack([position, np.tile([1.0, 0.0, 0.0, 0.0], (len(position), 1))])
    times = RATE * np.arange(len(pose))
    probe = Probe("probe", times, pose, np.full(6, 1000.0), np.full(6, 10.0), times)
    touch = Touch(times, np.hstack([felt, torque]), pose)
    guess = Guess(TRUTH + np.array([0.001, -0.0015, 0.001, 0, 0, 0, 0]), np.full(3, 0.005), 0.03, 0.03)
    return Recording(PART, guess, cut(probe, touch), PEG, truth=TRUTH)


def cut(probe: Probe, touch: Touch) -> list[Measurement]:
    """A probe in windows of half a second."""
    parts = [slice(first, first + STEP) for first in range(0, len(touch.times), STEP)]
    return [
        Measurement(
            ProbeWindow(probe, part.start, part.stop),
            Touch(touch.times[part], touch.wrench[part], touch.world_from_peg[part]),
        )
        for part in parts
    ]


def whole(recording: Recording, column: str) -> np.ndarray:
    return np.concatenate([getattr(m.observation, column) for m in recording.measurements])


# A recording that is wrong, the recording as it would be right, and the words for it.
FAULTS: dict[str, tuple[Recording, Callable[[Recording], Recording], str]] = {
    "late": (
        with_wrench_earlier(touched(), -0.2),
        lambda wrong: with_wrench_earlier(wrong, 0.2),
        "read 0.2 s late",
    ),
    "reversed": (with_wrench_reversed(touched()), with_wrench_reversed, "wrong sign"),
    "along": (
        with_peg_along(touched(), 0.1),
        lambda wrong: with_peg_along(wrong, -0.1),
        "along its axis",
    ),
    "turned": (
        touched(turn=18.0),
        lambda wrong: with_peg_turned(wrong, math.radians(18.0)),
        "turned by +18°",
    ),
    "thinner": (
        with_peg_thicker(touched(), 0.0005),
        lambda wrong: with_peg_thicker(wrong, -0.0005),
        "0.5 mm thinner",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("name", FAULTS)
def test_evidence_is_for_what_was_wrong_and_for_nothing_else(name: str) -> None:
    """What would mend one recording makes a good one worse."""
    wrong, mended, _ = FAULTS[name]
    good = touched()
    with_fault, without = (
        log_evidence(approximated(model, mended(one))) - log_evidence(approximated(model, one))
        for one in (wrong, good)
    )
    assert with_fault > VERY_STRONG
    assert without < 0.0


def test_a_search_for_modes_does_not_depend_on_what_was_known_before() -> None:
    """A pose that is known to hundredths of a millimetre, and all else as it was."""
    stated = approximated(model, touched())
    assert stated.quadratic is not None
    best = QuadraticApproximation(*(values[:1] for values in stated.quadratic))
    sure = best._replace(information=best.information + 1e10 * torch.eye(6).double())
    known = _with_contacts(replace(stated, adapted=sure), stated.contacts, True)
    assert known.quadratic is not None
    for again, first in zip(known.quadratic, stated.quadratic, strict=True):
        assert torch.equal(again, first)


@pytest.mark.long
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named_first(name: str) -> None:
    wrong, _, words = FAULTS[name]
    assert words in explanations(model, wrong)[0].hypothesis


@pytest.mark.long
def test_a_part_that_moved_is_named_with_its_time() -> None:
    """Before the fifth touch, at 4.4 s, which is from above and does not show it, or the sixth, at 5.4 s."""
    first = explanations(model, touched(moved=0.003))[0].hypothesis
    time = re.search(r"the part moved, or the peg slipped, before the touch at (.*) s", first)
    assert time is not None and 4.39 <= float(time[1]) <= 5.41


@pytest.mark.long
def test_how_far_off_a_frame_is_along_the_peg_is_stated() -> None:
    """As far as the prior, 5 mm wide, leaves the part's height open."""
    first = explanations(model, FAULTS["along"][0])[0].hypothesis
    off = re.search(r"off by (.*) mm along its axis", first)
    assert off is not None and abs(float(off[1]) + 100.0) < 5.0


@pytest.mark.long
def test_a_recording_without_a_fault_needs_no_explanation() -> None:
    assert explanations(model, touched()) == []


def test_nothing_is_explained_without_touches() -> None:
    assert explanations(model, replace(touched(), measurements=[])) == []


def test_a_wrench_is_moved_by_stamps_across_windows() -> None:
    recording = touched()
    earlier = whole(with_wrench_earlier(recording, 0.07), "wrench")
    np.testing.assert_array_equal(earlier[:-7], whole(recording, "wrench")[7:])
    np.testing.assert_array_equal(earlier[-7:], np.tile(whole(recording, "wrench")[-1], (7, 1)))
    np.testing.assert_array_equal(
        whole(with_wrench_earlier(recording, 0.07), "times"), whole(recording, "times")
    )


def test_a_turned_peg_feels_the_same_wrench_in_the_world() -> None:
    recording = touched()
    turned = with_peg_turned(recording, 0.3)
    before, after = (
        Rotation.from_quat(whole(r, "world_from_peg")[:, 3:], scalar_first=True) for r in (recording, turned)
    )
    for part in (slice(3), slice(3, 6)):
        there = (r.apply(whole(one, "wrench")[:, part]) for r, one in ((before, recording), (after, turned)))
        np.testing.assert_allclose(*there, atol=1e-12)
    again = with_peg_turned(turned, -0.3)
    np.testing.assert_allclose(whole(again, "world_from_peg"), whole(recording, "world_from_peg"), atol=1e-12)
    angle = (before.inv() * after).as_rotvec()
    np.testing.assert_allclose(angle, np.tile([0.0, 0.0, 0.3], (len(angle), 1)), atol=1e-9)


def test_a_peg_is_displaced_along_its_own_axis() -> None:
    tilted = with_peg_turned(touched(), 0.0)
    turn = Rotation.from_euler("x", 90, degrees=True).as_quat(scalar_first=True)
    for m in tilted.measurements:
        m.observation.world_from_peg[:, 3:] = turn
    step = whole(with_peg_along(tilted, 0.1), "world_from_peg") - whole(tilted, "world_from_peg")
    np.testing.assert_allclose(step[:, :3], np.tile([0.0, -0.1, 0.0], (len(step), 1)), atol=1e-12)


@pytest.mark.parametrize("peg", [PEG, cylinder_peg(0.012, 0.05)], ids=["box", "cylinder"])
def test_a_thicker_peg_has_pieces_of_its_size(peg: Part) -> None:
    recording = replace(touched(), peg=peg)
    thicker = with_peg_thicker(recording, 0.001).peg
    assert recording.peg is not None and thicker is not None
    width = np.ptp(recording.peg.vertices, axis=0)
    factor = 1.0 + 0.001 / width[:2].max()
    np.testing.assert_allclose(np.ptp(thicker.vertices, axis=0), width * [factor, factor, 1.0])
    for new, old in zip(thicker.pieces, recording.peg.pieces, strict=True):
        sizes = [factor, 1.0] if new.kind == "cylinder" else [factor, factor, 1.0]
        np.testing.assert_allclose(new.size, old.size * sizes)
    with pytest.raises(InputError, match="cannot be thinner by"):
        with_peg_thicker(recording, -0.1)
    with pytest.raises(InputError, match="no peg"):
        with_peg_thicker(replace(recording, peg=None), 0.001)

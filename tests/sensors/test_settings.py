"""Settings of the shipped models: whatever is given for one, it is used or refused in one sentence."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import pytest

from bcppl.contact.sensing.contact_detection import ContactDetector
from bcppl.errors import InputError
from bcppl.models import arm_in_view, grasped_peg, part_in_view
from bcppl.sensors.likelihoods.camera_settings import CameraSettings
from bcppl.sensors.likelihoods.contact_probe import TouchSettings
from bcppl.sensors.likelihoods.point_finger import FingerSettings
from bcppl.sensors.likelihoods.simulated_probe import ProbeSettings
from bcppl.sensors.scene import chosen
from tests.made_recordings import assert_one_sentence

KINDS = [
    CameraSettings,
    ProbeSettings,
    TouchSettings,
    FingerSettings,
    arm_in_view.Settings,
    grasped_peg.DepthSettings,
    part_in_view.Settings,
]
FIELDS = [(kind, each.name) for kind in KINDS for each in fields(kind)]
NONSENSE = [math.nan, math.inf, -1e9, {}, {"a": 1}, [[1.0]], [None], "\x1b[2J", object()]


@pytest.mark.parametrize(("kind", "name"), FIELDS, ids=lambda each: getattr(each, "__qualname__", each))
def test_no_setting_takes_nonsense(kind: Any, name: str) -> None:
    default = getattr(kind(), name)
    assert chosen("this model", {name: default}, kind())[0] == kind()
    for value in NONSENSE:
        # A number's sign may be free, and a name is looked up where its kind is known.
        if (value == -1e9 and name == "offset") or (isinstance(value, str) and isinstance(default, str)):
            continue
        with pytest.raises(InputError) as refused:
            chosen("this model", {name: value}, kind())
        assert_one_sentence(str(refused.value))


def test_fields_of_a_setting_are_given_by_name_and_the_others_stay() -> None:
    (given,) = chosen("this model", {"contact_detector": {"contact": 4, "free": 2.0}}, TouchSettings())
    assert given.contact_detector == ContactDetector(contact=4, free=2.0)
    for value, sentence in (
        ({"contacts": 4}, "no field 'contacts'; it has contact, free"),
        ({"free": 9}, "free 9 N"),
    ):
        with pytest.raises(InputError, match=sentence):
            chosen("this model", {"contact_detector": value}, TouchSettings())


def test_a_median_and_a_spread_are_two_numbers() -> None:
    for value in (0.0, 0.3, (0.3,), (0.3, 0.1, 0.2), (0.3, 0.0), "ab"):
        with pytest.raises(InputError, match="ProbeSettings has friction"):
            ProbeSettings(friction=value)  # type: ignore[arg-type]
    assert ProbeSettings(friction=[0.3, 0.1]).friction == (0.3, 0.1)  # type: ignore[arg-type]

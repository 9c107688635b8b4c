"""Files of actions: round trips, and what is refused in a sentence."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from bcppl import poses
from bcppl.errors import InputError
from bcppl.recordings.action_file import load_actions, save_actions
from bcppl.robot.plan import Plan
from bcppl.sensors import View
from tests.inference.design.test_candidates import planned
from tests.made_recordings import assert_one_sentence


@pytest.mark.parametrize("suffix", [".h5", ".json"])
def test_actions_come_back_from_a_file_bit_for_bit(suffix: str, tmp_path: Path) -> None:
    scene, _, found = planned(5)
    device = dataclasses.replace(
        scene.cameras[0], device="wrist", distortion=(0.1, 0.0, 0.0, 0.0), wrist_from_camera=scene.truth
    )
    knots = np.repeat(poses.identity(5000).numpy()[:1], 5000, axis=0)
    ones = np.ones(6)
    long = Plan("long", np.linspace(0.0, 50.0, 5000), knots, ("held",) * 4999, 4.0, ones, ones)
    actions = [*found, View(device), long]
    save_actions(actions, tmp_path / f"actions{suffix}")
    back = load_actions(tmp_path / f"actions{suffix}")
    for there, here in zip(actions, back, strict=True):
        assert type(there) is type(here)
        ours, theirs = (vars(a.camera if isinstance(a, View) else a) for a in (there, here))
        assert all(np.array_equal(ours[name], theirs[name]) for name in ours)


def test_files_of_actions_that_make_no_sense_are_refused_in_a_sentence(tmp_path: Path) -> None:
    written = {
        "none.json": '{"actions": 3}',
        "kind.json": '{"actions": [{"kind": "dance"}]}',
        "lacks.json": '{"actions": [{"kind": "plan", "name": "a", "manners": []}]}',
        "words.json": '{"actions": [{"kind": "view", "name": "a", "width": 3}]}',
        "cut.json": '{"actions": [',
        "cut.h5": "no HDF5",
        "plans.txt": "",
    }
    for name, text in written.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=name.split(".")[0]) as caught:
            load_actions(tmp_path / name)
        assert_one_sentence(str(caught.value))
    with pytest.raises(InputError, match="there is no file"):
        load_actions(tmp_path / "absent.json")
    plan = {
        "kind": "plan",
        "name": "a",
        "times": [0.0, 1.0],
        "world_from_peg": [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]] * 2,
        "manners": ["free"],
        "force": 4.0,
        "stiffness": [100.0] * 6,
        "damping": [1.0] * 6,
    }
    wrong: dict[str, dict[str, Any]] = {
        "a Plan has no field 'Rate'": plan | {"Rate": 50.0},
        "a View has no field 'distorsion'": {"kind": "view", "distorsion": []},
        "plan.json: plan 'a' stops at -4.0 N": plan | {"force": -4.0},
        "times that are no array of numbers|cannot be read": plan | {"times": [0.0, "a"]},
    }
    for message, action in wrong.items():
        (tmp_path / "plan.json").write_text(json.dumps({"actions": [action]}))
        with pytest.raises(InputError, match=message) as caught:
            load_actions(tmp_path / "plan.json")
        assert_one_sentence(str(caught.value))
    camera = {"kind": "view", "name": "b", "world_from_camera": plan["world_from_peg"][0]} | {  # type: ignore[index]
        **{"width": 160, "height": 120, "fx": 100.0, "fy": 100.0, "cx": 80.0, "cy": 60.0},
        **{"near": 0.1, "far": 2.0},
    }
    for field, value, message in (
        ("width", "160", "'160' pixels wide"),
        ("height", -1, "-1 pixels high"),
        ("fx", "a", "focal length fx 'a'"),
        ("far", 0.05, "has a range from 0.1 m to 0.05 m"),
        ("wrist_from_camera", [1, 2], "wrist_from_camera"),
        ("world_from_camera", [0.0] * 7, "world_from_camera"),
    ):
        (tmp_path / "view.json").write_text(json.dumps({"actions": [camera | {field: value}]}))
        with pytest.raises(InputError, match=f"action 0 of .*view.json: .*{message}") as caught:
            load_actions(tmp_path / "view.json")
        assert_one_sentence(str(caught.value))
    (tmp_path / "plan.json").write_text(json.dumps({"actions": [plan, camera]}))
    assert len(load_actions(tmp_path / "plan.json")) == 2
    (tmp_path / "plan.json").write_text('{"schema_version": "1", "actions": []}')
    with pytest.raises(InputError, match="schema_version '1'"):
        load_actions(tmp_path / "plan.json")
    save_actions([], tmp_path / "empty.h5")
    assert load_actions(tmp_path / "empty.h5") == []
    with pytest.raises(InputError, match="cannot be written"):
        save_actions([], tmp_path / f"{'a' * 300}.json")


def test_a_damaged_file_of_actions_names_the_action(tmp_path: Path) -> None:
    def refused(message: str, damage: Callable[[h5py.Group], None]) -> None:
        save_actions(planned(5)[2][:2], tmp_path / "plans.h5")
        with h5py.File(tmp_path / "plans.h5", "r+") as file:
            damage(file["actions/000001"])
        with pytest.raises(InputError, match=f"action 1 of .*plans.h5.* {message}") as caught:
            load_actions(tmp_path / "plans.h5")
        assert_one_sentence(str(caught.value))

    def lacking(group: h5py.Group) -> None:
        del group["times"]

    def deep(group: h5py.Group) -> None:
        del group["times"]
        group.create_group("times")

    refused("lacks 'times'", lacking)
    refused("cannot be read .times is in 'a group'", deep)
    refused("is of kind 'vieuw'", lambda group: group.attrs.update(kind="vieuw"))
    refused(
        "cannot be read .world_from_peg is in 'mm",
        lambda group: group["world_from_peg"].attrs.update(units="mm mm mm 1 1 1 1"),
    )

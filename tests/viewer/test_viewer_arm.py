"""The arm on the page of a run: its links are where forward kinematics has them, and they are seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from bcppl import poses, view
from bcppl.errors import InputError
from bcppl.models import load_recording
from bcppl.models.robots import load_robot
from bcppl.robot.arm_with_peg import ArmWithPeg
from bcppl.sensors import Recording
from bcppl.viewer.arm import DrawnArm
from bcppl.viewer.held import content
from tests.command_line import Ran
from tests.viewer.browser import SPACE, coloured, in_browser, opened
from tests.viewer.test_viewer import LARGEST, many

HELD, HERE = np.array([0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.0]), np.array([0.02, 0.0, -0.01, 1.0, 0.0, 0.0, 0.0])
FAR = np.array([9.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
METAL = (0xC0, 0xC0, 0xBB)  # in the light


@pytest.fixture(scope="module")
def arm() -> ArmWithPeg:
    return ArmWithPeg(load_robot("panda", tip="panda_hand"), "panda_hand", HELD, HERE)


@pytest.fixture(scope="module")
def touched() -> Recording:
    whole = load_recording("peg_probe")
    return dataclasses.replace(whole, measurements=whole.measurements[1:4])


def test_links_are_where_forward_kinematics_has_them_and_hold_the_measured_peg(
    arm: ArmWithPeg, touched: Recording
) -> None:
    drawn = DrawnArm(arm)
    names = [part.name for part in drawn.links]
    angles = []
    for measurement in touched.measurements[1:]:
        placed = drawn.placed(np.asarray(measurement.observation.world_from_peg))
        assert placed is not None and drawn._angles is not None
        rows, links = placed
        angles.append(drawn._angles)
        last = arm.robot.base_from_links(drawn._angles, links=names)
        expected = poses.compose(torch.as_tensor(HERE), last).numpy()
        assert np.abs(links[-1] - expected).max() < 1e-12
        hand = torch.from_numpy(links[:, names.index("panda_hand")])
        held = poses.local(
            torch.as_tensor(measurement.observation.world_from_peg[rows]),
            poses.compose(hand, torch.as_tensor(HELD)),
        )
        assert held[:, :3].abs().max() < 0.0005 and held[:, 3:].abs().max() < np.radians(0.5)
        assert np.linalg.norm(np.diff(links[..., :3], axis=0), axis=-1).max() < 0.01  # no jump of a link
    assert np.abs(angles[1] - angles[0]).max() < 0.1  # nor from touch to touch


def test_the_page_holds_those_poses_at_touches_alone(arm: ArmWithPeg, touched: Recording) -> None:
    held = content(touched, arm=arm)
    viewed, first, second = (entry["measurement"] for entry in held["entries"][1:])
    assert "arm" not in viewed
    assert next(link["name"] for link in held["arm"]["links"]) == "panda_link0"
    for each in (first, second):
        assert each["arm"]["poses"].shape == (len(each["arm"]["rows"]), len(held["arm"]["links"]), 7)
        assert np.abs(each["arm"]["poses"][:, 0, :3] - HERE[:3]).max() < 1e-6


def test_an_arm_without_meshes_is_drawn_as_segments(
    arm: ArmWithPeg, touched: Recording, tmp_path: Path
) -> None:
    (tmp_path / "panda.urdf").write_bytes(arm.robot._description.file.read_bytes())
    bare = arm._replace(robot=load_robot(tmp_path / "panda.urdf", tip="panda_hand"))
    with pytest.warns(RuntimeWarning, match=r"needs the mesh .* Segments are drawn in their place\."):
        page = view(touched, arm=bare)
    assert str(tmp_path) not in page.text
    with pytest.warns(RuntimeWarning):
        links = DrawnArm(bare).links
    ends = [link.vertices[link.vertices @ link.vertices.mean(0) > 0.0].mean(0) for link in links]
    assert len(links) > 4 and all(np.isfinite(end).all() for end in ends)
    joint = bare.robot.joint_to("panda_link1").parent_from_child[:3, 3]
    assert links[0].name == "panda_link0" and links[0].vertices[:, 2].max() == pytest.approx(joint[2])


@pytest.mark.long
def test_an_arm_that_reaches_no_touch_is_refused(arm: ArmWithPeg, touched: Recording) -> None:
    with pytest.raises(InputError, match="panda reaches no touch"):
        view(touched, arm=arm._replace(world_from_base=FAR))


@in_browser
def test_the_arm_is_seen_in_step_with_the_touch(arm: ArmWithPeg, tmp_path: Path) -> None:
    recording, history = many(particles=1000)
    page = view(recording, history, arm=arm)
    page.save(tmp_path / "arm.html")
    assert (tmp_path / "arm.html").stat().st_size < LARGEST
    view(recording, history).save(tmp_path / "none.html")
    with_arm, seen = opened(tmp_path / "arm.html", "#step=15")
    looked, at_view = opened(tmp_path / "arm.html", "#step=2")
    without, unseen = opened(tmp_path / "none.html", "#step=15")
    assert [int(each["arm"]) for each in (with_arm, looked, without)] == [11, 0, 0]
    assert int(with_arm["milliseconds"]) < 5000
    assert coloured(seen, METAL, SPACE) > 5000 > 1000 > coloured(at_view, METAL, SPACE)
    assert coloured(unseen, METAL, SPACE) < 1000


@pytest.mark.long
def test_the_command_line_draws_the_arm_or_refuses_in_one_sentence(bcppl: Callable[..., Ran]) -> None:
    hand = ["--robot", "panda", "--link", "panda_hand", "--link-from-peg", "0 0 0.1 0 1 0 0"]
    ran = bcppl("view", "peg_probe", "--save", "arm.html", *hand)
    assert ran.code == 0, ran.err
    assert "panda_link7" in Path("arm.html").read_text()
    for words, sentence in (
        (["--robot", "hal", "--link", "x"], "no URDF file and no shipped robot"),
        (["--link", "panda_hand"], "give it with --robot"),
        (hand[:4], "without --link-from-peg"),
        ([*hand, "--world-from-base", "9 0 0 1 0 0 0"], "reaches no touch"),
    ):
        ran = bcppl("view", "peg_probe", "--save", "no.html", *words)
        assert ran.code == 2 and sentence in ran.err and ran.err.count("\n") == 1, ran.err

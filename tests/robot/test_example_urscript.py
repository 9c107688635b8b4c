"""The program of the examples for a UR controller, read as the Python that it nearly is."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from tests.robot.robot_examples import FOLDER

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="examples/ stands in a checkout only")

STIFFNESS = {43: 800.0, 44: 1500.0, 45: 5.0}  # across, along, about


class Stopped(Exception):
    """The loop of the program has run as long as it is to."""


class Controller:
    """The functions that the program calls; poses are x y z rx ry rz.

    Args:
        force, torque: (3,) constant, in the base's axes, N and N m.
        pose: that is commanded; None for no command.
        steps: of the controller.
    """

    def __init__(self, force: Array, torque: Array, pose: Array | None, steps: int) -> None:
        self.wrench, self.pose, self.steps = [*force, *torque], pose, steps
        self.led: list[Array] = []

    def __getitem__(self, name: str) -> Any:
        return getattr(self, name)

    def get_steptime(self) -> float:
        return 0.002

    def get_actual_tcp_pose(self) -> list[float]:
        return [0.4, 0.1, 0.3, 0.0, 3.1, 0.0]

    def get_tcp_force(self) -> list[float]:
        return self.wrench

    def zero_ftsensor(self) -> None:
        return None

    def read_input_integer_register(self, number: int) -> int:
        assert number == 18
        return 7 + int(self.pose is not None and len(self.led) > 10)

    def read_input_float_register(self, number: int) -> float:
        if number in STIFFNESS:
            return STIFFNESS[number]
        assert self.pose is not None
        return float(self.pose[[18, 19, 20, 21, 22, 42].index(number)])

    def pose_inv(self, pose: list[float]) -> list[float]:
        turn = Rotation.from_rotvec(pose[3:]).inv()
        return [*-turn.apply(pose[:3]), *turn.as_rotvec()]

    def pose_trans(self, first: list[float], second: list[float]) -> list[float]:
        one, other = (Rotation.from_rotvec(each[3:]) for each in (first, second))
        return [*(np.array(first[:3]) + one.apply(second[:3])), *(one * other).as_rotvec()]

    def get_inverse_kin(self, pose: list[float]) -> list[float]:
        return pose

    def servoj(self, led: list[float], **_: float) -> None:
        self.led.append(np.array(led))
        if len(self.led) == self.steps:
            raise Stopped


class Poses:
    """What `p[...]` makes."""

    def __getitem__(self, numbers: tuple[float, ...]) -> list[float]:
        return list(numbers)


def run(controller: Controller) -> Array:
    """Where the tool is led to (T, 6), step by step."""
    text = (FOLDER / "ur/impedance.script").read_text(encoding="utf-8")
    text = re.sub(r"^\s*end$", "", text, flags=re.MULTILINE).replace("local ", "")
    names = re.findall(r"\b([a-z_]+)\(", text)
    functions = {name: getattr(controller, name) for name in names if hasattr(controller, name)}
    with pytest.raises(Stopped):
        exec(text, {"p": Poses(), **functions})
    return np.array(controller.led)


def test_it_holds_the_arm_until_a_command_comes() -> None:
    led = run(Controller(np.full(3, 9.0), np.full(3, 0.2), None, 50))
    assert np.abs(led - Controller(np.zeros(3), np.zeros(3), None, 1).get_actual_tcp_pose()).max() < 1e-12


def test_it_is_a_spring_along_and_about_the_axes_of_the_tool() -> None:
    pose = np.array([0.5, -0.1, 0.2, 2.9, 0.3, -0.4])
    turn = Rotation.from_rotvec(pose[3:])
    force, torque = np.array([3.0, -2.0, 6.0]), np.array([0.05, -0.1, 0.02])  # in the tool's axes
    led = run(Controller(turn.apply(force), turn.apply(torque), pose, 3000))
    last = Rotation.from_rotvec(led[-1, 3:])
    np.testing.assert_allclose(turn.inv().apply(led[-1, :3] - pose[:3]), force / [800, 800, 1500], atol=1e-6)
    np.testing.assert_allclose((turn.inv() * last).as_rotvec(), torque / 5.0, atol=1e-6)


def test_it_yields_no_farther_than_its_limits() -> None:
    pose = np.array([0.5, -0.1, 0.2, 3.1, 0.0, 0.0])
    led = run(Controller(np.array([500.0, -500.0, 500.0]), np.array([5.0, 5.0, -5.0]), pose, 3000))
    turn = Rotation.from_rotvec(pose[3:]).inv()
    np.testing.assert_allclose(np.abs(turn.apply(led[-1, :3] - pose[:3])), 0.02, rtol=1e-3)
    assert np.abs((turn * Rotation.from_rotvec(led[-1, 3:])).as_rotvec()).max() == pytest.approx(
        0.1, rel=1e-3
    )

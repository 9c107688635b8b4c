"""The example of Franka arms: its calls are pylibfranka's, and it runs against a simulated arm with them."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from bcppl.models.worlds import bench_scene
from tests.robot.robot_examples import FOLDER, importable, live_belief, touches_once

try:
    import pylibfranka as library  # before a stand-in of its name is on the path
except ImportError:
    library = None

installed = pytest.mark.skipif(
    library is None, reason="pylibfranka is not installed: pip install pylibfranka"
)
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="examples/ stands in a checkout only")
STAND_IN = FOLDER / "franka/stand_in"
SEED = 31000
# What the example calls, by class.
CALLED = {
    "Robot": (
        "__init__",
        "read_once",
        "set_collision_behavior",
        "set_K",
        "set_cartesian_impedance",
        "start_cartesian_pose_control",
        "stop",
    ),
    "ActiveControlBase": ("readOnce", "writeOnce"),
    "CartesianPose": ("__init__",),
}
READ = "O_T_EE", "O_T_EE_c", "O_F_ext_hat_K", "time"


@pytest.fixture
def stand_in() -> Iterator[Any]:
    with importable(STAND_IN):
        yield importlib.import_module("pylibfranka")


@installed
def test_the_stand_in_has_the_signatures_of_pylibfranka(stand_in: Any) -> None:
    for owner, names in CALLED.items():
        for name in names:
            called = inspect.signature(getattr(getattr(stand_in, owner), name))
            documented = getattr(getattr(library, owner), name).__doc__
            assert list(called.parameters) in _parameters(documented), f"{owner}.{name}"
    for name in READ:
        assert hasattr(library.RobotState, name)
    assert hasattr(library.Duration, "to_sec")
    for name in ("ControllerMode", "RealtimeConfig"):
        for member in getattr(stand_in, name):
            assert member.name in getattr(library, name).__members__
    for name in ("FrankaException", "ControlException", "CommandException"):  # one is no base of the others
        assert getattr(library, name).__mro__[1] is getattr(stand_in, name).__mro__[1]


@installed
def test_a_matrix_goes_through_the_library_column_by_column(stand_in: Any) -> None:
    matrices = importlib.import_module("franka.matrices")
    pose = np.array([0.1, -0.2, 0.3, 0.8, 0.0, 0.6, 0.0])
    matrix = matrices.matrix_of(pose)
    assert matrix[12:] == [0.1, -0.2, 0.3, 1.0]
    np.testing.assert_allclose(matrices.pose_of(matrix), pose, atol=1e-12)
    assert list(library.CartesianPose(matrix).O_T_EE) == matrix


def test_a_smoothed_command_stays_within_the_limits_and_arrives(stand_in: Any) -> None:
    arm = importlib.import_module("franka.arm")
    smoothed = arm.Smoothed(np.array([0.0, 0, 0, 1, 0, 0, 0]))
    far = np.array([0.05, 0, 0, -np.cos(0.05), 0, 0, -np.sin(0.05)])  # and the other sign of its quaternion
    there_and_back = [far] * 150 + [smoothed.stages[0].copy()] * 150 + [far] * 600
    path = np.array([smoothed.next(each).copy() for each in there_and_back])
    for order, most in enumerate(stand_in.FASTEST, 1):
        assert np.linalg.norm(np.diff(path[:, :3], order, axis=0), axis=1).max() < most * 1e-3**order
    np.testing.assert_allclose(path[-1], far * [1, 1, 1, -1, -1, -1, -1], atol=1e-5)


def test_a_step_of_the_command_is_refused_and_ends_the_reading(stand_in: Any) -> None:
    robot = stand_in.Robot(str(SEED))
    robot.set_cartesian_impedance([2000.0] * 3 + [100.0] * 3)
    control = robot.start_cartesian_pose_control(stand_in.ControllerMode.CartesianImpedance)
    with pytest.raises(stand_in.CommandException, match="current mode"):
        robot.set_cartesian_impedance([1000.0] * 3 + [100.0] * 3)
    matrix = control.readOnce()[0].O_T_EE_c
    control.writeOnce(stand_in.CartesianPose(matrix))
    matrix[14] -= 0.001
    with pytest.raises(stand_in.ControlException, match=r"acceleration|jerk"):
        control.writeOnce(stand_in.CartesianPose(matrix))


@pytest.mark.long
def test_a_view_and_a_guarded_descent_through_the_simulated_arm(stand_in: Any) -> None:
    program, module = (importlib.import_module(each) for each in ("touch_and_insert", "franka.arm"))
    module.SILENT = 60.0  # s: the machine of a test may be busy
    arm = module.FrankaArm(str(SEED), patience=0.5)
    scene = bench_scene(SEED)
    try:
        with live_belief(scene) as live:
            touches_once(program, arm, live, scene)
        # Another stiffness is taken up at rest.
        here = arm.read()[-1].world_from_peg
        for _ in range(100):
            arm.command(here, np.array([500.0] * 3 + [50.0] * 3))
            reading = arm.read()[-1]
        np.testing.assert_allclose(reading.world_from_peg[:3], here[:3], atol=2e-4)
        # What the arm refuses is stated.
        with pytest.raises(TimeoutError, match="Cartesian Impedance command rejected"):
            for _ in range(200):
                arm.command(here, np.array([5000.0] * 3 + [50.0] * 3))
                arm.read()
    finally:
        arm.close()


def _parameters(documented: str) -> list[list[str]]:
    """The names of the parameters, for each overload that a docstring of pybind11 lists."""
    lines = re.findall(r"^(?:\d+\. )?\w+\((self: .*)\) -> ", documented, re.MULTILINE)
    return [re.findall(r"(?:^|, )(\w+): ", line) for line in lines]

"""A simulated arm with the names and signatures of pylibfranka 0.21 that `franka.arm` calls.

    PYTHONPATH=franka/stand_in python -m touch_and_insert look.h5 --robot franka --host 31000

In place of an address, the arm takes the seed of its bench. As the arm does, it refuses a command whose
velocity, acceleration or jerk is too large, and another impedance while it moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from types import SimpleNamespace

import numpy as np
from franka.matrices import matrix_of, pose_of
from scipy.spatial.transform import Rotation
from simulated_arm import Clock, SimulatedArm

from bcppl.models.worlds import bench_scene

TICK = 0.001  # s
# Of a commanded translation, m/s, m/s^2 and m/s^3: libfranka's rate_limiting.h for the Research 3.
FASTEST = 3.0, 9.0, 4500.0


class ControllerMode(Enum):
    """What follows a motion."""

    JointImpedance = 0
    CartesianImpedance = 1


class RealtimeConfig(Enum):
    """Whether real-time priorities are required."""

    kEnforce = 0
    kIgnore = 1


class FrankaException(Exception):
    """What the library raises where it has no other; as in the library, no base of the others."""


class ControlException(RuntimeError):
    """A motion is refused."""


class CommandException(RuntimeError):
    """A command is refused."""


class CartesianPose:
    """A commanded pose: 16 numbers, column by column."""

    def __init__(self, arg0: Sequence[float], /) -> None:
        if len(arg0) != 16:
            raise TypeError("a pose has 16 numbers")
        self.O_T_EE, self.motion_finished = list(arg0), False


class ActiveControlBase:
    """A motion."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._path = robot, np.tile(robot.commanded[:3], (4, 1))

    def readOnce(self) -> tuple[SimpleNamespace, SimpleNamespace]:
        """The state one millisecond later, and how long it took."""
        return self._robot.read_once(), SimpleNamespace(to_sec=lambda: TICK)

    def writeOnce(self, arg0: CartesianPose, /) -> None:
        """Follow a pose.

        Raises:
            ControlException: it is too far from the ones before it.
        """
        pose = pose_of(arg0.O_T_EE)
        self._path = np.vstack([self._path[1:], pose[:3]])
        for order, most in enumerate(FASTEST, 1):
            change = np.linalg.norm(np.diff(self._path, order, axis=0)[-1]) / TICK**order
            if change > most:
                self._robot.stop()
                names = ("velocity", "acceleration", "jerk")
                raise ControlException(f"cartesian {names[order - 1]} of {change:.1f} exceeds {most:g}")
        self._robot.follow(pose)
        if arg0.motion_finished:
            self._robot.stop()


class Robot:
    """The arm.

    Args:
        robot_ip_address: the seed of its bench.
        realtime_config: not regarded.
    """

    def __init__(
        self, robot_ip_address: str, realtime_config: RealtimeConfig = RealtimeConfig.kEnforce
    ) -> None:
        self._arm = SimulatedArm(bench_scene(int(robot_ip_address)), TICK)
        self._clock, self._ticks, self._moves = Clock("clock"), 0, False
        self._stiffness = np.full(6, 2000.0)
        self.commanded = self._arm.advance()[0]

    def read_once(self) -> SimpleNamespace:
        """The state one millisecond later."""
        pose, wrench = self._arm.advance()
        self._ticks += 1
        self._clock.wait(self._ticks * TICK)
        out = Rotation.from_quat(pose[[4, 5, 6, 3]])
        stamp = self._ticks * TICK
        return SimpleNamespace(
            O_T_EE=matrix_of(pose),
            O_T_EE_c=matrix_of(self.commanded),
            O_F_ext_hat_K=[*out.apply(-wrench[:3]), *out.apply(-wrench[3:])],
            time=SimpleNamespace(to_sec=lambda: stamp),
        )

    def set_collision_behavior(
        self,
        lower_torque_thresholds: Sequence[float],
        upper_torque_thresholds: Sequence[float],
        lower_force_thresholds: Sequence[float],
        upper_force_thresholds: Sequence[float],
    ) -> None:
        """Take note of thresholds."""
        given = lower_torque_thresholds, upper_torque_thresholds, lower_force_thresholds
        if [len(each) for each in (*given, upper_force_thresholds)] != [7, 7, 6, 6]:
            raise TypeError("there are thresholds of 7, 7, 6 and 6 numbers")

    def set_K(self, arg0: Sequence[float], /) -> None:
        """The stiffness frame, which is the end effector's here."""
        if not np.array_equal(np.reshape(arg0, (4, 4)), np.eye(4)):
            raise CommandException("Set K command rejected: the simulated arm has none of its own")

    def set_cartesian_impedance(self, arg0: Sequence[float], /) -> None:
        """The stiffness, at rest.

        Raises:
            CommandException: it is out of the arm's range, or the arm moves.
        """
        if self._moves:
            raise CommandException(
                "Set Cartesian Impedance command rejected: command not possible in the current mode!"
            )
        stiffness = np.array(arg0)
        if not (
            10.0 <= stiffness[:3].min() <= stiffness[:3].max() <= 3000.0 and stiffness[3:].max() <= 300.0
        ):
            raise CommandException("Set Cartesian Impedance command rejected: invalid argument!")
        self._stiffness = stiffness

    def start_cartesian_pose_control(self, arg0: ControllerMode, /) -> ActiveControlBase:
        """A motion by poses."""
        if arg0 is not ControllerMode.CartesianImpedance:
            raise CommandException("Move command rejected: the simulated arm is on a spring")
        self._moves = True
        return ActiveControlBase(self)

    def follow(self, pose: np.ndarray) -> None:
        """Command a pose (7,)."""
        self.commanded = pose
        self._arm.command(pose, self._stiffness)

    def stop(self) -> None:
        """End the motion."""
        self._moves = False

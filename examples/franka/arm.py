"""A Franka arm by pylibfranka: its sensors, and commands for its own Cartesian impedance.

The end effector's frame EE is set to the peg's (in Desk, or by `Robot.set_EE`), so that the pose O_T_EE is
`world_from_peg` with the base as the world. The arm takes a pose every millisecond, with bounded velocity,
acceleration and jerk, and stops where one is late: a process of its own commands it, and smooths.
"""

from __future__ import annotations

import multiprocessing
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import pylibfranka
from franka.matrices import matrix_of, pose_of
from readings import Reading
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array

EVERY = 4  # ms from one reading to the next
KEPT = 2048  # readings: 8 s
SILENT = 2.0  # s without a reading, after which the arm is taken to have stopped
FASTEST, QUICKEST = 0.25, 0.6  # m/s and rad/s of a command
LAG = 0.016  # s of one of the three stages of a smoothed command: a reversal stays below 9 m/s^2
SETTLED = 200  # ms of standing still before the impedance is changed
TORQUES = [40.0] * 7, [60.0] * 7  # N m, of contact and of collision, by joint
FORCES = [60.0] * 3 + [20.0] * 3, [90.0] * 3 + [30.0] * 3  # N, N m; `execute` aborts a plan before
IDENTITY = np.eye(4).ravel().tolist()


class FrankaArm:
    """A connection to the arm (`readings.Arm`).

    Args:
        host: of the arm.
        realtime: whether a kernel with real-time priorities is required.
        patience: s that the next millisecond waits for a command; 0 for an arm whose clock waits for nobody.
    """

    ahead = 3 * LAG + 0.001 * EVERY
    settles = 0.001 * SETTLED + 0.1  # and until it follows again

    def __init__(self, host: str, realtime: bool = True, patience: float = 0.0) -> None:
        context = multiprocessing.get_context("spawn")
        self._rows, self._count = context.RawArray("d", 14 * KEPT), context.RawValue("q", 0)
        self._pipe, other = context.Pipe()
        arguments = (host, realtime, patience, other, self._rows, self._count)
        self._process = context.Process(target=_follow, args=arguments, daemon=True)
        self._process.start()
        other.close()
        self._taken, self._silent = 0, 120.0  # s until the first reading: a connection takes longer

    def read(self) -> list[Reading]:
        """The readings since the last call, the newest ones if they are many; waits for one.

        Raises:
            TimeoutError: the arm sends none.
        """
        begun = time.monotonic()
        while (count := self._count.value) == self._taken:
            if self._pipe.poll():
                raise TimeoutError(f"the arm has stopped ({self._refusal()}); see Desk.")
            if time.monotonic() - begun > self._silent:
                raise TimeoutError("the arm sends no more states; see Desk.")
            time.sleep(0.0002)
        numbers = range(max(self._taken, count - KEPT // 2), count)
        rows = np.frombuffer(self._rows).reshape(KEPT, 14)[[k % KEPT for k in numbers]]
        self._taken, self._silent = count, SILENT
        return [Reading(float(row[0]), row[1:7], float(row[0]), row[7:]) for row in rows]

    def command(self, world_from_peg: Array, stiffness: Array) -> None:
        """Follow a pose (7,) by a spring of stiffness (6,): N/m along, N m/rad about the peg's axes.

        Another stiffness is taken up at rest: the arm refuses one while it moves.
        """
        self._pipe.send((np.asarray(world_from_peg), np.asarray(stiffness)))

    def close(self) -> None:
        """End the motion and the connection."""
        self._pipe.close()
        self._process.join(5.0)
        self._process.terminate()

    def _refusal(self) -> str:
        try:
            return str(self._pipe.recv())
        except EOFError:
            return "its process has ended"


class Smoothed:
    """A pose that follows others with bounded velocity, acceleration and jerk.

    The first row moves towards a target at a bounded speed; each other follows the one before it by a
    low-pass filter of the first order. All are poses (7,).
    """

    def __init__(self, pose: Array) -> None:
        self.stages = np.tile(pose, (4, 1))

    def next(self, target: Array) -> Array:
        """The pose one millisecond later."""
        aligned = np.concatenate([target[:3], np.copysign(1.0, target[3:] @ self.stages[0, 3:]) * target[3:]])
        move = aligned - self.stages[0]
        # A quaternion changes by half of the angle.
        shift, turn = float(np.linalg.norm(move[:3])), 2.0 * float(np.linalg.norm(move[3:]))
        most = max(shift / FASTEST, turn / QUICKEST, 1e-3)  # s
        self.stages[0] += 1e-3 / most * move
        for k in (1, 2, 3):
            self.stages[k] += 1e-3 / LAG * (self.stages[k - 1] - self.stages[k])
        self.stages[:, 3:] /= np.linalg.norm(self.stages[:, 3:], axis=1, keepdims=True)
        return self.stages[3]


def row_of(state: Any) -> Array:
    """Stamp, wrench and pose (14,) of an arm's state.

    O_F_ext_hat_K is of the peg on its environment, in the base's axes about the stiffness frame's origin.
    """
    pose = pose_of(state.O_T_EE)
    into = Rotation.from_quat(pose[[4, 5, 6, 3]]).inv()
    wrench = -into.apply(np.reshape(state.O_F_ext_hat_K, (2, 3))).ravel()
    return np.concatenate([[state.time.to_sec()], wrench, pose])


def _follow(host: str, realtime: bool, patience: float, pipe: Connection, rows: Any, count: Any) -> None:
    """In the arm's process: follow commands until the connection is closed."""
    try:
        enforce = pylibfranka.RealtimeConfig.kEnforce if realtime else pylibfranka.RealtimeConfig.kIgnore
        robot = pylibfranka.Robot(host, enforce)
        robot.set_collision_behavior(*TORQUES, *FORCES)
        robot.set_K(IDENTITY)  # the spring, and the wrench, are of the peg's frame
        try:
            _control(robot, patience, pipe, np.frombuffer(rows).reshape(KEPT, 14), count)
        except (EOFError, ConnectionError):  # the program has closed the connection, or is no more
            robot.stop()
    except (pylibfranka.FrankaException, RuntimeError, TypeError) as error:  # the others are RuntimeErrors
        pipe.send(str(error))


def _control(robot: Any, patience: float, pipe: Connection, rows: Array, count: Any) -> None:
    control: Any = None
    command: tuple[Array, Array] | None = None
    held, settled, tick = np.zeros(6), 0, 0
    while True:
        state = robot.read_once() if control is None else control.readOnce()[0]
        if tick % EVERY == 0:
            rows[count.value % KEPT] = row_of(state)
            count.value += 1
            # The first of them may be waited for; the newest counts.
            more = pipe.poll(0.0 if command is None else patience)
            while more:
                command, more = pipe.recv(), pipe.poll()
        tick += 1
        if command is None:
            continue
        pose, stiffness = command
        if control is None:
            robot.set_cartesian_impedance(stiffness.tolist())
            control = robot.start_cartesian_pose_control(pylibfranka.ControllerMode.CartesianImpedance)
            smoothed, held, settled = Smoothed(pose_of(state.O_T_EE_c)), stiffness, 0
            continue
        changes = bool((stiffness != held).any())
        settled = settled + 1 if changes else 0
        following = pylibfranka.CartesianPose(
            matrix_of(smoothed.next(smoothed.stages[0] if changes else pose))
        )
        following.motion_finished = settled > SETTLED
        control.writeOnce(following)
        if following.motion_finished:
            control = None

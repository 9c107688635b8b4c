"""A UR e-Series arm by ur_rtde: its sensors, and commands for `impedance.script` on its controller.

The tool's centre point is set to the peg's frame, which has its origin where the peg is held and z towards
the flange: half a turn about x from the usual one. So the pose is `world_from_peg` with the base as the
world. Commands go through the controller's input registers: a target pose, and a stiffness.
"""

from __future__ import annotations

import time

import numpy as np
import rtde_io
import rtde_receive
from readings import Reading
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array

RATE = 500.0  # packages a second
READ = ["timestamp", "actual_TCP_pose", "actual_TCP_force"]
POSE = ((0, 18), (0, 19), (0, 20), (0, 21), (0, 22), (1, 42))  # (interface, register) of x y z rx ry rz
SPRINGS = (43, 44, 45)  # across the peg, along it (N/m), about any axis (N m/rad)
NUMBER = 18  # an integer register: the number of the newest command, written last
SILENT = 1.0  # s without a package, after which the arm is taken to have stopped


class URArm:
    """A connection to the arm (`readings.Arm`)."""

    ahead, settles = 0.008, 0.0  # s

    def __init__(self, host: str) -> None:
        self._receive = rtde_receive.RTDEReceiveInterface(host, RATE, READ)
        lower = rtde_io.RTDEIOInterface(host)
        self._io = (lower, rtde_io.RTDEIOInterface(host, use_upper_range_registers=True))
        self._number, self._newest = 0, -1.0

    def read(self) -> list[Reading]:
        """The newest reading; waits for the next one.

        Raises:
            TimeoutError: the controller sends none.
        """
        begun = time.monotonic()
        while (stamp := self._receive.getTimestamp()) == self._newest:
            if time.monotonic() - begun > SILENT:
                raise TimeoutError("the arm sends no more packages; see its teach pendant.")
            time.sleep(0.0002)
        self._newest = stamp
        place = np.array(self._receive.getActualTCPPose())
        turn = Rotation.from_rotvec(place[3:])
        # In the base's axes, about the tool's centre.
        force, torque = np.array(self._receive.getActualTCPForce()).reshape(2, 3)
        wrench = np.concatenate([turn.inv().apply(force), turn.inv().apply(torque)])
        pose = np.concatenate([place[:3], turn.as_quat()[[3, 0, 1, 2]]])
        return [Reading(stamp, wrench, stamp, pose)]

    def command(self, world_from_peg: Array, stiffness: Array) -> None:
        """Follow a pose (7,) by a spring of stiffness (6,): N/m along, N m/rad about the peg's axes."""
        turn = Rotation.from_quat(np.asarray(world_from_peg)[[4, 5, 6, 3]]).as_rotvec()
        for (which, register), value in zip(POSE, [*world_from_peg[:3], *turn], strict=True):
            self._io[which].setInputDoubleRegister(register, float(value))
        for register, value in zip(SPRINGS, (stiffness[0], stiffness[2], stiffness[3]), strict=True):
            self._io[1].setInputDoubleRegister(register, float(value))
        self._number += 1
        self._io[0].setInputIntRegister(NUMBER, self._number)

    def close(self) -> None:
        """End the connection; the program on the controller then holds the arm."""
        for each in (self._receive, *self._io):
            each.disconnect()

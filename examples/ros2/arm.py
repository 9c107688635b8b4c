"""An arm under ROS 2 that a Cartesian impedance controller moves: its sensors, and commands for it.

Topics and types are those of crisp_controllers 2.3 (`cartesian_controller.cpp`, `pose_broadcaster.cpp`):
"target_pose", a PoseStamped, and "target_stiffness", a Float64MultiArray of six numbers, which the controller
takes with `variable_stiffness.enabled`; "current_pose", a PoseStamped. The controller's end effector frame is
the peg's, its base frame the world, and its Jacobian is local. Other controllers take the same by another
name of the topics: `--ros-args -r target_pose:=...`.
"""

from __future__ import annotations

import queue

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from readings import Reading
from ros2.messages import header, pose_message, pose_of, seconds
from std_msgs.msg import Float64MultiArray

from bcppl.arrays import Array
from bcppl.contact.sensing.load import transform_wrench

KEPT = 4000  # readings
SILENT = 2.0  # s without a message, after which the arm is taken to have stopped
UNMOVED = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class ROSArm:
    """The arm (`readings.Arm`), as a node sees it; the node is spun in another thread.

    Args:
        node: that subscribes and publishes.
        peg_from_sensor: (7,) pose of the wrist sensor, whose wrench is that of the environment on the peg.
    """

    ahead, settles = 0.01, 0.0  # s

    def __init__(self, node: Node, peg_from_sensor: tuple[float, ...] | Array = UNMOVED) -> None:
        self._mounting = np.array(peg_from_sensor)
        self._readings: queue.Queue[Reading] = queue.Queue(KEPT)
        self._posed: tuple[float, Array] | None = None
        self._frame, self._stiffness = "", np.zeros(6)
        self._target = node.create_publisher(PoseStamped, "target_pose", 1)
        self._spring = node.create_publisher(Float64MultiArray, "target_stiffness", 1)
        node.create_subscription(WrenchStamped, "wrench", self._felt, qos_profile_sensor_data)
        node.create_subscription(PoseStamped, "current_pose", self._moved, qos_profile_sensor_data)

    def read(self) -> list[Reading]:
        """The readings since the last call, one for each wrench; waits for one.

        Raises:
            TimeoutError: a topic is silent.
        """
        try:
            readings = [self._readings.get(timeout=SILENT)]
        except queue.Empty:
            silent = "current_pose" if self._posed is None else "wrench"
            raise TimeoutError(f"nothing comes on {silent}; see `ros2 topic hz {silent}`.") from None
        while not self._readings.empty():
            readings.append(self._readings.get_nowait())
        return readings

    def command(self, world_from_peg: Array, stiffness: Array) -> None:
        """Follow a pose (7,) by a spring of stiffness (6,): N/m along, N m/rad about the peg's axes."""
        if not np.array_equal(stiffness, self._stiffness):
            self._stiffness = np.array(stiffness)
            self._spring.publish(Float64MultiArray(data=self._stiffness.tolist()))
        assert self._posed is not None  # a command follows a reading
        stamped = header(self._posed[0], self._frame)
        self._target.publish(PoseStamped(header=stamped, pose=pose_message(world_from_peg)))

    def close(self) -> None:
        """Leave the arm to its controller, which holds it."""

    def _moved(self, message: PoseStamped) -> None:
        self._frame = message.header.frame_id
        self._posed = seconds(message.header.stamp), pose_of(message.pose)

    def _felt(self, message: WrenchStamped) -> None:
        if self._posed is None:
            return
        force, torque = message.wrench.force, message.wrench.torque
        felt = np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])
        if self._readings.full():  # nobody reads: the newest count
            self._readings.get_nowait()
        stamp = seconds(message.header.stamp)
        self._readings.put_nowait(Reading(stamp, transform_wrench(felt, self._mounting), *self._posed))

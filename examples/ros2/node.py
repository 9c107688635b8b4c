"""A ROS 2 node that looks, touches and inserts, and publishes what it believes.

    python -m ros2.node look.h5 --camera camera_optical_frame 0.47 0.32 0.64 0.1 0.9 0.4 0.1

subscribes to "wrench", "current_pose", "depth" and "camera_info", commands "target_pose" and
"target_stiffness", and publishes "belief" (PoseWithCovarianceStamped, of the part) and "next_probe" (Path).
Of `look.h5` it takes part, guess and peg, and the images too unless cameras are given.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovariance, PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from ros2.arm import UNMOVED, ROSArm
from ros2.messages import covariance_of, depth_of, header, path_of, pose_message, view_of
from sensor_msgs.msg import CameraInfo, Image
from touch_and_insert import limits, options, touch_and_insert

import bcppl
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.inference.filters.smc import Step
from bcppl.inference.live import Filter, UpdateInfo
from bcppl.inference.planning.constraints import Constraint
from bcppl.robot.plan import Plan
from bcppl.sensors import Recording
from bcppl.traces import Model


class BeliefNode(Node):
    """A live belief, fed by the callbacks of a node.

    Args:
        model: what explains the measurements.
        recording: part, guess and peg.
        cameras: (7,) pose of each camera's optical frame in the world, by the name of the frame; an image of
            each is taken, and no more: those of a camera that stands still say the same.
        frame: of the poses that are published.
        particles: N.
        peg_from_sensor: (7,) as of `ROSArm`.
        constraints: of the touches that are planned, as of `Filter`.

    Attributes:
        arm: whose messages come to this node.
        live: the belief.
    """

    def __init__(
        self,
        model: Model,
        recording: Recording,
        cameras: Mapping[str, Array],
        frame: str = "world",
        particles: int = 75,
        peg_from_sensor: Sequence[float] = UNMOVED,
        constraints: Sequence[Constraint] = (),
    ) -> None:
        super().__init__("bcppl")
        self._frame, self._cameras = frame, dict(cameras)
        self._infos: dict[str, Any] = {}
        self._wanted = set(cameras)
        self._changed = threading.Condition()
        self._belief = self.create_publisher(PoseWithCovarianceStamped, "belief", 1)
        self._probe = self.create_publisher(Path, "next_probe", 1)
        self.arm = ROSArm(self, tuple(peg_from_sensor))
        self.live = Filter(
            model, recording, particles=particles, on_update=self._updated, constraints=constraints
        )
        self.create_subscription(CameraInfo, "camera_info", self._informed, qos_profile_sensor_data)
        self.create_subscription(Image, "depth", self._seen, qos_profile_sensor_data)

    def look(self, timeout: float = 10.0) -> None:
        """Wait until each camera was seen.

        Raises:
            TimeoutError: no image of one comes in so many seconds.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: not self._wanted, timeout):
                raise TimeoutError(
                    f"no image comes of {', '.join(sorted(self._wanted))}; see depth, camera_info."
                )

    def announce(self, plan: Plan, gain: float) -> None:
        """Publish the next probe, and say what is expected of it (nats)."""
        self.get_logger().info(f"{plan.name}: {gain:.2f} nats expected")
        self._probe.publish(Path(header=header(self._now, self._frame), poses=path_of(plan, self._frame)))

    @property
    def _now(self) -> float:
        return 1e-9 * float(self.get_clock().now().nanoseconds)

    def _updated(self, step: Step, _: UpdateInfo) -> None:
        mean = pose_message(step.belief.mean.numpy())
        pose = PoseWithCovariance(pose=mean, covariance=covariance_of(step.belief))
        self._belief.publish(PoseWithCovarianceStamped(header=header(self._now, self._frame), pose=pose))

    def _informed(self, message: CameraInfo) -> None:
        self._infos[message.header.frame_id] = message

    def _seen(self, message: Image) -> None:
        name = message.header.frame_id
        if name not in self._wanted or name not in self._infos:
            return
        try:
            view = view_of(self._infos[name], self._cameras[name])
            self.live.observe(view, depth_of(message, view))
        except InputError as error:
            self.get_logger().error(str(error))
            return
        with self._changed:
            self._wanted.remove(name)
            self._changed.notify_all()


def spun(node: Node) -> SingleThreadedExecutor:
    """The executor that calls a node's callbacks, in a thread of its own, until it is shut down."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    return executor


def main() -> None:
    """Look, touch, and insert."""
    parser = options(__doc__)
    parser.add_argument(
        "--camera",
        nargs=8,
        action="append",
        default=[],
        metavar=("FRAME", "X", "Y", "Z", "QW", "QX", "QY", "QZ"),
        help="a camera that stands still, and the pose of its optical frame",
    )
    parser.add_argument(
        "--peg-from-sensor",
        nargs=7,
        type=float,
        default=UNMOVED,
        metavar=("X", "Y", "Z", "QW", "QX", "QY", "QZ"),
        help="of a wrist sensor that reads in its own axes: its pose in the peg's frame",
    )
    rclpy.init(args=sys.argv)
    arguments = parser.parse_args(rclpy.utilities.remove_ros_args(sys.argv)[1:])
    recording = bcppl.load(arguments.look)
    cameras = {name: np.array([float(each) for each in pose]) for name, *pose in arguments.camera}
    if cameras:
        recording = replace(recording, measurements=[])
    model = bcppl.models.look_and_touch.model.with_settings(profile=arguments.profile)
    node = BeliefNode(
        model,
        recording,
        cameras,
        peg_from_sensor=arguments.peg_from_sensor,
        constraints=limits(recording, arguments.table),
    )
    executor = spun(node)
    with node.live:
        node.look()
        touch_and_insert(node.arm, node.live, arguments.probes, node.announce)
    executor.shutdown()
    rclpy.shutdown()


if __name__ == "__main__":
    main()

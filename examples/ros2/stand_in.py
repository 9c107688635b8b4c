"""A node that stands for an arm, its Cartesian impedance controller and its depth cameras.

    python -m ros2.stand_in --seed 31000 --look look.h5

`--pace client` moves the clock on with each command, so that a slow machine loses nothing.
"""

from __future__ import annotations

import array
import threading

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.node import Node
from ros2.messages import header, pose_message, pose_of
from sensor_msgs.msg import CameraInfo, Image
from simulated_arm import Clock, Pace, SimulatedArm, options
from std_msgs.msg import Float64MultiArray

from bcppl import save
from bcppl.models.worlds import bench_scene
from bcppl.models.worlds.bench.scene import BenchScene

TICK = 0.004  # s
BASE = "world"


class SimulatedController(Node):
    """Publishes what the arm and the cameras of a scene read, and follows commands."""

    def __init__(self, scene: BenchScene, pace: Pace) -> None:
        super().__init__("arm")
        self.arm, self.clock = SimulatedArm(scene, TICK), Clock(pace)
        self.running, self._stiffness = True, np.full(6, 1000.0)
        self._look = scene.look()
        self._pose = self.create_publisher(PoseStamped, "current_pose", 10)
        self._wrench = self.create_publisher(WrenchStamped, "wrench", 10)
        self._depth = self.create_publisher(Image, "depth", 10)
        self._info = self.create_publisher(CameraInfo, "camera_info", 10)
        self.create_subscription(Float64MultiArray, "target_stiffness", self._stiffen, 1)
        self.create_subscription(PoseStamped, "target_pose", self._follow, 1)
        self.create_timer(1.0, self._show)

    def run(self) -> None:
        """Move the clock on until `running` is false."""
        stamp = 0.0
        while self.running:
            pose, wrench = self.arm.advance()
            stamp += TICK
            self._pose.publish(PoseStamped(header=header(stamp, BASE), pose=pose_message(pose)))
            felt = WrenchStamped(header=header(stamp, "peg"))
            force, torque = felt.wrench.force, felt.wrench.torque
            force.x, force.y, force.z, torque.x, torque.y, torque.z = (float(each) for each in wrench)
            self._wrench.publish(felt)
            self.clock.wait(stamp)

    def _stiffen(self, message: Float64MultiArray) -> None:
        self._stiffness = np.array(message.data)

    def _follow(self, message: PoseStamped) -> None:
        self.arm.command(pose_of(message.pose), self._stiffness)
        self.clock.command()

    def _show(self) -> None:
        for measurement in self._look.measurements:
            camera, depth = measurement.action.camera, measurement.observation.depth
            at = header(0.0, camera.name)
            k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
            size = {"height": camera.height, "width": camera.width}
            self._info.publish(CameraInfo(header=at, distortion_model="plumb_bob", k=k, **size))
            data = array.array("B", np.nan_to_num(depth).astype("<f4").tobytes())
            row = 4 * camera.width
            self._depth.publish(Image(header=at, encoding="32FC1", step=row, data=data, **size))


def main() -> None:
    """Publish until interrupted."""
    parser = options(__doc__)
    parser.add_argument("--pace", choices=["clock", "client"], default="clock")
    arguments = parser.parse_args()
    scene = bench_scene(arguments.seed)
    save(scene.look(), arguments.look)
    rclpy.init()
    node = SimulatedController(scene, arguments.pace)
    threading.Thread(target=node.run, daemon=True).start()
    print(f"the cameras' view is in {arguments.look}", flush=True)
    rclpy.spin(node)


if __name__ == "__main__":
    main()

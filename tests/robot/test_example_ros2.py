"""The example for ROS 2: its calls are rclpy's, and it runs with it, or with the part of it that it calls."""

from __future__ import annotations

import importlib
import inspect
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bcppl.errors import InputError
from bcppl.models.look_and_touch import model
from bcppl.models.worlds import bench_scene
from tests.robot import in_process_ros
from tests.robot.robot_examples import FOLDER, descent, importable, touches_once

try:
    import rclpy
except ImportError:
    rclpy = None

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="examples/ stands in a checkout only")
SEED = 31000
ABSENT = (
    "rclpy is not installed: pip install 'ros-rclpy[fastrtps]' ros-sensor-msgs ros-nav-msgs, or ROS 2 itself"
)
# Parameters of what the example calls, in rclpy 9.1.2; those after "*" by keyword, "=" with a default.
SIGNATURES = {
    "init": "* args= context= domain_id= signal_handler_options=",
    "shutdown": "* context= uninstall_handlers=",
    "node.Node": "node_name * context= cli_args= namespace= use_global_arguments= enable_rosout= "
    "rosout_qos_profile= start_parameter_services= parameter_overrides= allow_undeclared_parameters= "
    "automatically_declare_parameters_from_overrides= enable_logger_service=",
    "node.Node.create_publisher": "self msg_type topic qos_profile * callback_group= event_callbacks= "
    "qos_overriding_options= publisher_class=",
    "node.Node.create_subscription": "self msg_type topic callback qos_profile * callback_group= "
    "event_callbacks= qos_overriding_options= raw= content_filter_options=",
    "node.Node.create_timer": "self timer_period_sec callback callback_group= clock= autostart=",
    "node.Node.get_clock": "self",
    "node.Node.get_logger": "self",
    "executors.SingleThreadedExecutor": "* context=",
    "executors.SingleThreadedExecutor.add_node": "self node",
    "executors.SingleThreadedExecutor.spin": "self",
    "executors.SingleThreadedExecutor.shutdown": "self timeout_sec=",
}


@pytest.fixture(params=["in process", "rclpy"])
def ros(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The module rclpy, begun; the examples can be imported with it."""
    if request.param == "rclpy":
        if rclpy is None:
            pytest.skip(ABSENT)
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    else:
        for name, module in in_process_ros.modules().items():
            monkeypatch.setitem(sys.modules, name, module)
    with importable():
        module = importlib.import_module("rclpy")
        module.init(args=[])
        yield module
        module.shutdown()


def test_the_signatures_are_those_of_rclpy(ros: Any) -> None:
    for name in ("rclpy.node", "rclpy.executors"):
        importlib.import_module(name)
    for name, stated in SIGNATURES.items():
        called = ros
        for each in name.split("."):
            called = getattr(called, each)
        assert _written(inspect.signature(called)) == stated, name


def _written(signature: inspect.Signature) -> str:
    words, keyword = [], False
    for each in signature.parameters.values():
        if each.kind is each.KEYWORD_ONLY and not keyword:
            words, keyword = [*words, "*"], True
        words.append(each.name + ("" if each.default is each.empty else "="))
    return " ".join(words)


@pytest.mark.long
def test_views_and_a_guarded_descent_by_topics(ros: Any) -> None:
    node_of, stand_in, program = (
        importlib.import_module(name) for name in ("ros2.node", "ros2.stand_in", "touch_and_insert")
    )
    importlib.import_module("ros2.arm").SILENT = 60.0  # s: the machine of a test may be busy
    scene = bench_scene(SEED)
    look = scene.look()
    cameras = {m.action.camera.name: m.action.camera.world_from_camera for m in look.measurements[:1]}
    arm = stand_in.SimulatedController(scene, "client")
    node = node_of.BeliefNode(model, replace(look, measurements=[]), cameras, particles=20)
    beliefs: list[Any] = []
    probes: list[Any] = []
    pose, path = (importlib.import_module(f"{each}_msgs.msg") for each in ("geometry", "nav"))
    arm.create_subscription(pose.PoseWithCovarianceStamped, "belief", beliefs.append, 10)
    arm.create_subscription(path.Path, "next_probe", probes.append, 10)
    executors = [node_of.spun(each) for each in (node, arm)]
    moving = threading.Thread(target=arm.run)
    moving.start()
    try:
        with node.live as live:
            node.look(timeout=60.0)
            live.settle()
            (view,) = live.recording.measurements
            known = look.measurements[0].observation.depth
            np.testing.assert_allclose(view.observation.depth, known, atol=1e-6)
            assert view.action.camera.optics == look.measurements[0].action.camera.optics
            touches_once(program, node.arm, live, scene)
            node.announce(descent(node.arm.read()[-1].world_from_peg), 1.5)
            end = time.monotonic() + 20.0
            while not (probes and len(beliefs) >= len(live.updates)) and time.monotonic() < end:
                time.sleep(0.01)
            belief = live.belief
        newest = beliefs[-1].pose
        at = newest.pose.position
        np.testing.assert_allclose([at.x, at.y, at.z], belief.mean[:3].numpy(), atol=1e-9)
        covariance = np.reshape(newest.covariance, (6, 6))
        np.testing.assert_allclose(covariance[:3, :3], belief.covariance[:3, :3].numpy(), atol=1e-12)
        assert np.trace(covariance) == pytest.approx(float(belief.covariance.trace()))
        assert [each.header.frame_id for each in probes[0].poses] == ["world"] * 5
    finally:
        arm.running = False
        moving.join()
        for each in executors:
            each.shutdown()


def test_a_camera_that_is_not_calibrated_or_shows_no_depth_is_refused(ros: Any) -> None:
    messages, sensor = (importlib.import_module(name) for name in ("ros2.messages", "sensor_msgs.msg"))
    pose = np.array([0.0, 0, 0, 1, 0, 0, 0])
    info = sensor.CameraInfo(header=messages.header(0.0, "depth_optical"), height=1, width=2)
    with pytest.raises(InputError, match=r"camera 'depth_optical' states no intrinsics.*; calibrate it\.$"):
        messages.view_of(info, pose)
    info.k = [100.0, 0, 1, 0, 100.0, 1, 0, 0, 1]
    view = messages.view_of(info, pose)
    colour = sensor.Image(height=1, width=2, encoding="rgb8", step=6)
    with pytest.raises(InputError, match="encoded as 'rgb8', and depth is 16UC1 or 32FC1"):
        messages.depth_of(colour, view)


def test_a_silent_topic_is_named(ros: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = importlib.import_module("ros2.arm")
    monkeypatch.setattr(arm, "SILENT", 0.01)
    node = importlib.import_module("rclpy.node").Node("alone")
    with pytest.raises(TimeoutError, match="nothing comes on current_pose"):
        arm.ROSArm(node).read()

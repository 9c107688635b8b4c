"""The part of rclpy that `examples/ros2` calls, in one process, and messages by their published definitions.

Signatures are those of rclpy 9.1 (ROS 2 Kilted), which `tests/robot/test_example_ros2.py` compares;
definitions of messages are those that rosbags has of it.
"""

from __future__ import annotations

import copy
import queue
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import field, make_dataclass
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

MESSAGES = {
    "builtin_interfaces": ["Time"],
    "geometry_msgs": [
        "Pose",
        "PoseStamped",
        "PoseWithCovariance",
        "PoseWithCovarianceStamped",
        "WrenchStamped",
    ],
    "nav_msgs": ["Path"],
    "sensor_msgs": ["CameraInfo", "Image"],
    "std_msgs": ["Float64MultiArray", "Header"],
}


def modules() -> dict[str, ModuleType]:
    """Modules by name, which take the place of those of ROS 2; topics are their own."""
    topics: dict[str, list[Subscription]] = defaultdict(list)

    class Node(_Node):
        _topics = topics

    contents: dict[str, dict[str, Any]] = {
        "rclpy": {"init": init, "ok": ok, "shutdown": shutdown},
        "rclpy.node": {"Node": Node},
        "rclpy.executors": {"SingleThreadedExecutor": SingleThreadedExecutor},
        "rclpy.qos": {"qos_profile_sensor_data": 5},
    }
    store, known = get_typestore(Stores.ROS2_KILTED), dict[str, type]()
    for package, names in MESSAGES.items():
        contents[package] = {}
        contents[f"{package}.msg"] = {name: _message(store, f"{package}/msg/{name}", known) for name in names}
    made = {}
    for name, content in contents.items():
        made[name] = ModuleType(name)
        vars(made[name]).update(content)
        if "." in name:
            setattr(made[name.split(".")[0]], name.split(".")[1], made[name])
    return made


def _message(store: Typestore, name: str, known: dict[str, type]) -> type:
    """The class of a message: made by keywords, its fields of the values that ROS 2 begins with."""
    if name not in known:
        fields: list[Any] = []
        for of, (kind, what) in store.fielddefs[name][1]:
            kind = int(kind)
            if kind == 1:  # a number or a string
                base, _ = what
                fields.append((of, Any, field(default=_zero(base))))
            elif kind == 2:
                fields.append((of, Any, field(default_factory=_message(store, what, known))))
            else:
                (_, base), count = what
                zeros = [] if kind == 4 else [_zero(base[0])] * count
                fields.append((of, Any, field(default_factory=lambda zeros=zeros: np.array(zeros))))
        known[name] = make_dataclass(name.rsplit("/", 1)[1], fields, kw_only=True, slots=True)
    return known[name]


def _zero(base: str) -> Any:
    return "" if base == "string" else False if base == "bool" else 0.0 if base.startswith("float") else 0


class Publisher:
    def __init__(self, kind: type, to: list[Subscription]) -> None:
        self._kind, self._to = kind, to

    def publish(self, msg: Any) -> None:
        if not isinstance(msg, self._kind):
            raise TypeError(f"expected {self._kind}, got {type(msg)}")
        for each in self._to:
            each.waiting.put((each.callback, copy.deepcopy(msg)))


class Subscription(SimpleNamespace):
    callback: Callable[[Any], None]
    waiting: queue.Queue[tuple[Callable[[Any], None], Any]]


class _Node:
    _topics: dict[str, list[Subscription]]

    def __init__(
        self,
        node_name: str,
        *,
        context: Any = None,
        cli_args: Any = None,
        namespace: Any = None,
        use_global_arguments: bool = True,
        enable_rosout: bool = True,
        rosout_qos_profile: Any = 1000,
        start_parameter_services: bool = True,
        parameter_overrides: Any = None,
        allow_undeclared_parameters: bool = False,
        automatically_declare_parameters_from_overrides: bool = False,
        enable_logger_service: bool = False,
    ) -> None:
        self.waiting: queue.Queue[tuple[Callable[..., None], Any]] = queue.Queue()
        self.timers: list[list[Any]] = []
        self.logged: list[str] = []

    def create_publisher(
        self,
        msg_type: type,
        topic: str,
        qos_profile: Any,
        *,
        callback_group: Any = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        publisher_class: Any = Publisher,
    ) -> Publisher:
        return Publisher(msg_type, self._topics[topic])

    def create_subscription(
        self,
        msg_type: type,
        topic: str,
        callback: Callable[[Any], None],
        qos_profile: Any,
        *,
        callback_group: Any = None,
        event_callbacks: Any = None,
        qos_overriding_options: Any = None,
        raw: bool = False,
        content_filter_options: Any = None,
    ) -> Subscription:
        made = Subscription(callback=callback, waiting=self.waiting)
        self._topics[topic].append(made)
        return made

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[[], None] | None,
        callback_group: Any = None,
        clock: Any = None,
        autostart: bool = True,
    ) -> None:
        self.timers.append([time.monotonic() + timer_period_sec, timer_period_sec, callback])

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=time.time_ns()))

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.logged.append, error=self.logged.append)

    def destroy_node(self) -> None: ...


class SingleThreadedExecutor:
    def __init__(self, *, context: Any = None) -> None:
        self._nodes: list[Any] = []
        self._spins = True

    def add_node(self, node: Any) -> bool:
        self._nodes.append(node)
        return True

    def spin(self) -> None:
        (node,) = self._nodes
        while self._spins:
            try:
                callback, message = node.waiting.get(timeout=0.05)
                callback(message)
            except queue.Empty:
                pass
            for timer in node.timers:
                if time.monotonic() >= timer[0]:
                    timer[0] += timer[1]
                    timer[2]()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        self._spins = False
        return True


def init(
    *, args: Any = None, context: Any = None, domain_id: Any = None, signal_handler_options: Any = None
) -> None:
    pass


def ok(*, context: Any = None) -> bool:
    return True


def shutdown(*, context: Any = None, uninstall_handlers: bool | None = None) -> None:
    pass

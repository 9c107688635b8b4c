"""The log of `bench_logs` as bags, written with rosbags; nothing here uses the importer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

KINDS = ("ros1", "sqlite3", "mcap")
RECEIVED = 0.02  # s after the header's stamp


class Types:
    """Messages of ROS 1 or ROS 2."""

    def __init__(self, ros1: bool) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))

    def __call__(self, name: str, *values: Any) -> Any:
        return self.store.types[name.replace("/", "/msg/")](*values)

    def header(self, stamp: float, frame: str = "") -> Any:
        nanoseconds = round(stamp * 1e9)
        time = self("builtin_interfaces/Time", *divmod(nanoseconds, 10**9))
        return self("std_msgs/Header", *((0,) if self.ros1 else ()), time, frame)


Row = tuple[float, str, str, Any]  # received, topic, type, message


def messages(folder: Path, types: Types) -> Iterator[Row]:
    """The messages of a log's files: wrenches, poses, transforms, images and intrinsics."""
    vector = lambda *xyz: types("geometry_msgs/Vector3", *map(float, xyz))  # noqa: E731
    for row in np.loadtxt(folder / "wrench.csv", delimiter=",", skiprows=1):
        wrench = types("geometry_msgs/Wrench", vector(*row[1:4]), vector(*(1e-3 * row[4:])))
        stamp = 1e-3 * row[0]
        yield (
            stamp,
            "/wrench",
            "geometry_msgs/WrenchStamped",
            types("geometry_msgs/WrenchStamped", types.header(stamp), wrench),
        )
    rows = np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)
    back = Rotation.from_quat(rows[:, 4:]).apply([0.0, 0.0, 0.1])
    for row, wrist_to_flange in zip(rows, back, strict=True):
        stamp, place = row[0], 1e-3 * row[1:4]
        quaternion = types("geometry_msgs/Quaternion", *row[4:])
        pose = types("geometry_msgs/Pose", types("geometry_msgs/Point", *place), quaternion)
        yield (
            stamp,
            "/pose",
            "geometry_msgs/PoseStamped",
            types("geometry_msgs/PoseStamped", types.header(stamp, "base"), pose),
        )
        # base -> wrist is the pose without its last 0.1 m; wrist -> flange, which is fixed, has them
        wrist = place - wrist_to_flange
        moved = types("geometry_msgs/Transform", vector(*wrist), quaternion)
        each = types("geometry_msgs/TransformStamped", types.header(stamp, "base"), "wrist", moved)
        yield stamp, "/tf", "tf2_msgs/TFMessage", types("tf2_msgs/TFMessage", [each])
    fixed = types(
        "geometry_msgs/Transform", vector(0, 0, 0.1), types("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
    )
    each = types("geometry_msgs/TransformStamped", types.header(0.0, "wrist"), "flange", fixed)
    yield stamp, "/tf_static", "tf2_msgs/TFMessage", types("tf2_msgs/TFMessage", [each])
    yield from images(folder, types, stamp)


def images(folder: Path, types: Types, last: float) -> Iterator[Row]:
    """The depth images, of camera 0 in mm and of camera 1 in metres, in the last seconds."""
    cameras = yaml.safe_load((folder / "bench.yaml").read_text())["cameras"]
    for k, camera in enumerate(cameras.values()):
        depth = np.asarray(Image.open(folder / f"view_{k}.png"))
        encoding, width = ("16UC1", 2) if k == 0 else ("32FC1", 4)
        height, columns = depth.shape
        lens = [float(camera["fx"]), 0.0, camera["cx"], 0.0, camera["fy"], camera["cy"], 0.0, 0.0, 1.0]
        roi = types("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        for shift in (-3.0, -2.0, -1.0):
            seen = depth if shift == -2.0 else np.full_like(depth, 500)
            raw = seen.astype("<u2") if k == 0 else (1e-3 * seen).astype("<f4")
            header = types.header(last + shift)
            yield last + shift, f"/camera_{k}/depth", "sensor_msgs/Image", types(
                "sensor_msgs/Image", header, height, columns, encoding, 0, width * columns,
                raw.view(np.uint8).ravel(),
            )  # fmt: skip
            yield last + shift, f"/camera_{k}/info", "sensor_msgs/CameraInfo", types(
                "sensor_msgs/CameraInfo", header, height, columns, "plumb_bob", np.zeros(5), np.array(lens),
                np.eye(3).ravel(), np.zeros(12), 0, 0, roi,
            )  # fmt: skip


def write(
    path: Path,
    kind: str,
    rows: Callable[[Types], Iterator[Row]],
    prepare: Callable[[Any], None] = lambda writer: None,
) -> Path:
    """A bag of a kind: a file, or a folder; returns the path to import."""
    from rosbags import rosbag1, rosbag2

    types = Types(kind == "ros1")
    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer: Any = rosbag1.Writer(path)
        serialize: Any = types.store.serialize_ros1
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer, serialize = rosbag2.Writer(path, version=9, storage_plugin=plugin), types.store.serialize_cdr
    prepare(writer)
    connections: dict[str, Any] = {}
    with writer:
        for received, topic, name, message in sorted(rows(types), key=lambda row: row[0]):
            name = name.replace("/", "/msg/")
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=types.store)
            stamp = round((received + RECEIVED) * 1e9)
            writer.write(connections[topic], stamp, serialize(message, name))
    return path


def configuration(text: str, last: float) -> str:
    """The configuration of the files with topics in their place."""
    content = yaml.safe_load(text)
    wrench = {name: content["wrench"][name] for name in ("axes", "about", "sign")}
    content["wrench"] = {"topic": "/wrench", **wrench}
    content["pose"] = {"topic": "/pose"}
    for k, camera in enumerate(content["cameras"].values()):
        for name in ("fx", "fy", "cx", "cy", "unit"):
            del camera[name]
        camera.update(topic=f"/camera_{k}/depth", info=f"/camera_{k}/info", images=[{"time": last - 2.01}])
    return yaml.safe_dump(content)

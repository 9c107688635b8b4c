"""What a bag states in two ways is refused: transforms by two ways, intrinsics that change."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bcppl.errors import InputError
from bcppl.recordings.importers.bag.images import Intrinsics
from bcppl.recordings.importers.bag.reading import Bag
from bcppl.recordings.importers.bag.rows import Rows, wrench
from bcppl.recordings.importers.bag.transforms import Transforms
from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields
from tests.recordings.importers import bag_logs

pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'bcppl[bag]'")

Sent = tuple[str, str, str, float]  # topic, parent, child, x


def rows(folder: Path, sent: Callable[[int], list[Sent]]) -> Any:
    """The poses of the flange in the base, of what is sent at each of 20 times."""

    def messages(types: bag_logs.Types) -> Iterator[bag_logs.Row]:
        still = types("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
        for k in range(20):
            for topic, parent, child, x in sent(k):
                moved = types("geometry_msgs/Transform", types("geometry_msgs/Vector3", x, 0.0, 0.0), still)
                header = types.header(10.0 + 0.01 * k, parent)
                each = types("geometry_msgs/TransformStamped", header, child, moved)
                yield 10.0 + 0.01 * k, topic, "tf2_msgs/TFMessage", types("tf2_msgs/TFMessage", [each])

    moving = Transforms("pose", "/tf", "base", "flange")
    with Bag(bag_logs.write(folder / "tf", "mcap", messages)) as bag:
        for message in bag.messages(list(bag.topics)):
            (moving.fixed if message.topic == "/tf_static" else moving).add(bag, message)
    return moving.rows()[0]


def chain(k: int) -> list[Sent]:
    static = [("/tf_static", "wrist", "flange", 0.1)] if k in (0, 10) else []
    return [("/tf", "base", "wrist", 0.01 * k), *static, ("/tf", "base", "table", 0.3)]


def test_a_static_transform_that_is_sent_again_is_one(tmp_path: Path) -> None:
    assert rows(tmp_path, chain)[:, 1] == pytest.approx(0.1 + 0.01 * np.arange(20))


def test_a_static_transform_that_changes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="static transform from 'wrist' to 'flange' has other numbers later"):
        rows(tmp_path, lambda k: [*chain(k), *([("/tf_static", "wrist", "flange", 0.3)] if k == 15 else [])])


def test_two_ways_between_frames_are_refused(tmp_path: Path) -> None:
    words = "two ways from 'base' to 'flange', directly and by 'wrist'; filter the bag"
    with pytest.raises(InputError, match=words):
        rows(tmp_path, lambda k: [*chain(k), ("/tf", "base", "flange", 1.0 + 0.01 * k)])


def intrinsics(
    folder: Path, topic: str, focal: Callable[[int], float], projected: float = 0.0
) -> CameraFields:
    """Those of a camera with 20 messages of its information."""

    def messages(types: bag_logs.Types) -> Iterator[bag_logs.Row]:
        roi = types("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        for k in range(20):
            lens, lens_of_rectified = np.zeros(9), np.zeros(12)
            lens[[0, 4, 2, 5]] = focal(k), focal(k), 80.0, 60.0
            lens_of_rectified[[0, 5, 2, 6]] = projected, projected, 79.5, 59.5
            yield 0.1 * k, "/info", "sensor_msgs/CameraInfo", types(
                "sensor_msgs/CameraInfo", types.header(10.0 + 0.1 * k), 120, 160, "plumb_bob",
                np.array([-0.3, 0.1, 0.0, 0.0, 0.0]), lens, np.eye(3).ravel(), lens_of_rectified, 0, 0, roi,
            )  # fmt: skip

    content = {
        "topic": topic,
        "info": "/info",
        "every": 1.0,
        "near": 0.1,
        "far": 2.0,
        "world_from_camera": {},
    }
    stated = Intrinsics()
    with Bag(bag_logs.write(folder / "camera", "ros1", messages)) as bag:
        for message in bag.messages(["/info"]):
            stated.add(bag, message)
    return stated.of("wrist", CameraFields.model_validate(content))


def test_rectified_images_have_the_lens_of_the_projection(tmp_path: Path) -> None:
    raw = intrinsics(tmp_path, "/rectifier/image_raw", lambda k: 176.0, 160.0)
    assert (raw.fx, raw.cx, raw.cy) == (176.0, 80.0, 60.0) and raw.distortion[:2] == [-0.3, 0.1]
    (tmp_path / "camera.bag").unlink()
    rectified = intrinsics(tmp_path, "/depth/image_rect_raw", lambda k: 176.0, 160.0)
    assert (rectified.fx, rectified.fy, rectified.cx, rectified.cy) == (160.0, 160.0, 79.5, 59.5)
    assert rectified.distortion == []
    (tmp_path / "camera.bag").unlink()
    with pytest.raises(InputError, match=r"states no intrinsics .its P is not calibrated.; state fx"):
        intrinsics(tmp_path, "/depth/image_rect", lambda k: 176.0)


def test_intrinsics_that_change_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"states other intrinsics from 11\.500 s on; cut the bag there"):
        intrinsics(tmp_path, "/depth/image_raw", lambda k: 176.0 if k < 15 else 160.0)


def wrenches(folder: Path, headers: Callable[[int], tuple[float, str]], rows: Rows) -> Any:
    """The rows of 20 wrenches with headers of a stamp and a frame, received in 2023."""

    def messages(types: bag_logs.Types) -> Iterator[bag_logs.Row]:
        zero = types("geometry_msgs/Vector3", 0.0, 0.0, 1.0)
        for k in range(20):
            felt = types("geometry_msgs/Wrench", zero, zero)
            each = types("geometry_msgs/WrenchStamped", types.header(*headers(k)), felt)
            yield 1.7e9 + 0.01 * k, "/ft", "geometry_msgs/WrenchStamped", each

    with Bag(bag_logs.write(folder / "ft", "mcap", messages)) as bag:
        for message in bag.messages(["/ft"]):
            rows.add(bag, message)
    return rows.rows()


def test_two_sensors_on_one_topic_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="/ft has messages in two frames, 'left' and 'right'; copy those"):
        wrenches(tmp_path, lambda k: (10.0 + k, ["left", "/left", "right"][k % 3]), Rows("/ft", wrench))


def test_a_stamp_of_zero_is_a_time_where_time_begins_at_zero(tmp_path: Path) -> None:
    table, notes = wrenches(tmp_path, lambda k: (0.01 * k, "ft"), Rows("/ft", wrench))
    assert table[:, 0] == pytest.approx(0.01 * np.arange(20))
    assert notes == ["in the frame 'ft' by its messages"]


def test_a_stamp_of_zero_is_that_of_reception_on_the_same_clock(tmp_path: Path) -> None:
    table, notes = wrenches(tmp_path, lambda k: (k % 2 and 1.7e9 + 0.01 * k, "ft"), Rows("/ft", wrench))
    assert table[:, 0] == pytest.approx(1.7e9 + 0.01 * np.arange(20), abs=0.03)
    assert notes[1:] == ["10 of 20 header stamps are zero, and the time of reception stands for them"]

"""The same log as files and as bags of three kinds becomes the same recording; damage is one sentence."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import yaml
from typer.testing import CliRunner

from bcppl.cli import app
from bcppl.errors import InputError
from bcppl.recordings import load, problems
from bcppl.recordings.importers import Imported, bag, bench
from bcppl.recordings.importers.bag.bag_log import BagLog
from bcppl.recordings.importers.bag.reading import Bag
from bcppl.recordings.importers.bench.configuration.reading import read_configuration
from bcppl.recordings.importers.bench.pose_columns import read_joints
from bcppl.robot.kinematics import Robot
from tests.made_recordings import assert_one_sentence
from tests.recordings.importers import bag_logs, bench_logs

pytest.importorskip("rosbags", reason="bags need rosbags: pip install 'bcppl[bag]'")

STATED = {"clock": "{wrench_late: 8, unit: ms}"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("log")
    there, part = bench_logs.truth(0), slice(3500, 9000)  # 2.5 s in free air, then touches
    there = bench_logs.Truth(there.scene, there.times[part], there.world_from_peg[part], there.wrench[part])
    bench_logs.write(folder, there, bench_logs.Log(more=STATED))
    return folder


@pytest.fixture(scope="module")
def by_files(folder: Path) -> Imported:
    return bench.command(folder / "bench.yaml")


@pytest.fixture(scope="module")
def last(folder: Path) -> float:
    return float(np.loadtxt(folder / "poses.csv", delimiter=",", skiprows=1)[-1, 0])


@pytest.fixture(scope="module")
def config(folder: Path, last: float) -> Path:
    path = folder / "bag.yaml"
    path.write_text(bag_logs.configuration((folder / "bench.yaml").read_text(), last))
    return path


@pytest.fixture(scope="module")
def bags(folder: Path) -> dict[str, Path]:
    return {
        kind: bag_logs.write(folder / kind, kind, lambda types: bag_logs.messages(folder, types))
        for kind in bag_logs.KINDS
    }


def assert_same(imported: Imported, expected: Imported) -> None:
    mine, theirs = bench_logs.touches(imported.recording), bench_logs.touches(expected.recording)
    for each, other in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(each, other, rtol=0, atol=2e-8)
    views = [m for m in imported.recording.measurements if m.kind == "view"]
    others = [m for m in expected.recording.measurements if m.kind == "view"]
    assert len(views) == len(others) == 2
    for view, other in zip(views, others, strict=True):
        np.testing.assert_allclose(view.observation.depth, other.observation.depth, rtol=0, atol=1e-7)
        assert view.action.camera.optics == other.action.camera.optics
        np.testing.assert_array_equal(
            view.action.camera.world_from_camera, other.action.camera.world_from_camera
        )
    assert problems(imported.recording) == []


@pytest.mark.long
@pytest.mark.parametrize("kind", bag_logs.KINDS)
def test_a_bag_becomes_what_the_files_of_the_same_log_do(
    kind: str, bags: dict[str, Path], config: Path, by_files: Imported
) -> None:
    imported = bag.command(bags[kind], config)
    assert_same(imported, by_files)
    named = [line for line in imported.report if "in the frame 'base' by its messages" in line]
    assert [line.split(":")[0] for line in named] == ["pose"]  # the wrench's messages name none


def changed(config: Path, name: str, change: Any) -> Path:
    """The configuration after a change of its content, in a file beside it."""
    content = yaml.safe_load(config.read_text())
    change(content)
    path = config.with_name(f"{name}.yaml")
    path.write_text(yaml.safe_dump(content))
    return path


def alone(config: Path, name: str, **stream: Any) -> Path:
    """A configuration in which one stream alone is a topic's."""

    def change(content: Any) -> None:
        files = yaml.safe_load(config.with_name("bench.yaml").read_text())
        del content["pose"]
        content.update(cameras={}, wrench=files["wrench"], **stream)

    return changed(config, name, change)


def test_transforms_are_composed_along_their_chain(
    bags: dict[str, Path], config: Path, by_files: Imported
) -> None:
    frames = {"topic": "/tf", "parent": "base", "child": "flange"}
    path = changed(config, "tf", lambda content: content.update(pose=frames))
    imported = bag.command(bags["ros1"], path)
    assert_same(imported, by_files)
    assert "2 transforms composed" in "\n".join(imported.report)
    for wrong, words in {
        "flang": r"/tf has no frame 'flang', which pose\.child names; write 'flange'",
        "base": "no transforms from 'base' to 'base'",
    }.items():
        other = {**frames, "child": wrong}
        path = changed(config, "wrong", lambda content, other=other: content.update(pose=other))
        with pytest.raises(InputError, match=words):
            bag.command(bags["mcap"], path)
    path = changed(config, "none", lambda content: content.update(pose={"topic": "/tf"}))
    with pytest.raises(InputError, match="pose lacks parent and child, two frames of /tf"):
        bag.command(bags["mcap"], path)


def test_slower_transforms_are_interpolated_and_their_gaps_left_out(tmp_path: Path, config: Path) -> None:
    def rows(types: bag_logs.Types) -> Any:
        still = types("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0)
        for k in range(1000):
            t = 10.0 + 0.01 * k
            moves = [("rail", "arm", 0.0, 2.0 * t), ("tip", "arm", 0.0, -0.5 * t)]
            if k % 5 == 0 and not 400 < k < 500:
                moves.append(("world", "rail", t, 0.0))
            each = [
                types("geometry_msgs/TransformStamped", types.header(t, parent), child,
                      types("geometry_msgs/Transform", types("geometry_msgs/Vector3", x, y, 0.0), still))
                for parent, child, x, y in moves
            ]  # fmt: skip
            yield t, "/tf", "tf2_msgs/TFMessage", types("tf2_msgs/TFMessage", each)

    path = bag_logs.write(tmp_path / "tf", "sqlite3", rows)
    frames = {"topic": "tf", "parent": "/world", "child": "tip"}
    fields = read_configuration(alone(config, "slow", pose=frames))
    assert fields.pose is not None
    table, notes = BagLog(path, fields, tmp_path).rows("pose", fields.pose)
    np.testing.assert_allclose(table[:, 1], table[:, 0], atol=1e-9)  # of the slow one
    np.testing.assert_allclose(table[:, 2], 2.5 * table[:, 0], atol=1e-9)  # of a forward and a backward one
    gap = (table[:, 0] > 14.005) & (table[:, 0] < 14.995)
    assert not gap.any() and "left out, for a slower transform is not known there" in notes[1]


def test_joints_are_found_by_their_names(tmp_path: Path, config: Path) -> None:
    urdf, tip = Path(__file__).parents[3] / "models/robots/panda/panda.urdf", "panda_hand_tcp"
    robot = Robot(urdf, tip=tip)
    names = [joint.name for joint in robot.joints]
    angles = np.random.default_rng(0).uniform(-0.5, 0.5, (50, len(names)))

    def rows(types: bag_logs.Types) -> Any:
        for k, each in enumerate(angles):
            for there, positions in ((names[::-1], each[::-1]), (["gripper"], np.ones(1))):
                stamp = 100.0 + 0.01 * k
                yield stamp, "/joint_states", "sensor_msgs/JointState", types(
                    "sensor_msgs/JointState", types.header(0.0), list(there),
                    positions.copy(), np.zeros(0), np.zeros(0),
                )  # fmt: skip

    path = bag_logs.write(tmp_path / "joints", "mcap", rows)

    joints = {"topic": "/joint_states", "urdf": str(urdf), "tip": tip}
    fields = read_configuration(alone(config, "joints", joints=joints))
    report: list[str] = []
    assert fields.joints is not None
    stream = read_joints(fields.joints, BagLog(path, fields, tmp_path), report)
    expected = robot.base_from_link(tip, angles).numpy()
    np.testing.assert_allclose(stream.values, expected, atol=1e-12)
    received = 100.0 + bag_logs.RECEIVED + 0.01 * np.arange(50)
    np.testing.assert_allclose(stream.times, received, atol=1e-6)
    assert "50 messages of other joints left out" in report[0]
    assert "50 of 50 header stamps are zero, and the time of reception stands for them" in report[0]
    fields = read_configuration(alone(config, "elbow", joints={**joints, "columns": ["elbow"]}))
    with pytest.raises(InputError, match="no message of /joint_states has the positions of all of elbow"):
        read_joints(fields.joints, BagLog(path, fields, tmp_path), [])  # type: ignore[arg-type]


def test_images_are_those_of_their_times_or_every_so_often(
    bags: dict[str, Path], config: Path, last: float
) -> None:
    def every(content: Any) -> None:
        del content["cameras"]["camera_1"]
        camera = content["cameras"]["camera_0"]
        del camera["images"], camera["world_from_camera"]
        camera.update(every=0.9, frame_from_camera={"xyz": [0.06, 0, 0.04]})

    imported = bag.command(bags["ros1"], changed(config, "every", every))
    views = [m for m in imported.recording.measurements if m.kind == "view"]
    assert len(views) == 3 and views[1].action.camera.name == "camera_0 1"
    places = [view.action.camera.world_from_camera for view in views]
    assert not np.allclose(places[0], places[1])
    for at, words in {
        last - 10.0: r"images\[0\]\.time is .* and the nearest image of /camera_0/depth is of",
        f"{last}": r"images\[0\]\.time is .*; give a number|reads as text",
    }.items():
        path = changed(
            config, "late", lambda c, at=at: c["cameras"]["camera_0"].update(images=[{"time": at}])
        )
        with pytest.raises(InputError, match=words):
            bag.command(bags["ros1"], path)
    twice = [{"time": last - 2.0}, {"time": last - 2.02}]
    path = changed(config, "twice", lambda c: c["cameras"]["camera_0"].update(images=twice))
    with pytest.raises(InputError, match=r"images\[1\]\.time is nearest .* as is that of images\[0\]"):
        bag.command(bags["ros1"], path)


MISTAKES = {
    "has no topic '/wrnch', which wrench names; give one of its topics, such as /wrench": (
        lambda c: c["wrench"].update(topic="/wrnch")
    ),
    r"/pose in .* is of geometry_msgs/PoseStamped; give wrench a topic of geometry_msgs/WrenchStamped": (
        lambda c: c["wrench"].update(topic="/pose")
    ),
    "wrench names a topic, whose messages state 'columns'; leave that out": (
        lambda c: c["wrench"].update(columns=["a"])
    ),
    "pose has parent and child, and /pose is of one pose": (
        lambda c: c["pose"].update(parent="base", child="flange")
    ),
    "cameras.camera_0 has both info, .* and intrinsics": lambda c: c["cameras"]["camera_0"].update(fx=1.0),
    "cameras.camera_0 needs either images, each with its time, or every": (
        lambda c: c["cameras"]["camera_0"].update(every=1.0)
    ),
    "cameras.camera_0 has images of a topic: give each its time alone": (
        lambda c: c["cameras"]["camera_0"].update(images=[{"file": "a.png"}])
    ),
    "cameras.camera_0 lacks fx and fy and cx and cy": lambda c: c["cameras"]["camera_0"].pop("info"),
    "state the unit of its depth": lambda c: c["cameras"]["camera_0"].update(unit="m"),
}


@pytest.mark.parametrize("words", MISTAKES)
def test_each_mistake_is_one_sentence(words: str, bags: dict[str, Path], config: Path) -> None:
    path = changed(config, "mistaken", MISTAKES[words])
    with pytest.raises(InputError, match=words) as failure:
        bag.command(bags["mcap"], path)
    assert_one_sentence(str(failure.value))


def test_a_topic_needs_its_bag(config: Path, bags: dict[str, Path], folder: Path) -> None:
    with pytest.raises(InputError, match="pose names the topic /pose of a bag; give the bag"):
        bench.command(config)
    with pytest.raises(InputError, match="no field names a topic"):
        bag.command(bags["mcap"], folder / "bench.yaml")


@pytest.mark.long
@pytest.mark.parametrize("kind", bag_logs.KINDS)
def test_damage_is_one_sentence(kind: str, tmp_path: Path) -> None:
    def rows(types: bag_logs.Types) -> Any:
        for k in range(200):
            pose = types(
                "geometry_msgs/Pose", types("geometry_msgs/Point", 0.0, 0.0, 0.0),
                types("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0),
            )  # fmt: skip
            yield (
                0.01 * k,
                "/pose",
                "geometry_msgs/PoseStamped",
                types("geometry_msgs/PoseStamped", types.header(0.01 * k, "base"), pose),
            )

    path = bag_logs.write(tmp_path / "bag", kind, rows)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
    good, rng = file.read_bytes(), np.random.default_rng(0)
    refused = 0
    for trial in range(50):
        damaged = bytearray(good[: len(good) * trial // 30] if trial < 30 else good)
        for _ in range(trial - 30):
            damaged[rng.integers(len(damaged))] = rng.integers(256)
        file.write_bytes(damaged)
        for each in {path, file}:
            try:
                with Bag(each) as opened:
                    for message in opened.messages(list(opened.topics)):
                        opened.parsed(message)
            except InputError as failure:
                refused += 1
                assert_one_sentence(str(failure))
    assert refused > 38  # a changed number in a message of a bag without checksums is not seen


@pytest.mark.long
@pytest.mark.parametrize("mode", ["FILE", "MESSAGE", "STORAGE"])
def test_compressed_bags(mode: str, tmp_path: Path, folder: Path, config: Path, by_files: Imported) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    def compressed(writer: Any) -> None:
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)

    rows = bag_logs.messages
    path = bag_logs.write(tmp_path / "bag", "mcap", lambda types: rows(folder, types), compressed)
    assert_same(bag.command(path, config), by_files)


def test_no_definition_of_a_bag_is_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys.store import Typestore

    path = tmp_path / "other.bag"
    with Writer(path) as writer:
        connection = writer.add_connection(
            "/pose", "geometry_msgs/msg/PoseStamped", msgdef="float64 x", md5sum="0" * 32
        )
        writer.write(connection, 10**9, bytes(8))
    registered: list[Any] = []
    monkeypatch.setattr(Typestore, "register", lambda self, types: registered.extend(types))
    with Bag(path) as opened, pytest.raises(InputError, match="of another definition"):
        opened.topic("pose", "/pose", ["geometry_msgs/msg/PoseStamped"])
    assert registered == ["tf2_msgs/msg/TFMessage"]


def test_without_a_configuration_one_is_drafted(
    bags: dict[str, Path], tmp_path: Path, config: Path, by_files: Imported
) -> None:
    def run(*words: str) -> Any:
        return CliRunner().invoke(app, ["import", "bag", *words], catch_exceptions=False)

    for path in bags.values():
        shown = run(str(path))
        assert re.search(r"/wrench +geometry_msgs/WrenchStamped +5500 +99\d\.\d Hz", shown.output)
    new = tmp_path / "new.yaml"
    assert run(str(bags["mcap"]), "--write", str(new)).exit_code == 0
    text = new.read_text()
    assert "topic: /wrench  # a guess" in text and "topic: /pose  # a guess, in the frame base" in text
    fields = read_configuration(new)
    assert [camera.info for camera in fields.cameras.values()] == ["/camera_0/info", "/camera_1/info"]
    with pytest.raises(InputError, match="exists already"):
        bag.command(bags["mcap"], write=new)
    with pytest.raises(InputError, match="--write is for a bag without a configuration"):
        bag.command(bags["mcap"], new, tmp_path / "other.yaml")
    with pytest.raises(typer.Exit):
        bag.command(bags["ros1"])
    out = tmp_path / "recording.h5"
    done = run(str(bags["mcap"]), str(config), "-o", str(out))
    assert done.exit_code == 0 and "common stamps: 27" in done.output
    assert problems(load(out)) == []

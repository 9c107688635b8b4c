"""A log of which streams and images are topics of a bag, read in one pass; the rest are files beside it."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers.bag import reading
from bcppl.recordings.importers.bag.images import Images, Intrinsics
from bcppl.recordings.importers.bag.reading import Bag
from bcppl.recordings.importers.bag.rows import Collector, JointRows, Rows, pose, wrench
from bcppl.recordings.importers.bag.transforms import Transforms
from bcppl.recordings.importers.bench.configuration.camera_fields import CameraFields
from bcppl.recordings.importers.bench.configuration.fields import (
    EVERY_JOINT,
    BenchFields,
    JointFields,
    PoseStreamFields,
    StreamFields,
)
from bcppl.recordings.importers.bench.sources import Files, Shot
from bcppl.untrusted.visible_text import visible

_STEP = 1000  # messages between which the bar moves


class BagLog(Files):
    """What a configuration asks for of a bag. Images are kept as they are stored, the rest as numbers.

    Args:
        path: of the bag.
        fields: the configuration.
        folder: that the configuration's paths are relative to.

    Raises:
        InputError: the bag is damaged, or lacks a topic.
    """

    def __init__(self, path: Path, fields: BenchFields, folder: Path) -> None:
        super().__init__(folder)
        self._streams: dict[str, Rows | Transforms] = {}
        self._images: dict[str, Images] = {}
        self._intrinsics: dict[str, Intrinsics] = {}
        self._wanted: dict[str, list[Collector]] = {}
        with Bag(path) as bag:
            if fields.wrench is not None and fields.wrench.topic:
                topic = bag.topic("wrench", fields.wrench.topic, [reading.WRENCH]).name
                self._stream("wrench", topic, Rows(topic, wrench))
            for name in ("pose", "command"):
                if (each := getattr(fields, name)) is not None and each.topic:
                    self._poses(name, each, bag)
            if fields.joints is not None and fields.joints.topic:
                topic = bag.topic("joints", fields.joints.topic, [reading.JOINTS]).name
                self._stream("joints", topic, JointRows(topic, self._joints(fields.joints)))
            for name, camera in fields.cameras.items():
                if camera.topic:
                    self._camera(name, camera, bag)
            if not self._wanted:
                raise InputError(f"no field names a topic of {path}; name some, or use bcppl import bench.")
            _read(bag, self._wanted)
        self._wanted.clear()  # what is read is released

    def rows(self, name: str, fields: StreamFields) -> tuple[Array, list[str]]:
        """Stamps in seconds and columns (T, 1 + C) of a stream, and what was left out; once for each stream.

        Raises:
            InputError: the stream is a file that cannot be read, or no message has what it asks for.
        """
        return self._streams.pop(name).rows() if fields.topic else super().rows(name, fields)

    def intrinsics(self, name: str, fields: CameraFields) -> CameraFields:
        """The fields of a camera, with the intrinsics that its topic states."""
        return self._intrinsics[name].of(name, fields) if fields.info else fields

    def shots(self, name: str, fields: CameraFields) -> tuple[list[Shot], list[str]]:
        """The images of a camera."""
        if not fields.topic:
            return super().shots(name, fields)
        size = self._intrinsics[name].size if fields.info else None
        return self._images.pop(name).shots(fields, size)

    def _keep(self, topic: str, collector: Collector) -> None:
        self._wanted.setdefault(topic, []).append(collector)

    def _stream(self, name: str, topic: str, rows: Rows) -> None:
        self._streams[name] = rows
        self._keep(topic, rows)

    def _poses(self, name: str, fields: PoseStreamFields, bag: Bag) -> None:
        topic = bag.topic(name, fields.topic, [reading.POSE, reading.TRANSFORMS])
        if topic.type == reading.POSE:
            if fields.parent is not None:
                raise InputError(
                    f"{name} has parent and child, and {topic.name} is of one pose; leave them out."
                )
            self._stream(name, topic.name, Rows(topic.name, pose))
            return
        if fields.parent is None or fields.child is None:
            raise InputError(f"{name} lacks parent and child, two frames of {topic.name}; add them.")
        moving = Transforms(name, topic.name, fields.parent, fields.child)
        self._streams[name] = moving
        self._keep(topic.name, moving)
        fixed = bag.topics.get(f"{topic.name}_static")
        if fixed is not None and fixed.type == reading.TRANSFORMS and fixed.count:
            self._keep(fixed.name, moving.fixed)

    def _joints(self, fields: JointFields) -> list[str]:
        if fields.columns != [EVERY_JOINT]:
            return [str(name) for name in fields.columns]
        from bcppl.robot.kinematics import Robot  # reads URDF files, which takes seconds to import

        return [joint.name for joint in Robot(self.folder / fields.urdf, tip=fields.tip).joints]

    def _camera(self, name: str, fields: CameraFields, bag: Bag) -> None:
        self._images[name] = Images(name, fields)
        self._keep(bag.topic(f"cameras.{name}", fields.topic, [reading.IMAGE]).name, self._images[name])
        if fields.info:
            self._intrinsics[name] = Intrinsics()
            topic = bag.topic(f"cameras.{name}.info", fields.info, [reading.CAMERA])
            self._keep(topic.name, self._intrinsics[name])


def _read(bag: Bag, wanted: dict[str, list[Collector]]) -> None:
    """One pass over the messages of topics, with a bar on standard error if that is a terminal."""
    console = Console(stderr=True)
    total = sum(bag.topics[name].count for name in wanted)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(escape(visible(bag.path.name)), total=total)
        for number, message in enumerate(bag.messages(wanted), 1):
            for collector in wanted[message.topic]:
                collector.add(bag, message)
            if number % _STEP == 0:
                bar.update(task, completed=number)

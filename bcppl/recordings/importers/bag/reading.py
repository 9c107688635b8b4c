"""Messages of bags, by rosbags: ROS 1, ROS 2 (sqlite3, MCAP) and single MCAP files.

rosbags compiles the message definitions that a bag carries to Python code. Here none of a bag's definitions
is used: messages are those of ROS's own types, which rosbags ships, and a bag whose digest of a type differs
is refused.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from bcppl.errors import InputError, reason_of

WRENCH = "geometry_msgs/msg/WrenchStamped"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
JOINTS = "sensor_msgs/msg/JointState"
IMAGE = "sensor_msgs/msg/Image"
CAMERA = "sensor_msgs/msg/CameraInfo"

HEADED = (WRENCH, POSE, JOINTS, IMAGE, CAMERA)  # they begin with a header
APART = 60.0  # s from the time of reception: a clock that was never set by the recorder's
_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"  # which the types of ROS 1 in rosbags lack
_REMEDY = (
    "copy it again, or repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`, as is its kind"
)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, its type, or '' where it has several, and how many messages it has."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class Message:
    """One message as it is stored.

    Attributes:
        topic: its topic's name.
        type: its type's name.
        received: when the bag's recorder received it, s.
        raw: its bytes.
    """

    topic: str
    type: str
    received: float
    raw: bytes


class Bag:
    """A bag, open within a `with` statement.

    Attributes:
        topics: by name.
        begin, end: when the first and the last message were received, s.

    Args:
        path: of a .bag or .mcap file, a .db3 file, or the folder of a ROS 2 bag.

    Raises:
        InputError: rosbags is not installed, there is no such file, or it is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader, self._store = _opened(path)
        self.is_ros1 = path.suffix == ".bag"
        self._own_clock: dict[str, bool] = {}
        try:
            self._reader.open()
            self.topics = _topics(self._reader.connections)
            self.begin, self.end = 1e-9 * self._reader.start_time, 1e-9 * self._reader.end_time
        except Exception as error:  # rosbags passes on errors of what it reads with
            raise self._damaged(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        with contextlib.suppress(Exception):
            self._reader.close()

    def topic(self, field: str, name: str, types: Collection[str]) -> Topic:
        """The topic of a name.

        Args:
            field: of the configuration that names it.
            name: of the topic; a slash before it may be left out.
            types: that it may have.

        Raises:
            InputError: there is none, it has another type or no message, or ROS defines its type otherwise.
        """
        found = self.topics.get(name) or self.topics.get(f"/{name}")
        if found is None:
            of_types = [each.name for each in self.topics.values() if each.type in types]
            close = get_close_matches(name, list(self.topics), 1) or of_types
            meant = (
                f"give one of its topics, such as {close[0]}." if close else "see what it has without one."
            )
            raise InputError(f"{self.path} has no topic {name!r}, which {field} names; {meant}")
        short = " or ".join(each.replace("/msg/", "/") for each in types)
        if found.type not in types:
            held = found.type.replace("/msg/", "/") or "several types"
            raise InputError(f"{found.name} in {self.path} is of {held}; give {field} a topic of {short}.")
        if not found.count:
            raise InputError(f"{found.name} in {self.path} has no message; give {field} another topic.")
        for each in self._reader.connections:
            if each.topic == found.name and each.digest and each.digest != self._digest(found.type):
                raise InputError(
                    f"{found.name} in {self.path} is of another definition of {short} than ROS's own; "
                    f"convert it to that, and give {field} the new topic."
                )
        return found

    def messages(self, names: Collection[str]) -> Iterator[Message]:
        """The messages of topics, in the order in which they were received.

        Raises:
            InputError: the bag is damaged.
        """
        for name in names:
            if name in self.topics and name not in self._own_clock:
                self._own_clock[name] = self._has_own_clock(name)
        count = 0
        for message in self._stored(names):
            count += 1
            yield message
        if count < (stated := sum(self.topics[name].count for name in names if name in self.topics)):
            raise self._damaged(f"it holds {count} of {stated} messages")

    def _stored(self, names: Collection[str]) -> Iterator[Message]:
        wanted = [each for each in self._reader.connections if each.topic in names]
        if not wanted:
            return
        stored = self._reader.messages(connections=wanted)
        while True:
            try:
                connection, received, raw = next(stored)
            except StopIteration:
                return
            except Exception as error:
                raise self._damaged(error) from error
            yield Message(connection.topic, connection.msgtype, 1e-9 * received, raw)

    def _has_own_clock(self, name: str) -> bool:
        """Whether the stamps of a topic's headers are on another clock than that of reception.

        So is simulated time, which begins at 0: a stamp of 0 is a time there.
        """
        if self.topics[name].type not in HEADED:
            return False
        for message in self._stored([name]):
            if stamp := self.header_stamp(message):
                return abs(message.received - stamp) > APART
        return False

    def stamped(self, header: Any, message: Message) -> tuple[float, bool]:
        """The stamp (s) of a header, and whether it is that of reception, in place of none."""
        return self._or_reception(header.stamp.sec + 1e-9 * header.stamp.nanosec, message)

    def raw_stamped(self, message: Message) -> tuple[float, bool]:
        """The same of a message that begins with a header, without parsing the rest."""
        return self._or_reception(self.header_stamp(message), message)

    def _or_reception(self, stamp: float, message: Message) -> tuple[float, bool]:
        if stamp or self._own_clock.get(message.topic):
            return stamp, False
        return message.received, True

    def parsed(self, message: Message) -> Any:
        """The fields of a message.

        Raises:
            InputError: its bytes are no message of its type.
        """
        parse = self._store.deserialize_ros1 if self.is_ros1 else self._store.deserialize_cdr
        try:
            return parse(message.raw, message.type)
        except Exception as error:
            raise self._damaged(error, f"a message of {message.topic} ") from error

    def header_stamp(self, message: Message) -> float:
        """The stamp (s) of a message that begins with a header, without parsing the rest; 0 if it has none.

        ROS 1 writes a number of four bytes before it, ROS 2 four bytes that state the order of bytes.
        """
        order = "<" if self.is_ros1 or message.raw[1:2] == b"\x01" else ">"
        try:
            seconds, nanoseconds = struct.unpack_from(f"{order}II", message.raw, 4)
        except struct.error as error:
            raise self._damaged(error, f"a message of {message.topic} ") from error
        return float(seconds + 1e-9 * nanoseconds)

    def _digest(self, kind: str) -> str:
        if self.is_ros1:
            return str(self._store.generate_msgdef(kind)[1])
        return str(self._store.hash_rihs01(kind))

    def _damaged(self, error: BaseException | str, what: str = "") -> InputError:
        cause = reason_of(error)
        place = f"{what}in {self.path}" if what else str(self.path)
        return InputError(f"{place} cannot be read ({cause[:200]}); {_REMEDY}.")


def _topics(connections: Any) -> dict[str, Topic]:
    topics: dict[str, Topic] = {}
    for each in connections:
        before = topics.get(each.topic, Topic(each.topic, each.msgtype, 0))
        kind = each.msgtype if each.msgtype == before.type else ""
        topics[each.topic] = Topic(each.topic, kind, before.count + int(each.msgcount))
    return topics


def _opened(path: Path) -> tuple[Any, Any]:
    """A reader of rosbags, not open yet, and the types of messages."""
    if not path.exists():
        raise InputError(f"there is no bag {path}; give a .bag or .mcap file or the folder of a ROS 2 bag.")
    if path.is_file() and path.suffix not in (".bag", ".mcap", ".db3"):
        raise InputError(
            f"{path} ends in {path.suffix!r}; give a .bag or .mcap file or the folder of a ROS 2 bag (with "
            "its metadata.yaml, which states how its files are compressed)."
        )
    try:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise InputError(f"{path} is a bag, which needs rosbags: pip install 'bcppl[bag]'.") from error
    store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE)
    if TRANSFORMS not in store.fielddefs:
        store.register(get_types_from_msg(_TRANSFORMS, TRANSFORMS))
    try:
        return (rosbag1.Reader(path) if path.suffix == ".bag" else rosbag2.Reader(path)), store
    except Exception as error:
        raise InputError(f"{path} cannot be read as a bag ({error}); {_REMEDY}.") from error

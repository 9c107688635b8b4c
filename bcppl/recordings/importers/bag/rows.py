"""Rows of numbers from messages: wrenches, poses, joint angles."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers.bag.reading import Bag, Message


class Collector(Protocol):
    """What is kept of a topic's messages."""

    def add(self, bag: Bag, message: Message) -> None:
        """Keep what is wanted of a message."""


class Rows:
    """Rows of one topic, each of a stamp (s) and numbers.

    Args:
        topic: its name.
        numbers: of a message.
    """

    def __init__(self, topic: str, numbers: Callable[[Any], Sequence[float]]) -> None:
        self.topic, self._numbers = topic, numbers
        self._flat, self._count, self._unstamped = array("d"), 0, 0
        self._frame: str | None = None

    def add(self, bag: Bag, message: Message) -> None:
        """Keep a message's row.

        Raises:
            InputError: it is in another frame than those before.
        """
        parsed = bag.parsed(message)
        frame = str(parsed.header.frame_id).lstrip("/")
        self._frame = frame if self._frame is None else self._frame
        if frame != self._frame:
            raise InputError(
                f"{self.topic} has messages in two frames, {self._frame[:40]!r} and {frame[:40]!r}; copy "
                "those of one to a bag of their own, and import that."
            )
        stamp, unstamped = bag.stamped(parsed.header, message)
        self._keep(stamp, self._numbers(parsed))
        self._unstamped += unstamped

    def rows(self) -> tuple[Array, list[str]]:
        """Rows (T, 1 + C), the frame that they name, and how many have the time of reception for a stamp.

        Raises:
            InputError: none was kept.
        """
        table = np.frombuffer(self._flat, dtype=np.float64).reshape(max(self._count, 1), -1)
        frame = [f"in the frame {self._frame[:40]!r} by its messages"] if self._frame else []
        return table, [*frame, *unstamped_words(self._unstamped, self._count)]

    def _keep(self, stamp: float, numbers: Sequence[float]) -> None:
        self._flat.append(stamp)
        self._flat.extend(numbers)
        self._count += 1


class JointRows(Rows):
    """Angles of joints by their names; messages that lack one of them, such as a gripper's, are left out.

    Args:
        topic: its name.
        names: of the joints, from the base outwards.
    """

    def __init__(self, topic: str, names: Sequence[str]) -> None:
        super().__init__(topic, lambda message: ())
        self._names = list(names)
        self._places: dict[tuple[str, ...], list[int] | None] = {}
        self._others = 0

    def add(self, bag: Bag, message: Message) -> None:
        """Keep the angles of a message that has them all."""
        parsed = bag.parsed(message)
        there = tuple(parsed.name)
        if there not in self._places:
            complete = set(self._names) <= set(there)
            self._places[there] = [there.index(name) for name in self._names] if complete else None
        places = self._places[there]
        if places is None or len(parsed.position) < len(there):
            self._others += 1
            return
        stamp, unstamped = bag.stamped(parsed.header, message)
        self._keep(stamp, [float(parsed.position[place]) for place in places])
        self._unstamped += unstamped

    def rows(self) -> tuple[Array, list[str]]:
        """Rows (T, 1 + C), and what was left out.

        Raises:
            InputError: no message has the positions of all joints.
        """
        if not self._count:
            known = sorted({name for names in self._places for name in names})
            raise InputError(
                f"no message of {self.topic} has the positions of all of {', '.join(self._names)}; its "
                f"joints are {', '.join(known)}: name those in joints.columns."
            )
        table, notes = super().rows()
        left_out = [f"{self._others} messages of other joints left out"] if self._others else []
        return table, [*notes, *left_out]


def wrench(message: Any) -> Sequence[float]:
    """Force and torque of a WrenchStamped, N and N m."""
    force, torque = message.wrench.force, message.wrench.torque
    return (force.x, force.y, force.z, torque.x, torque.y, torque.z)


def pose(message: Any) -> Sequence[float]:
    """Position and quaternion x y z w of a PoseStamped."""
    at, turn = message.pose.position, message.pose.orientation
    return (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)


def unstamped_words(unstamped: int, count: int) -> list[str]:
    """What a report states where header stamps are zero."""
    if not unstamped:
        return []
    return [f"{unstamped} of {count} header stamps are zero, and the time of reception stands for them"]

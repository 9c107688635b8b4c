"""Poses of one frame in another from messages of transforms, along the chain of frames between them."""

from __future__ import annotations

from array import array
from collections import deque
from difflib import get_close_matches

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers.bag.reading import Bag, Message, stamped
from bcppl.recordings.importers.bag.rows import unstamped_words
from bcppl.recordings.importers.bench.pose_columns import composed, inverted

_ORDER = [0, 1, 2, 6, 3, 4, 5]  # x y z and qw qx qy qz of x y z and qx qy qz qw
_BACK = [0, 1, 2, 4, 5, 6, 3]


class _Edge:
    """The transforms of one frame in another: stamps and poses, and how many stamps are zero."""

    def __init__(self) -> None:
        self.flat, self.unstamped, self.is_fixed = array("d"), 0, False

    def table(self) -> Array:
        return np.frombuffer(self.flat, dtype=np.float64).reshape(-1, 8)


class _Fixed:
    """What is kept of transforms that do not change: the last of each."""

    def __init__(self, edges: dict[tuple[str, str], _Edge]) -> None:
        self._edges = edges

    def add(self, bag: Bag, message: Message) -> None:
        """Keep the transforms of a message."""
        _keep(self._edges, bag, message, fixed=True)


class Transforms:
    """The poses of a frame in another, of all transforms of a topic.

    Args:
        name: of the stream.
        topic: its name.
        parent: the frame in which poses are.
        child: the frame whose poses they are.
    """

    def __init__(self, name: str, topic: str, parent: str, child: str) -> None:
        self._name, self._topic = name, topic
        self._parent, self._child = parent.lstrip("/"), child.lstrip("/")
        self.edges: dict[tuple[str, str], _Edge] = {}
        self.fixed = _Fixed(self.edges)

    def add(self, bag: Bag, message: Message) -> None:
        """Keep the transforms of a message."""
        _keep(self.edges, bag, message, fixed=False)

    def rows(self) -> tuple[Array, list[str]]:
        """Stamps and poses (T, 8), quaternions x y z w, at the stamps of the fastest transform on the way.

        Raises:
            InputError: there is no way from one frame to the other, or no transform on it moves.
        """
        way = self._way()
        moving = [each for each, _ in way if not each.is_fixed]
        if not moving:
            raise InputError(
                f"{self._name}: no transform from {self._parent!r} to {self._child!r} in {self._topic} is "
                "repeated; give a child that the arm moves."
            )
        fastest = max(moving, key=lambda edge: len(edge.flat))
        times = fastest.table()[:, 0]
        begin = max(edge.table()[:, 0].min() for edge in moving)
        end = min(edge.table()[:, 0].max() for edge in moving)
        times = times[(times >= begin) & (times <= end)]
        if not len(times):
            raise InputError(
                f"{self._name}: the transforms from {self._parent!r} to {self._child!r} in {self._topic} "
                "share no time; give frames between which all were sent."
            )
        pose = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(times), 1))
        for edge, forward in way:
            step = _at(edge, times, begin, end, edge is fastest)
            pose = composed(pose, step if forward else inverted(step))
        notes = unstamped_words(sum(each.unstamped for each in moving), sum(len(e.flat) for e in moving) // 8)
        return np.column_stack([times, pose[:, _BACK]]), [f"{len(way)} transforms composed", *notes]

    def _way(self) -> list[tuple[_Edge, bool]]:
        """The edges from parent to child, each with whether it leads from its parent to its child."""
        neighbours: dict[str, list[tuple[str, _Edge, bool]]] = {}
        for (parent, child), edge in self.edges.items():
            neighbours.setdefault(parent, []).append((child, edge, True))
            neighbours.setdefault(child, []).append((parent, edge, False))
        for field, frame in (("parent", self._parent), ("child", self._child)):
            if frame not in neighbours:
                close = get_close_matches(frame, list(neighbours), 1)
                meant = f"write {close[0]!r}" if close else f"its frames are {', '.join(sorted(neighbours))}"
                raise InputError(
                    f"{self._topic} has no frame {frame!r}, which {self._name}.{field} names; {meant}."
                )
        ways: dict[str, list[tuple[_Edge, bool]]] = {self._parent: []}
        ahead = deque([self._parent])
        while ahead:
            frame = ahead.popleft()
            for other, edge, forward in neighbours[frame]:
                if other not in ways:
                    ways[other] = [*ways[frame], (edge, forward)]
                    ahead.append(other)
        if self._child not in ways or not ways[self._child]:
            raise InputError(
                f"{self._topic} has no transforms from {self._parent!r} to {self._child!r}; "
                f"{self._name}.parent and child are two frames of one tree."
            )
        return ways[self._child]


def _keep(edges: dict[tuple[str, str], _Edge], bag: Bag, message: Message, fixed: bool) -> None:
    for each in bag.parsed(message).transforms:
        key = (each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/"))
        edge = edges.setdefault(key, _Edge())
        if fixed:
            edge.is_fixed = True
            del edge.flat[:]
        at, turn = each.transform.translation, each.transform.rotation
        stamp, unstamped = stamped(each.header, message.received)
        edge.unstamped += unstamped
        edge.flat.extend((stamp, at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w))


def _at(edge: _Edge, times: Array, begin: float, end: float, own: bool) -> Array:
    """Poses (T, 7) of an edge at times within its own; its own rows where they are its stamps."""
    table = edge.table()
    if own:
        return np.asarray(table[(table[:, 0] >= begin) & (table[:, 0] <= end)][:, 1:][:, _ORDER])
    if edge.is_fixed:
        return np.asarray(table[-1:, 1:][:, _ORDER])
    _, first = np.unique(table[:, 0], return_index=True)
    table = table[first]
    if len(table) == 1:
        return np.asarray(table[:, 1:][:, _ORDER])
    turns = Slerp(table[:, 0], Rotation.from_quat(table[:, 4:]))(times).as_quat()
    place = np.stack([np.interp(times, table[:, 0], column) for column in table[:, 1:4].T], axis=1)
    return np.column_stack([place, turns[:, [3, 0, 1, 2]]])

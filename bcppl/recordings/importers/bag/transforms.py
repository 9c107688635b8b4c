"""Poses of one frame in another from messages of transforms, along the chain of frames between them."""

from __future__ import annotations

from array import array
from collections import deque
from difflib import get_close_matches

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.recordings.importers.bag.reading import Bag, Message
from bcppl.recordings.importers.bag.rows import unstamped_words
from bcppl.recordings.importers.bench.pose_columns import UNIT, composed, inverted
from bcppl.recordings.importers.bench.wrenches import IDENTITY
from bcppl.recordings.streams import Stream, is_known

_ORDER = [0, 1, 2, 6, 3, 4, 5]  # x y z and qw qx qy qz of x y z and qx qy qz qw
_BACK = [0, 1, 2, 4, 5, 6, 3]


class _Edge:
    """The transforms of one frame in another: stamps and poses, and how many stamps are zero.

    Args:
        parent: the frame in which the other is.
        child: the other.
    """

    def __init__(self, parent: str, child: str) -> None:
        self.parent, self.child = parent, child
        self.flat, self.unstamped, self.is_fixed, self.changes = array("d"), 0, False, False

    def table(self) -> Array:
        """Stamps, positions and quaternions x y z w (T, 8)."""
        return np.frombuffer(self.flat, dtype=np.float64).reshape(-1, 8)

    @property
    def holds_still(self) -> bool:
        """Whether it is fixed, or was sent over and over without a change."""
        table = self.table()
        return self.is_fixed or bool((table[:, 1:] == table[0, 1:]).all())

    def stream(self) -> Stream:
        """Its poses (T, 7) in order, each stamp once."""
        _, first = np.unique(self.table()[:, 0], return_index=True)
        table = self.table()[first]
        return Stream("transform", table[:, 0], table[:, 1:][:, _ORDER])

    def at(self, times: Array) -> Array:
        """Poses (T, 7), or (1, 7) if it holds still; interpolated along lines and geodesics."""
        if self.holds_still:
            return np.asarray(self.table()[-1:, 1:][:, _ORDER])
        stream = self.stream()
        within = np.clip(times, stream.times[0], stream.times[-1])
        turns = Slerp(stream.times, Rotation.from_quat(stream.values[:, [4, 5, 6, 3]]))(within).as_quat()
        place = [np.interp(within, stream.times, column) for column in stream.values[:, :3].T]
        return np.column_stack([*place, turns[:, [3, 0, 1, 2]]])


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
            InputError: there is no way from one frame to the other, or there are two; on it no transform
                moves, or a static one changes.
        """
        way = self._way()
        for edge, _ in way:
            self._refuse_wrong(edge)
        moving = [edge for edge, _ in way if not edge.holds_still]
        if not moving:
            raise InputError(
                f"{self._name}: nothing moves from {self._parent!r} to {self._child!r} in {self._topic}; "
                "give a child that the arm moves."
            )
        fastest = max(moving, key=lambda edge: len(edge.flat))
        times = fastest.table()[:, 0]
        known = np.ones(len(times), dtype=bool)
        for edge in moving:
            known &= edge is fastest or is_known(edge.stream(), times, None)
        if not known.any():
            raise InputError(
                f"{self._name}: the transforms from {self._parent!r} to {self._child!r} in {self._topic} "
                "share no time; give frames between which all were sent."
            )
        pose = np.tile(IDENTITY, (len(times), 1))
        for edge, forward in way:
            step = edge.table()[:, 1:][:, _ORDER] if edge is fastest else edge.at(times)
            pose = composed(pose, step if forward else inverted(step))
        table = np.column_stack([times, pose[:, _BACK]])[known]
        notes = [f"{len(way)} transforms composed"] if len(way) > 1 else []
        if not known.all():
            notes.append(f"{int((~known).sum())} stamps left out, for a slower transform is not known there")
        unstamped = sum(edge.unstamped for edge in moving), sum(len(edge.flat) // 8 for edge in moving)
        return table, [*notes, *unstamped_words(*unstamped)]

    def _refuse_wrong(self, edge: _Edge) -> None:
        table = edge.table()
        off = ~(np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0) < UNIT) | ~np.isfinite(table).all(axis=1)
        if off.any():
            raise InputError(
                f"{self._name}: {self._topic} has a transform without a rotation, with numbers "
                f"{table[off][0, 1:].tolist()}; filter the bag, or give another topic."
            )
        if edge.changes:
            raise InputError(
                f"{self._name}: the static transform from {edge.parent!r} to {edge.child!r} has other "
                "numbers later in the bag; cut or filter the bag so that it is sent with one value."
            )

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
        way = _reached(neighbours, self._parent).get(self._child)
        if not way:
            raise InputError(
                f"{self._topic} has no transforms from {self._parent!r} to {self._child!r}; "
                f"{self._name}.parent and child are two frames of one tree."
            )
        for edge, _ in way:
            if other := _reached(neighbours, self._parent, without=edge).get(self._child):
                raise InputError(
                    f"{self._topic} has two ways from {self._parent!r} to {self._child!r}, {_spelled(way)} "
                    f"and {_spelled(other)}; filter the bag so that each frame has one parent."
                )
        return way


def _reached(
    neighbours: dict[str, list[tuple[str, _Edge, bool]]], start: str, without: _Edge | None = None
) -> dict[str, list[tuple[_Edge, bool]]]:
    """The shortest way from a frame to each that is reached, but for those by one transform."""
    ways: dict[str, list[tuple[_Edge, bool]]] = {start: []}
    ahead = deque([start])
    while ahead:
        frame = ahead.popleft()
        for other, edge, forward in neighbours[frame]:
            if other not in ways and edge is not without:
                ways[other] = [*ways[frame], (edge, forward)]
                ahead.append(other)
    return ways


def _spelled(way: list[tuple[_Edge, bool]]) -> str:
    frames = [edge.child if forward else edge.parent for edge, forward in way[:-1]]
    return f"by {', '.join(map(repr, frames))}" if frames else "directly"


def _keep(edges: dict[tuple[str, str], _Edge], bag: Bag, message: Message, fixed: bool) -> None:
    for each in bag.parsed(message).transforms:
        key = (each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/"))
        edge = edges.setdefault(key, _Edge(*key))
        at, turn = each.transform.translation, each.transform.rotation
        numbers = (at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
        before = edge.flat[-7:]
        edge.is_fixed |= fixed
        if edge.is_fixed:
            edge.changes |= bool(before) and not np.allclose(before, numbers, rtol=0.0, atol=1e-9)
            del edge.flat[:]
        stamp, unstamped = bag.stamped(each.header, message)
        edge.unstamped += unstamped
        edge.flat.extend((stamp, *numbers))

"""Windows of a probe from the messages of a wrist sensor and of an arm, as they come.

    sampler = Sampler(probe_of(plan))
    for window in sampler.wrench(stamp, force_and_torque):  # and pose(stamp, world_from_peg) alike
        live.observe(window.action, window.observation)

A probe's stamps are stated before it begins: those of the plan that is about to be executed.
"""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.recordings.streams import Stream, poses_at, values_at
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors import Measurement


@dataclass
class Counts:
    """What was irregular in a stream.

    Attributes:
        repeated: messages with the stamp of another.
        unordered: messages that came after a later one, and are used.
        late: messages that came after their window was complete, and are not used.
        bridged: stamps that were interpolated over lost messages.
    """

    repeated: int = 0
    unordered: int = 0
    late: int = 0
    bridged: int = 0


class _Messages:
    """Messages of one stream, in the order of their stamps."""

    def __init__(self, width: int) -> None:
        self.width, self.counts = width, Counts()
        self.times: list[float] = []
        self.values: list[Array] = []

    def add(self, stamp: float, values: Array, done: float) -> None:
        place = bisect_left(self.times, stamp)
        if place < len(self.times) and self.times[place] == stamp:
            self.counts.repeated += 1
        elif stamp <= done:
            self.counts.late += 1
        else:
            self.counts.unordered += int(place < len(self.times))
            self.times.insert(place, stamp)
            self.values.insert(place, values)

    def stream(self, name: str) -> Stream:
        return Stream(name, np.array(self.times), np.array(self.values).reshape(-1, self.width))

    def forget(self, before: float) -> None:
        """Drop what no later stamp is interpolated from."""
        place = max(0, bisect_left(self.times, before) - 2)
        del self.times[:place], self.values[:place]


class Sampler:
    """Windows of a probe from messages of a wrist sensor and of an arm.

    Streams may have any rates; values at the probe's stamps are interpolated, or means of a faster stream
    (`bcppl.recordings.streams`). A window is complete when both streams have gone on for `patience` after its
    end, so that messages which are late by less may come in any order. What was irregular is counted. Streams
    may be given by a thread each, in arrays that are used again.

    Args:
        probe: its stamps are those of the windows, on the streams' clock.
        window: seconds of a window.
        patience: seconds that a message may be late.
        longest: seconds between two messages that are interpolated; a longer gap is refused.

    Attributes:
        counts: by stream, "wrench" and "pose".
        fault: where messages were lost for too long, that error: no window comes after it.

    Raises:
        InputError: a number is out of range.
    """

    def __init__(
        self, probe: Probe, *, window: float = 0.25, patience: float = 0.05, longest: float = 0.05
    ) -> None:
        number_within("windows are to last {} s", window, above=0.0)
        self.patience = number_within("messages may be late by {} s", patience, least=0.0)
        self.longest = number_within("gaps of {} s are to be interpolated", longest, above=0.0)
        self.probe = probe
        self._streams = {"wrench": _Messages(6), "pose": _Messages(7)}
        stamps = probe.stamps
        self._step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else None
        number = np.floor((stamps - stamps[0]) / window + 1e-6)
        self._ends = [*(np.flatnonzero(np.diff(number)) + 1).tolist(), len(stamps)]
        self._first, self._done = 0, -np.inf
        self._lock = threading.Lock()
        self.fault: InputError | None = None

    @property
    def counts(self) -> dict[str, Counts]:
        """What was irregular, by stream."""
        return {name: messages.counts for name, messages in self._streams.items()}

    @property
    def missing(self) -> int:
        """How many of the probe's stamps are in no window so far."""
        return len(self.probe.stamps) - self._first

    def wrench(self, stamp: float, wrench: Sequence[float] | Array) -> list[Measurement]:
        """One message of the wrist sensor, and the windows that are complete with it.

        Args:
            stamp: s.
            wrench: (6,) N and N m, of the environment on the peg, in the peg's frame about its origin.

        Raises:
            InputError: a number is not finite, or messages were lost for too long.
        """
        return self._add("wrench", stamp, np.array(wrench, dtype=np.float64))

    def pose(self, stamp: float, world_from_peg: Sequence[float] | Array) -> list[Measurement]:
        """One message of the arm, and the windows that are complete with it.

        Args:
            stamp: s.
            world_from_peg: (7,).

        Raises:
            InputError: it is no pose, or messages were lost for too long.
        """
        pose = poses.as_pose(np.asarray(world_from_peg, dtype=np.float64), "a message's world_from_peg")
        return self._add("pose", stamp, np.asarray(pose))

    def finish(self) -> list[Measurement]:
        """The windows that are complete without waiting any longer."""
        with self._lock:
            return [] if self.fault else self._complete(0.0)

    def _add(self, name: str, stamp: float, values: Array) -> list[Measurement]:
        if self.fault is not None:
            raise self.fault.with_traceback(None)  # which would grow with each message
        messages = self._streams[name]
        if values.shape != (messages.width,) or not (np.isfinite(values).all() and np.isfinite(stamp)):
            raise InputError(
                f"a {name} message at {stamp} s has values {values.tolist()}; give {messages.width} "
                "finite numbers."
            )
        with self._lock:
            messages.add(float(stamp), values, self._done)
            return self._complete(self.patience)

    def _complete(self, patience: float) -> list[Measurement]:
        windows: list[Measurement] = []
        while self._first < len(self.probe.stamps):
            last = next(end for end in self._ends if end > self._first)
            until = float(self.probe.stamps[last - 1])
            if not all(m.times and m.times[-1] >= until + patience for m in self._streams.values()):
                break
            try:
                windows.append(self._window(last, until))
            except InputError:
                if not windows or self.fault is None:
                    raise
                break  # what is complete counts; the next message is refused
        return windows

    def _window(self, last: int, until: float) -> Measurement:
        stamps = self.probe.stamps[self._first : last]
        streams = {name: self._known(name, stamps) for name in self._streams}
        wrench, pose = streams["wrench"], streams["pose"]
        touch = Touch(stamps, values_at(wrench, stamps, self._step), poses_at(pose, stamps, self._step))
        action = ProbeWindow(self.probe, self._first, last)
        self._first, self._done = last, until
        for messages in self._streams.values():
            messages.forget(until)
        return Measurement(action, touch)

    def _known(self, name: str, stamps: Array) -> Stream:
        """A stream that has messages around all stamps; those over lost ones are counted."""
        messages = self._streams[name]
        stream = messages.stream(name)
        times = stream.times
        if len(times) < 2 or times[0] > stamps[0]:
            raise InputError(
                f"the {name} stream begins at {times[0]:.3f} s, after the window's first stamp, "
                f"{stamps[0]:.3f} s; begin the probe when both streams have, and stamp both by one clock."
            )
        after = np.clip(np.searchsorted(times, stamps, side="left"), 1, len(times) - 1)
        gaps = times[after] - times[after - 1]
        if gaps.max() > self.longest:
            at = int(gaps.argmax())
            self.fault = InputError(
                f"the {name} stream has no message from {times[after[at] - 1]:.3f} to "
                f"{times[after[at]]:.3f} s, "
                "too long to interpolate a contact; begin another probe."
            )
            raise self.fault
        messages.counts.bridged += int((gaps > 1.5 * stream.step).sum())
        return stream

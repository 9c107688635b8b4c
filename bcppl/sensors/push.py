"""Pushes: a point finger is moved along a path until it touches, and its force is measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bcppl.arrays import Array, spanned
from bcppl.contact.touch import Touch
from bcppl.sensors import checks, touches
from bcppl.sensors.layout import POSE_UNITS, Layout, numbers
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.protocol import Indexed, register


@dataclass(frozen=True, eq=False, repr=False)
class Push:
    """Action: a point finger is moved along a path until, and beyond where, it touches.

    Attributes:
        times: (R,) seconds, increasing.
        world_from_tip: (R, 7) pose of the finger's tip.
    """

    times: Array
    world_from_tip: Array

    def __repr__(self) -> str:
        return f"Push({spanned(self.times)})"


class PushSensor:
    """Pushes of a point finger, each observed as a touch whose wrench is in the world's axes."""

    kind = "push"
    names = ("push", "pushes")
    contact = True
    action = Layout(Push, {"times": numbers("s"), "world_from_tip": numbers(POSE_UNITS)})
    observation = touches.TOUCH

    def problems(self, measurements: Indexed, recording: Recording) -> Iterator[tuple[int, str]]:
        """Problems of finger paths and wrenches, and of paths and wrenches on different clocks."""
        for index, measurement in measurements:
            wrong = _problems(f"measurement {index}", measurement.action, measurement.observation)
            yield from ((index, problem) for problem in wrong)

    def notes(self, measurements: Sequence[Measurement], recording: Recording) -> Iterator[str]:
        """A remark where no wrench was measured."""
        yield from touches.notes([m.observation for m in measurements])

    def describe(self, measurements: Sequence[Measurement], recording: Recording) -> list[tuple[str, str]]:
        """How long was pushed, and at which rates."""
        paths = touches.rate([m.action.times for m in measurements])
        length = touches.length([m.observation for m in measurements])
        return [("pushing", f"{length}, finger path at {paths}")]


def _problems(where: str, push: Push, touch: Touch) -> Iterator[str]:
    yield from checks.times(f"{where}'s finger path", push.times)
    yield from checks.poses(f"{where}'s finger path (world_from_tip)", push.world_from_tip, push.times)
    yield from touches.problems(where, touch, checks.LEAVE_OUT)
    yield from checks.readings(f"{where}'s wrench readings", touch.times)
    if push.times.ndim != 1 or touch.times.ndim != 1 or 0 in (push.times.size, touch.times.size):
        return
    if touch.times[-1] < push.times[0] or touch.times[0] > push.times[-1]:
        yield (
            f"{where}: wrench times {touch.times[0]:.3f} to {touch.times[-1]:.3f} s do not meet the "
            f"finger path's {push.times[0]:.3f} to {push.times[-1]:.3f} s; give both on one clock."
        )


register(PushSensor())

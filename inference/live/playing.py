"""A recording's measurements at the times at which they were made."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

from bcppl.arguments import number_within
from bcppl.sensors import Measurement, Recording


def play(
    recording: Recording,
    speed: float = 1.0,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Measurement]:
    """The measurements, each when it is complete by its own stamps; those without stamps at once.

    Args:
        recording: whose measurements are in the order in which they were made.
        speed: 2 for twice as fast, `math.inf` for all at once.
        clock: seconds that pass here.
        sleep: waits for so many of them.

    Raises:
        InputError: the speed is not positive.
    """
    if speed != math.inf:
        number_within("a recording is to be played at {} times its speed", speed, above=0.0)

    def playing() -> Iterator[Measurement]:
        begun = first = None
        for measurement in recording.measurements:
            stamps = getattr(measurement.observation, "times", None)
            if stamps is not None and len(stamps):
                if begun is None or first is None:
                    begun, first = clock(), float(stamps[0])
                left = (float(stamps[-1]) - first) / speed - (clock() - begun)
                if left > 0.0:
                    sleep(left)
            yield measurement

    return playing()

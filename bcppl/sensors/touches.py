"""Touches as probe windows and pushes observe them: their layout, their checks, their rows in a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bcppl.arrays import Array
from bcppl.contact.touch import Touch
from bcppl.sensors import checks
from bcppl.sensors.layout import POSE_UNITS, WRENCH_UNITS, Layout, numbers

MOST_FORCE = 1e4  # N or N m: beyond it a sensor would have been torn off, so the units are wrong

TOUCH = Layout(
    Touch, {"times": numbers("s"), "wrench": numbers(WRENCH_UNITS), "world_from_peg": numbers(POSE_UNITS)}
)


def problems(where: str, touch: Touch, remedy: str) -> Iterator[str]:
    """Problems of a touch's times and wrenches."""
    yield from checks.times(f"{where}'s wrench", touch.times, remedy)
    wrong = list(checks.rows(f"{where}'s wrench", touch.wrench, touch.times, "fx fy fz mx my mz", remedy))
    yield from wrong
    if wrong:
        return
    largest = np.abs(touch.wrench).max(axis=1)
    if (largest > MOST_FORCE).any():
        row = checks.first(largest > MOST_FORCE)
        yield f"{where} has a wrench of {largest[row]:.3g} at row {row}; give newtons and newton metres."


def notes(touches: Sequence[Touch]) -> Iterator[str]:
    """A remark on wrenches that never change: noise alone would change a sensor's last digit."""
    wrenches = [np.asarray(touch.wrench) for touch in touches]
    rows = np.concatenate([np.empty((0, 6)), *(each for each in wrenches if each.shape[1:] == (6,))])
    if len(rows) > 1 and (rows == rows[0]).all():
        wrench = " ".join(f"{value:g}" for value in rows[0] + 0.0)  # without a minus before a zero
        yield (
            f"no force was measured: the wrench is {wrench} in all {len(rows)} rows of all touches; see "
            "whether the sensor was on and which columns were read."
        )


def span(times: Array) -> float:
    """Seconds from the first time to the last, whatever the shape of times that have problems."""
    flat = np.ravel(times)
    return float(flat[-1] - flat[0]) if flat.size else 0.0


def rate(series: Sequence[Array]) -> str:
    """The rate of several series of times, in words: "500 Hz"."""
    steps = np.concatenate([np.diff(np.ravel(times)) for times in series])
    middle = float(np.median(steps)) if steps.size else 0.0
    return f"{1 / middle:.0f} Hz" if middle > 0 else "an unknown rate"


def length(touches: Sequence[Touch]) -> str:
    """The total length of touches and the rate of their wrenches, in words."""
    times = [touch.times for touch in touches]
    return f"{sum(map(span, times)):.1f} s, wrench at {rate(times)}"

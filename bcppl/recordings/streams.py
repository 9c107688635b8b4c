"""Streams of rows with stamps, and their values at common stamps.

A slow stream is interpolated at the stamps, a fast one averaged about them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from bcppl.arrays import Array, Mask
from bcppl.cached import cached_property

FAST = 1.5  # rows for each stamp: a faster stream is averaged
BRIDGED = 2.5  # median intervals that are interpolated, by default,
SHORTEST_BRIDGE = 0.01  # s, and at least these
LEAST_RATE, MOST_RATE = 100.0, 500.0  # stamps per second, if nothing else is stated


@dataclass(frozen=True, eq=False)
class Stream:
    """Rows of one sensor.

    Attributes:
        name: of the stream in the configuration.
        times: (T,) seconds on its own clock, increasing.
        values: (T, C).
    """

    name: str
    times: Array
    values: Array

    @cached_property
    def step(self) -> float:
        """The median interval, s."""
        return float(np.median(np.diff(self.times)))

    @property
    def rate(self) -> float:
        """Rows per second."""
        return 1.0 / self.step

    def shifted(self, by: float) -> Stream:
        """The same rows at stamps later by some seconds."""
        return replace(self, times=self.times + by)


def common_stamps(first: Stream, second: Stream, rate: float | None) -> Array:
    """Even stamps (T,) over the time that two streams share, from a stamp of the first on.

    By default the rate is that of the slower stream, from 100 to 500 a second.
    """
    if rate is None:
        rate = float(np.clip(min(first.rate, second.rate), LEAST_RATE, MOST_RATE))
    begin = max(first.times[0], second.times[0])
    begin = float(first.times[min(np.searchsorted(first.times, begin), len(first.times) - 1)])
    count = int(np.floor((min(first.times[-1], second.times[-1]) - begin) * rate + 1e-6)) + 1
    return np.asarray(begin + np.arange(max(count, 0)) / rate)


def is_known(stream: Stream, stamps: Array, longest: float | None) -> Mask:
    """Whether stamps (T,) lie in the stream, in no interval that is longer than what is interpolated (s)."""
    longest = max(BRIDGED * stream.step, SHORTEST_BRIDGE) if longest is None else longest
    after = np.searchsorted(stream.times, stamps, side="left")
    inside = (stamps >= stream.times[0] - 1e-9) & (stamps <= stream.times[-1] + 1e-9)
    after = np.clip(after, 1, len(stream.times) - 1)
    return np.asarray(inside & (stream.times[after] - stream.times[after - 1] <= longest))


def values_at(stream: Stream, stamps: Array, step: float | None = None) -> Array:
    """Values (T, C) at even stamps, of a fast stream the mean over the time from one stamp to the next.

    The mean is centred at the stamp, at the stream's ends over less time, and that of the straight lines
    between rows: it is right at any rate. `step` (s) is that from one stamp to the next, where these are some
    of more.
    """
    step = _step(stream, stamps) if step is None else step
    if step < FAST * stream.step:
        columns = [np.interp(stamps, stream.times, column) for column in stream.values.T]
        return np.stack(columns, axis=1)
    inside = np.clip(stamps, stream.times[0], stream.times[-1])
    left = np.minimum(inside - stream.times[0], stream.times[-1] - inside)
    half = np.clip(left, 0.01 * stream.step, 0.5 * step)
    low, high = np.maximum(inside - half, stream.times[0]), np.minimum(inside + half, stream.times[-1])
    means = [_integral(stream.times, c, high) - _integral(stream.times, c, low) for c in stream.values.T]
    return np.stack(means, axis=1) / (high - low)[:, None]


def _step(stream: Stream, stamps: Array) -> float:
    return float(stamps[1] - stamps[0]) if len(stamps) > 1 else stream.step


def poses_at(stream: Stream, stamps: Array, step: float | None = None) -> Array:
    """Poses (T, 7) at even stamps: positions as `values_at`, rotations along the geodesic, or their mean."""
    step = _step(stream, stamps) if step is None else step
    position = values_at(Stream(stream.name, stream.times, stream.values[:, :3]), stamps, step)
    if step < FAST * stream.step:
        turns = Rotation.from_quat(stream.values[:, [4, 5, 6, 3]])
        within = np.clip(stamps, stream.times[0], stream.times[-1])
        quaternion = Slerp(stream.times, turns)(within).as_quat()[:, [3, 0, 1, 2]]
    else:
        near = _near_each_other(stream.values[:, 3:])
        quaternion = values_at(Stream(stream.name, stream.times, near), stamps, step)
        quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    return np.concatenate([position, quaternion], axis=1)


def _near_each_other(quaternion: Array) -> Array:
    """Quaternions (T, 4) of the same rotations, each of the sign that is nearer to the one before."""
    turned = np.sign(np.sum(quaternion[1:] * quaternion[:-1], axis=1))
    return np.asarray(quaternion * np.append(1.0, np.cumprod(np.where(turned == 0.0, 1.0, turned)))[:, None])


def _integral(times: Array, values: Array, until: Array) -> Array:
    """The integrals (M,) of the straight lines between values (T,), from the first time until others (M,)."""
    sums = np.append(0.0, np.cumsum(0.5 * np.diff(times) * (values[1:] + values[:-1])))
    before = np.clip(np.searchsorted(times, until, side="right") - 1, 0, len(times) - 2)
    ahead = until - times[before]
    slope = (values[before + 1] - values[before]) / (times[before + 1] - times[before])
    return np.asarray(sums[before] + ahead * (values[before] + 0.5 * slope * ahead))

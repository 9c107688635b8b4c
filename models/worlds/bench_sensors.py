"""The errors of the bench's wrench sensor and joint encoders."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from bcppl.models.worlds.simulated_sensors import per_axis

if TYPE_CHECKING:
    from bcppl.models.worlds.bench import BenchParameters

Array = npt.NDArray[np.float64]

_WRENCH, _DRIFT, _POSE = range(5, 8)  # streams of random numbers, after those of `bcppl.models.worlds.bench`


class SensorErrors:
    """The errors of a scene's wrench sensor and joint encoders; the sensor's bias drifts from use to use.

    Attributes:
        bench: with the errors' standard deviations.
    """

    def __init__(self, bench: BenchParameters, seed: int) -> None:
        self.bench = bench
        self._bias = np.random.default_rng([seed, _WRENCH]).normal(size=6) * per_axis(
            bench.force_bias, bench.torque_bias
        )
        self._drift, self._noise = (np.random.default_rng([seed, _DRIFT, which]) for which in range(2))
        self._pose = np.random.default_rng([seed, _POSE])

    def sample(self, count: int, rate: float) -> tuple[Array, Array]:
        """The errors of the next `count` samples of the wrench (T, 6) and of the peg's pose (T, 6)."""
        bench, size = self.bench, (count, 6)
        pace = per_axis(bench.force_drift, bench.torque_drift) / math.sqrt(bench.drift_time * rate)
        drift = np.cumsum(self._drift.normal(size=size) * pace, axis=0)
        noise = self._noise.normal(size=size) * per_axis(bench.force_noise, bench.torque_noise)
        error = self._bias + drift + noise
        self._bias = self._bias + drift[-1]
        return error, self._pose.normal(size=size) * per_axis(bench.peg_noise, bench.peg_turn)

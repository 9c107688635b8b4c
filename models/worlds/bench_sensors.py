"""What the bench's wrench sensor and joints add to what they measure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from bcppl.models.worlds.bench import Bench

Array = npt.NDArray[np.float64]

_WRENCH, _DRIFT, _WOBBLE = range(5, 8)  # what is drawn apart, after what `bcppl.models.worlds.bench` draws


class SensorErrors:
    """What a scene's wrench sensor and joints add to their samples, whose zero walks on from use to use.

    Attributes:
        bench: how large the errors are.
    """

    def __init__(self, bench: Bench, seed: int) -> None:
        self.bench = bench
        self._zero = np.random.default_rng([seed, _WRENCH]).normal(size=6) * _six(
            bench.force_bias, bench.torque_bias
        )
        self._drift, self._noise = (np.random.default_rng([seed, _DRIFT, which]) for which in range(2))
        self._wobble = np.random.default_rng([seed, _WOBBLE])

    def drawn(self, count: int, rate: float) -> tuple[Array, Array]:
        """What is added to the next `count` samples of the wrench (T, 6) and of the peg's pose (T, 6)."""
        bench, size = self.bench, (count, 6)
        pace = _six(bench.force_drift, bench.torque_drift) / math.sqrt(bench.drift_time * rate)
        drift = np.cumsum(self._drift.normal(size=size) * pace, axis=0)
        noise = self._noise.normal(size=size) * _six(bench.force_noise, bench.torque_noise)
        error = self._zero + drift + noise
        self._zero = self._zero + drift[-1]
        return error, self._wobble.normal(size=size) * _six(bench.peg_noise, bench.peg_turn)


def _six(along: float, about: float) -> Array:
    return np.array([along] * 3 + [about] * 3)

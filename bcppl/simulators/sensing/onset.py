"""When contact begins: found in a force as it comes in, and then how surely it is known when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bcppl.errors import InputError

Array = npt.NDArray[np.float64]

_FINE = 0.05  # of the time between samples: the grid of onset times
_STEPS = (0.5, 1.0)  # samples in which a force may grow to what it stays at
_STEP = 0.01  # the prior probability of each of these; else the force grows on and on


@dataclass(frozen=True)
class Onset:
    """One contact in a signal.

    Attributes:
        alarm: the sample at which it was noticed.
        end: the first sample at which it is over; the signal's length where it lasts.
        time: when it began, seconds on the signal's clock: the start of the ramp that fits best.
        spread: standard deviation of that, seconds.
    """

    alarm: int
    end: int
    time: float
    spread: float


@dataclass(frozen=True)
class OnsetDetector:
    """Finds where a force leaves its noise.

    Zero and noise are those of the first samples. Contact is noticed where the force's multivariate
    cumulative sum (Crosier 1988, "Multivariate generalizations of cumulative sum quality-control schemes",
    Technometrics 30(3), the second scheme) exceeds `limit`, or, with a threshold, where the force does; it is
    over once the force falls below `release` times that. Only samples up to the present one decide. With the
    defaults and white Gaussian noise on three axes, one signal in a thousand of 2000 samples has a false
    alarm.

    When it began is computed once `after` more samples are there: the force is taken to be zero until the
    onset and then to grow evenly, in an unknown direction at an unknown rate, or (beforehand unlikely) to
    step within a sample; beforehand the onset is anywhere before the alarm.

    Attributes:
        rest: the number of first samples, free of contact.
        threshold: N; None for one that follows from the noise.
        drift: deviations by which the force may be off for ever without an alarm: a zero that wanders.
        limit: deviations that the cumulative sum may reach.
        release: share of the threshold, or of `limit` deviations, below which contact is over.
        resolution: N: the noise is taken to be at least this; a sensor's least count, say.
        before: samples ahead of the alarm among which the onset is looked for.
        after: samples beyond the alarm that the ramp is fitted to.
    """

    rest: int = 10
    threshold: float | None = None
    drift: float = 2.5
    limit: float = 10.0
    release: float = 0.5
    resolution: float = 0.0
    before: int = 20
    after: int = 2

    def __post_init__(self) -> None:
        positive = (self.drift, self.limit, *(() if self.threshold is None else (self.threshold,)))
        if self.rest < 5 or self.before < 1 or self.after < 0 or not min(positive) > 0:
            raise InputError(
                f"an onset is looked for with rest {self.rest}, before {self.before}, after {self.after}, "
                f"drift {self.drift}, limit {self.limit}, threshold {self.threshold}; give rest 5 or more, "
                "before 1 or more, after 0 or more, and the others above 0."
            )
        if not 0 < self.release <= 1 or not self.resolution >= 0:
            raise InputError(
                f"an onset has release {self.release} and resolution {self.resolution}; "
                "give a share up to 1, and newtons, 0 or more."
            )

    def onsets(self, times: Array, force: Array) -> list[Onset]:
        """All contacts in a signal, in order; none where nothing is touched.

        Args:
            times: (T,) seconds, increasing.
            force: (T, D) raw, newtons, or any other quantity that contact moves.

        Raises:
            InputError: shapes do not fit, a number is not finite, there are no more samples than `rest`, or
                these are all equal and `resolution` is 0.
        """
        times, force = np.asarray(times, dtype=np.float64), np.asarray(force, dtype=np.float64)
        if force.ndim != 2 or times.shape != force.shape[:1] or len(times) <= self.rest:
            raise InputError(
                f"a force of shape {force.shape} at times {times.shape} is too short or does not fit; "
                f"give (T, axes) and (T,), T above {self.rest}."
            )
        if not np.isfinite(force).all() or not (np.diff(times) > 0).all():
            raise InputError(
                "a force is not finite, or its times do not increase; mend the log before onsets are sought."
            )
        calm = force[: self.rest]
        variance = calm.var(axis=0, ddof=1).mean()
        noise = max(float(np.sqrt(variance)), self.resolution)
        if noise == 0.0:
            raise InputError(
                f"the first {self.rest} samples of a force are all equal; set resolution to the sensor's."
            )
        scaled = (force - calm.mean(axis=0)) / noise
        size = np.linalg.norm(scaled, axis=1)
        level = self.limit if self.threshold is None else self.threshold / noise
        found, sample = [], self.rest
        while (alarm := self._alarm(scaled, size, sample, level)) is not None:
            over = np.flatnonzero(size[alarm:] < self.release * level)
            end = alarm + int(over[0]) if over.size else len(size)
            found.append(Onset(alarm, end, *self._began(times, scaled, sample, alarm)))
            sample = end
        return found

    def _alarm(self, scaled: Array, size: Array, first: int, level: float) -> int | None:
        """The first sample from `first` on at which contact is noticed."""
        if self.threshold is not None:
            above = np.flatnonzero(size[first:] > level)
            return first + int(above[0]) if above.size else None
        total = np.zeros(scaled.shape[1])
        for k in range(first, len(scaled)):
            total = total + scaled[k]
            length = float(np.linalg.norm(total))
            total = total * max(0.0, 1.0 - self.drift / length) if length > 0 else total
            if length - self.drift > level:
                return k
        return None

    def _began(self, times: Array, scaled: Array, free: int, alarm: int) -> tuple[float, float]:
        """Mean and deviation of the onset's time, for an alarm at a sample and no contact at `free`."""
        first = max(alarm - self.before, min(free, alarm - 1), 0)
        seen, at = scaled[first : alarm + self.after + 1], times[first : alarm + self.after + 1]
        step = float(np.median(np.diff(at)))
        onset = np.arange(times[first], times[alarm] - 0.5 * _FINE * step, _FINE * step)
        risen = np.maximum(at - onset[:, None], 0.0) / step
        ramp = np.concatenate([np.minimum(risen / rise, 1.0) for rise in _STEPS] + [risen])
        # The zero is the mean of `rest` samples and errs alike in all that are seen (Woodbury's identity).
        known = self.rest + len(seen)
        power = np.square(ramp).sum(axis=1) - ramp.sum(axis=1) ** 2 / known
        fit = ramp @ seen - ramp.sum(axis=1)[:, None] * seen.sum(axis=0) / known
        # The force in the end is beforehand normal, as wide as the largest seen; so is the rate, per sample.
        rate = float(np.linalg.norm(seen, axis=1).max()) ** 2
        log_p = 0.5 * np.square(fit).sum(axis=1) / (power + 1.0 / rate)
        log_p -= 0.5 * scaled.shape[1] * np.log1p(rate * power)
        log_p[: -len(onset)] += np.log(_STEP)
        weight = np.exp(log_p - log_p.max()).reshape(-1, len(onset)).sum(axis=0)
        weight /= weight.sum()
        mean = float(weight @ onset)
        spread = float(np.sqrt(weight @ np.square(onset - mean) + (_FINE * step) ** 2 / 12.0))
        return mean, spread

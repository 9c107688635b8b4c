"""Contact onset detection: when a force leaves its noise, and the posterior of the time of onset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln, ive

from bcppl.arguments import number_within, whole_number
from bcppl.arrays import Array
from bcppl.errors import InputError

_FINE = 0.05  # of the time between samples: the grid of onset times
_STEPS = {0.0: 0.2, 0.5: 0.05, 1.0: 0.05}  # prior of rise times to a constant force, in samples
_RATES = np.geomspace(1.0, 1e-3, 7)  # of a growing force, in largest forces per sample, equally likely
_QUIET = 10.0  # nats by which noise must explain the force better than contact does at its end
_LARGEST = 1e4  # standard deviations at which a force is clipped


@dataclass(frozen=True)
class Onset:
    """One contact in a signal.

    Attributes:
        alarm: the sample at which it is detected.
        end: the first sample after it; the signal's length where it lasts.
        time: posterior mean of the time of onset, seconds on the signal's clock.
        standard_deviation: of that time, seconds.
    """

    alarm: int
    end: int
    time: float
    standard_deviation: float


@dataclass(frozen=True)
class OnsetDetector:
    """Detects where a force leaves its noise.

    Zero and noise are estimated from the first samples. Contact is detected where the force's multivariate
    cumulative sum (Crosier 1988, "Multivariate generalizations of cumulative sum quality-control schemes",
    Technometrics 30(3), the second scheme) exceeds `limit`, or, with a threshold, where the force does. An
    alarm depends on no later sample. With the defaults and white Gaussian noise on three axes, one signal in
    a thousand of 2000 samples has a false alarm.

    The end of a contact is detected by the cumulative sum of the opposite test (Page 1954, "Continuous
    inspection schemes", Biometrika 41): whether noise alone explains the forces better, by 10 nats, than a
    force of `drift` standard deviations in any direction. So a lasting force is one contact, strong or weak.
    With a threshold the contact ends where the force stays below `release` times that for `quiet` samples.
    The end is detected some samples after `end`: about eight, or `quiet`.

    The time of onset has a posterior given `after` more samples: the force is zero until the onset and then
    grows linearly, in an unknown direction at an unknown rate, or rises to a constant within a sample. The
    prior is uniform over the samples before the alarm.

    In 93 to 99 % of simulated contacts the error of that time was less than two of the stated standard
    deviations. After a step it is a little early, because a force may also grow within a sample. The noise
    estimated from ten samples is off by a seventh and more: use more where there are.

    Attributes:
        rest: the number of first samples, free of contact.
        threshold: N; None for one that follows from the noise.
        drift: error of the zero, in standard deviations, that never raises an alarm.
        limit: of the cumulative sum, in standard deviations.
        release: share of the threshold below which contact ends.
        quiet: samples for which the force must stay below that.
        resolution: N; lower bound of the noise, such as a sensor's quantum.
        before: samples before the alarm among which the onset may be.
        after: samples after the alarm that the posterior uses.

    Raises:
        InputError: a setting is no number, not finite or out of range.
    """

    rest: int = 10
    threshold: float | None = None
    drift: float = 2.5
    limit: float = 10.0
    release: float = 0.5
    quiet: int = 3
    resolution: float = 0.0
    before: int = 60
    after: int = 2

    def __post_init__(self) -> None:
        for name, least in (("rest", 5), ("quiet", 1), ("before", 1), ("after", 0)):
            whole_number(f"an onset detector has {name} = {{}}", getattr(self, name), least=least)
        for name in ("drift", "limit", *(() if self.threshold is None else ("threshold",))):
            number_within(f"an onset detector has {name} = {{}}", getattr(self, name), above=0.0)
        number_within("an onset detector has release = {}", self.release, above=0.0, most=1.0)
        number_within("an onset detector has resolution = {}", self.resolution, least=0.0)

    def onsets(self, times: Array, force: Array) -> list[Onset]:
        """The contacts in a signal, in order.

        Args:
            times: (T,) seconds, increasing.
            force: (T, D) raw, newtons, or any other quantity that contact changes. Leading rows that are not
                finite, as `ContactSensing.tared` returns them while taring, are ignored but counted.

        Raises:
            InputError: times do not increase, a later number is not finite, there are no more samples than
                `rest`, or these are all equal and `resolution` is 0.
        """
        times, force = np.asarray(times, dtype=np.float64), np.asarray(force, dtype=np.float64)
        finite = np.asarray(np.isfinite(force).all(axis=1))
        lead = int(finite.argmax()) if finite.any() else len(finite)
        if len(times) - lead <= self.rest:
            raise InputError(
                f"a force has {len(times) - lead} finite samples; it is too short for {self.rest} at rest."
            )
        if not finite[lead:].all():
            raise InputError(
                f"a force is not finite at row {lead + int((~finite[lead:]).argmax())}; cut it there."
            )
        if not (np.diff(times) > 0).all():
            raise InputError("a force's times do not increase; sort its rows and drop duplicates.")
        return [
            replace(onset, alarm=onset.alarm + lead, end=onset.end + lead)
            for onset in self._detected(times[lead:], force[lead:])
        ]

    def _detected(self, times: Array, force: Array) -> list[Onset]:
        rest = force[: self.rest]
        variance = rest.var(axis=0, ddof=1).mean()
        noise = max(float(np.sqrt(variance)), self.resolution)
        if noise == 0.0:
            raise InputError(
                f"the first {self.rest} samples of a force are all equal; set resolution to the sensor's."
            )
        scaled = (force - rest.mean(axis=0)) / noise
        size = np.linalg.norm(scaled, axis=1)
        level = self.limit if self.threshold is None else self.threshold / noise
        onsets, sample = [], self.rest
        while (alarm := self._alarm(scaled, size, sample, level)) is not None:
            end = self._end(size, scaled.shape[1], alarm + 1, self.release * level)
            onsets.append(Onset(alarm, end, *self._onset_time(times, scaled, sample, alarm)))
            sample = end
        return onsets

    def _end(self, size: Array, axes: int, first: int, level: float) -> int:
        """The first sample from `first` on without contact, of magnitudes (T,) in standard deviations."""
        if self.threshold is not None:
            if len(size) - first < self.quiet:  # too few samples to end a contact
                return len(size)
            low = np.convolve(size[first:] < level, np.ones(self.quiet), mode="valid") > self.quiet - 0.5
            return first + int(low.argmax()) if low.any() else len(size)
        # log 0F1(; D/2; z^2/4), the logarithm of the mean of exp(z cos) over all directions.
        z, order = self.drift * np.clip(size[first:], 1e-9, _LARGEST), 0.5 * axes - 1.0
        mean = np.log(ive(order, z)) + z + gammaln(order + 1.0) - order * np.log(0.5 * z)
        total, begin = 0.0, first
        for k, gain in enumerate(0.5 * self.drift**2 - mean, first):
            total += gain
            if total <= 0.0:
                total, begin = 0.0, k + 1
            elif total > _QUIET:
                return begin
        return len(size)

    def _alarm(self, scaled: Array, size: Array, first: int, level: float) -> int | None:
        """The first sample from `first` on at which contact is detected."""
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

    def _onset_time(self, times: Array, scaled: Array, free: int, alarm: int) -> tuple[float, float]:
        """Mean and standard deviation of the time of onset, for an alarm at a sample and none at `free`."""
        first = max(alarm - self.before, min(free, alarm - 1), 0)
        used, at = scaled[first : alarm + self.after + 1], times[first : alarm + self.after + 1]
        step = float(np.median(np.diff(at)))
        onset = np.arange(times[first], times[alarm] - 0.5 * _FINE * step, _FINE * step)
        risen = np.maximum(at - onset[:, None], 0.0) / step
        # Priors: the final force is normal, of the largest one's scale; the rate per sample is a mixture of
        # normals of several scales, for a single one would favour early onsets or late ones.
        largest = float(np.linalg.norm(used, axis=1).max()) ** 2
        ramps = [
            (np.minimum(risen / max(rise, 1e-9), 1.0), [largest], prior) for rise, prior in _STEPS.items()
        ]
        growing = (1.0 - sum(_STEPS.values())) / len(_RATES)
        ramps.append((risen, [largest * share**2 for share in _RATES], growing))
        log_p = np.concatenate(
            [np.log(prior) + self._log_evidence(used, ramp, sizes) for ramp, sizes, prior in ramps]
        )
        weight = np.exp(log_p - log_p.max()).sum(axis=0)
        weight /= weight.sum()
        mean = float(weight @ onset)
        variance = weight @ np.square(onset - mean) + (_FINE * step) ** 2 / 12.0
        return mean, float(np.sqrt(variance))

    def _log_evidence(self, force: Array, ramp: Array, variances: Sequence[float]) -> Array:
        """Log-evidence (V, G) of ramps (G, n) in forces (n, D), their height normal with V variances."""
        # The error of the zero, the mean of `rest` samples, is common to all forces (Woodbury's identity).
        known = self.rest + len(force)
        power = np.square(ramp).sum(axis=1) - ramp.sum(axis=1) ** 2 / known
        fit = ramp @ force - ramp.sum(axis=1)[:, None] * force.sum(axis=0) / known
        square = 0.5 * np.square(fit).sum(axis=1)
        return np.stack(
            [square / (power + 1.0 / v) - 0.5 * force.shape[1] * np.log1p(v * power) for v in variances]
        )

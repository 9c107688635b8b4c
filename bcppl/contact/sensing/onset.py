"""When contact begins: found in a force as it comes in, and then how surely it is known when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import gammaln, ive

from bcppl.arguments import number_within, whole_number
from bcppl.errors import InputError

Array = npt.NDArray[np.float64]

_FINE = 0.05  # of the time between samples: the grid of onset times
_STEPS = {0.0: 0.2, 0.5: 0.05, 1.0: 0.05}  # samples in which a force may grow to what it stays at: how likely
_RATES = np.geomspace(1.0, 1e-3, 7)  # shares of the largest force that a sample may add, all equally likely
_QUIET = 10.0  # nats by which nothing must explain the force better than a contact does, for it to be over
_LARGEST = 1e4  # deviations beyond which a force is no surer


@dataclass(frozen=True)
class Onset:
    """One contact in a signal.

    Attributes:
        alarm: the sample at which it was noticed.
        end: the first sample at which it is over; the signal's length where it lasts.
        time: when it began, seconds on the signal's clock: the mean of what the force says of it.
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
    Technometrics 30(3), the second scheme) exceeds `limit`, or, with a threshold, where the force does. Only
    samples up to the present one decide. With the defaults and white Gaussian noise on three axes, one signal
    in a thousand of 2000 samples has a false alarm.

    It is over once the cumulative sum of the opposite question says so (Page 1954, "Continuous inspection
    schemes", Biometrika 41): whether noise alone explains the forces better, by 10 nats, than one of `drift`
    deviations in any direction. So a force that lasts is one contact, whether it is strong or hardly seen.
    With a threshold it is over once the force stays below `release` times that for `quiet` samples. That it
    is over is known some samples after `end`: eight or so, or `quiet`.

    When it began is computed once `after` more samples are there: the force is taken to be zero until the
    onset and then to grow evenly, in an unknown direction at a rate of unknown size, or to step
    within a sample; beforehand the onset is anywhere before the alarm.

    Measured on 1000 contacts each, on three axes of white noise, at any time between two samples, ten samples
    at rest (z is the time's error over `spread`, errors in samples):

        force, in deviations           error       spread         z        |z| < 2
        steps to 8                 -0.12 (0.32)     0.33    -0.35 (0.96)    98.9 %
        steps to 4                 -0.58 (1.19)     1.25    -0.41 (0.96)    97.5 %
        grows by 0.3 in a sample    0.07 (2.07)     2.06     0.18 (1.18)    93.7 %
        grows by 1 in a sample     -0.01 (0.86)     0.82     0.08 (1.11)    93.0 %
        grows by 4 in a sample     -0.03 (0.25)     0.24    -0.06 (1.08)    93.7 %

    In the brackets are standard deviations. After a step, `time` is between the last sample before it and the
    first one after it, for nothing tells more; it is a little early, for a force may also grow within a
    sample. A noise that is judged by ten samples is off by a seventh and more: give it more where there are.

    Attributes:
        rest: the number of first samples, free of contact.
        threshold: N; None for one that follows from the noise.
        drift: deviations by which the force may be off for ever without an alarm: a zero that wanders.
        limit: deviations that the cumulative sum may reach.
        release: share of the threshold below which contact is over.
        quiet: samples for which the force must stay below that.
        resolution: N: the noise is taken to be at least this; a sensor's least count, say.
        before: samples ahead of the alarm among which the onset is looked for.
        after: samples beyond the alarm that the ramp is fitted to.

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
            whole_number(f"an onset is looked for with {name} = {{}}", getattr(self, name), least=least)
        for name in ("drift", "limit", *(() if self.threshold is None else ("threshold",))):
            number_within(f"an onset is looked for with {name} = {{}}", getattr(self, name), above=0.0)
        number_within("an onset is looked for with release = {}", self.release, above=0.0, most=1.0)
        number_within("an onset is looked for with resolution = {}", self.resolution, least=0.0)

    def onsets(self, times: Array, force: Array) -> list[Onset]:
        """All contacts in a signal, in order; none where nothing is touched.

        Args:
            times: (T,) seconds, increasing.
            force: (T, D) raw, newtons, or any other quantity that contact moves. Rows that are not finite
                before the first that is, as `Sensing.tared` gives them while taring, are passed over; samples
                are counted from the first row all the same.

        Raises:
            InputError: shapes do not fit, a later number is not finite, there are no more samples than
                `rest`, or these are all equal and `resolution` is 0.
        """
        times, force = np.asarray(times, dtype=np.float64), np.asarray(force, dtype=np.float64)
        if force.ndim != 2 or times.shape != force.shape[:1]:
            raise InputError(
                f"a force of shape {force.shape} at times {times.shape} does not fit; "
                "give (T, axes) and (T,)."
            )
        told = np.asarray(np.isfinite(force).all(axis=1))
        lead = int(told.argmax()) if told.any() else len(told)
        if len(times) - lead <= self.rest:
            raise InputError(
                f"a force of {len(times) - lead} samples is too short, or not finite; give more than the "
                f"{self.rest} at rest."
            )
        if not told[lead:].all():
            raise InputError(
                f"a force is not finite at row {lead + int((~told[lead:]).argmax())}; fill it by "
                "interpolation, or cut the signal there."
            )
        if not (np.diff(times) > 0).all():
            raise InputError("a force's times do not increase; sort its rows and drop doubles.")
        return [
            Onset(onset.alarm + lead, onset.end + lead, onset.time, onset.spread)
            for onset in self._found(times[lead:], force[lead:])
        ]

    def _found(self, times: Array, force: Array) -> list[Onset]:
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
            end = self._over(size, scaled.shape[1], alarm + 1, self.release * level)
            found.append(Onset(alarm, end, *self._began(times, scaled, sample, alarm)))
            sample = end
        return found

    def _over(self, size: Array, axes: int, first: int, level: float) -> int:
        """The first sample from `first` on at which contact is over, of sizes (T,) in deviations."""
        if self.threshold is not None:
            low = np.convolve(size[first:] < level, np.ones(self.quiet), mode="valid") > self.quiet - 0.5
            # Fewer samples than `quiet` are left at the end: too few to say.
            return first + int(low.argmax()) if len(size) - first >= self.quiet and low.any() else len(size)
        # log 0F1(; D/2; z^2/4): of the mean, over all directions, of exp(z cos).
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
        # The force in the end is beforehand normal, as wide as the largest seen; the rate, per sample, normal
        # too, but how wide is not known: one width only would favour early onsets or late ones.
        largest = float(np.linalg.norm(seen, axis=1).max()) ** 2
        shapes = [
            (np.minimum(risen / max(rise, 1e-9), 1.0), largest, likely) for rise, likely in _STEPS.items()
        ]
        growing = (1.0 - sum(_STEPS.values())) / len(_RATES)
        shapes += [(risen, largest * share**2, growing) for share in _RATES]
        log_p = np.stack([np.log(weight) + self._fit(seen, ramp, wide) for ramp, wide, weight in shapes])
        weight = np.exp(log_p - log_p.max()).sum(axis=0)
        weight /= weight.sum()
        mean = float(weight @ onset)
        spread = float(np.sqrt(weight @ np.square(onset - mean) + (_FINE * step) ** 2 / 12.0))
        return mean, spread

    def _fit(self, seen: Array, ramp: Array, wide: float) -> Array:
        """Log-evidence (G,) of ramps (G, n) in forces (n, D), their height normal, of variance `wide`."""
        # The zero is the mean of `rest` samples and errs alike in all that are seen (Woodbury's identity).
        known = self.rest + len(seen)
        power = np.square(ramp).sum(axis=1) - ramp.sum(axis=1) ** 2 / known
        fit = ramp @ seen - ramp.sum(axis=1)[:, None] * seen.sum(axis=0) / known
        log_p = 0.5 * np.square(fit).sum(axis=1) / (power + 1.0 / wide)
        return np.asarray(log_p - 0.5 * seen.shape[1] * np.log1p(wide * power), dtype=np.float64)

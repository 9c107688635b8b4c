"""How late the wrench's stamps are relative to the pose's: stated, or estimated from contacts.

By the paths about onsets and releases of contacts, where a peg comes to rest on a part and leaves it
(`resting`): first every 2 ms, then where it is not improbable.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from bcppl.arrays import Array
from bcppl.recordings.importers.bench.configuration.field_types import factor
from bcppl.recordings.importers.bench.configuration.fields import ClockFields
from bcppl.recordings.importers.bench.contacts import Contact, contacts
from bcppl.recordings.importers.bench.resting import COMPLIANCES, log_evidence
from bcppl.recordings.streams import Stream

_WITHIN = 0.1  # s: the largest lateness, either way, that is looked for
_COARSE, _FINE = 0.002, 0.0005  # s between latenesses
_THIN = 0.004, 0.002  # s between rows of the path, at least: first, and where it counts
_IMPROBABLE = 8.0  # nats
_WIDEST = 0.08  # s over which probable latenesses may lie to be looked at more closely
_LEAST_NOISE = 2e-5  # m: paths differ by as much from what is made of them
# Standard deviation of the logarithm of compliances of contacts, in steps of `resting.COMPLIANCES`.
_ALIKE = 0.35 / np.diff(np.log(COMPLIANCES[1:3]))[0]
# Of the evidence: what makes one contact unlike the model (friction, a tip of rubber, a filter) makes all so.
_POWER = 0.3
_LEAST = 0.001  # s of a lateness's standard deviation: a contact is not quite a damped spring
# Of the interval of poses, between which a path is not known; s, from which on more so.
_BLIND, _SLOW = 0.4, 0.004
_DRIFT, _DRIFTS = 5e-5, np.linspace(-2e-4, 2e-4, 41)  # s/s: standard deviation of a drift, and its values
MOST_CONTACTS = 24
KNOWN = 0.004  # s: a lateness of a larger standard deviation is not taken off


@dataclass(frozen=True)
class Lateness:
    """How late a force's clock is.

    Attributes:
        late: s, at the time `at` (s) on the force's clock.
        spread: its standard deviation, s.
        drift: of the force's clock against the path's, s/s.
        drift_spread: its standard deviation.
        at: s.
        contacts: how many it is estimated from, beginnings and ends.
    """

    late: float
    spread: float
    drift: float
    drift_spread: float
    at: float
    contacts: int


def on_one_clock(
    wrench: Stream, force: Stream | None, position: Stream, fields: ClockFields, report: list[str]
) -> Stream:
    """The wrench at stamps on the pose's clock.

    Args:
        wrench: on its own clock.
        force: (T, 3) in the world's axes at even stamps of that clock, `contacts.STEP` apart, zero in free
            air; None where the streams share no time.
        position: (P, 3) of the peg in the world, on the pose's clock.
        fields: what is stated.
        report: to which a line is added.
    """
    unit = factor(fields.unit)
    if fields.wrench_late is not None:
        late, drift = unit * fields.wrench_late, 1e-6 * fields.drift
        report.append(f"clocks: the wrench is {1000.0 * late:.4g} ms late, as stated, which is taken off")
        start = float(position.times[0])
        return replace(wrench, times=start + (wrench.times - late - start) / (1.0 + drift))
    within = _WITHIN if fields.within is None else unit * fields.within
    found = None if force is None else lateness(force, position, within, fields.estimate != "offset")
    if found is None or found.spread > KNOWN:
        report.append(_unknown(found, within))
        return wrench
    words = f"clocks: the wrench is {1000.0 * found.late:.1f} ± {1000.0 * found.spread:.1f} ms late"
    if fields.estimate != "offset":
        words += f" and drifts by {1e6 * found.drift:.0f} ± {1e6 * found.drift_spread:.0f} ppm"
    report.append(f"{words}, by {found.contacts} contacts, which is taken off")
    times = wrench.times - found.late
    return replace(wrench, times=times - found.drift * (wrench.times - found.at))


def _unknown(found: Lateness | None, within: float) -> str:
    low, high = -1000.0 * within, 1000.0 * within
    if found is not None:
        low = max(low, 1000.0 * (found.late - 2.0 * found.spread))
        high = min(high, 1000.0 * (found.late + 2.0 * found.spread))
    return (
        f"clocks: the motion does not show how late the wrench is (from {low:.0f} to {high:.0f} ms), and "
        "nothing is taken off; state clock.wrench_late, or log straight guarded touches at 20 mm/s and more"
    )


def lateness(force: Stream, position: Stream, within: float, drifts: bool = False) -> Lateness | None:
    """How late a force is relative to a path; None where there is no contact.

    In twelve simulated logs of three or four touches (wrench at 1 kHz, poses at 500 Hz that scatter by 20 and
    50 um, lateness from -50 to 50 ms) by an arm whose structure yields by 20 um/N the error was 0.2 ms in the
    median and 0.6 at most, where spreads of 1.3 ms were stated; where the structure does not yield, 1.6 and
    5.5, where 1.4 to 10 were stated. In 88 logs of arms that stop by command, rub, bounce, or have
    filters and tips of rubber no error exceeded 3.1 times what was stated, and half of them 0.5 times.

    Args:
        force: (T, 3) in the world's axes, N, at even stamps `contacts.STEP` apart, zero in free air.
        position: (P, 3) of the peg in the world, m.
        within: the largest lateness, either way, s.
        drifts: whether the clocks drift apart.
    """
    noise = float(np.median(np.abs(np.diff(position.values, n=2, axis=0)))) / (0.6745 * 6.0**0.5)
    noise = max(noise, _LEAST_NOISE)
    ways = [_Way.of(force, position, released) for released in (False, True)]
    count = sum(len(way.contacts) for way in ways)
    if not count:
        return None
    middle = float(np.mean([time for way in ways for time in way.times]))
    coarse, fine = ([replace(way, position=_thinned(way.position, step)) for way in ways] for step in _THIN)
    steps = round(within / _COARSE)
    lates = np.asarray(_COARSE * np.arange(-steps, steps + 1))
    weight = _summed([way.evidence(noise, lates) for way in coarse])
    probable = lates[weight > weight.max() - _IMPROBABLE]
    low, high = probable[0] - _COARSE, probable[-1] + _COARSE
    rates, drift_variance = np.zeros(1), float(drifts) * _DRIFT**2
    if high - low < _WIDEST:
        rates = _DRIFTS if drifts else rates
        farthest = max(abs(time - middle) for way in ways for time in way.times) * rates.max()
        margin = int(np.ceil(farthest / _FINE))
        first, last = round(low / _FINE) - margin, round(high / _FINE) + margin
        lates = np.asarray(_FINE * np.arange(first, last + 1))
        each = np.concatenate([way.evidence(noise, lates) for way in fine])
        behind = np.concatenate([way.times for way in ways]) - middle
        lates = lates[margin : len(lates) - margin]
        weights = np.stack([_summed([_shifted(each, rate * behind / _FINE, margin)]) for rate in rates])
        weights -= 0.5 * np.square(rates / _DRIFT)[:, None]
    else:
        weights = weight[None]
    share = np.exp(weights - weights.max())
    share /= share.sum()
    late, drift = share.sum(axis=0) @ lates, share.sum(axis=1) @ rates
    variance = share.sum(axis=0) @ np.square(lates - late)
    if len(rates) > 1:
        drift_variance = share.sum(axis=1) @ np.square(rates - drift)
    blind = _BLIND * position.step * max(1.0, position.step / _SLOW)
    return Lateness(
        late=float(late),
        spread=float(np.sqrt(variance + _LEAST**2 + np.square(blind))),
        drift=float(drift),
        drift_spread=float(np.sqrt(drift_variance)),
        at=middle,
        contacts=count,
    )


@dataclass(frozen=True, eq=False)
class _Way:
    """Contacts and the path forwards, or backwards in time."""

    contacts: list[Contact]
    position: Stream
    released: bool

    @classmethod
    def of(cls, force: Stream, position: Stream, released: bool) -> _Way:
        if released:
            force, position = _reversed(force), _reversed(position)
        each = list(contacts(force))
        return cls(each[:: -(-len(each) // MOST_CONTACTS)] if each else [], position, released)

    @property
    def times(self) -> Array:
        """Of the contacts (K,), s on the force's clock."""
        times = np.array([contact.time for contact in self.contacts])
        return -times if self.released else times

    def evidence(self, noise: float, lates: Array) -> Array:
        """Its logarithm (K, L, ...) by contact, lateness and what yields."""
        lates = -lates if self.released else lates
        return log_evidence(self.contacts, self.position, noise, lates, released=self.released)


def _reversed(stream: Stream) -> Stream:
    return replace(stream, times=-stream.times[::-1], values=stream.values[::-1])


def _thinned(stream: Stream, step: float) -> Stream:
    every = max(1, round(step / stream.step))
    return replace(stream, times=stream.times[::every], values=stream.values[::every])


def _summed(evidence: list[Array]) -> Array:
    """The logarithm (L,) of the evidence of latenesses, over all contacts and what yields."""
    each = np.concatenate(evidence)
    most = each.max(axis=3, keepdims=True)
    # Contacts differ a little in what yields: what is shared alone makes a lateness surer than it is.
    alike = gaussian_filter1d(np.exp(each - most), _ALIKE, axis=3, mode="nearest")
    total = (np.log(np.maximum(alike, 1e-300)) + most).sum(axis=0)
    return np.asarray(np.logaddexp.reduce(_POWER * total.reshape(len(total), -1), axis=1))


def _shifted(evidence: Array, by: Array, margin: int) -> Array:
    """The evidence (K, L, ...) at latenesses later `by` (K,) steps, which lie `margin` within the given."""
    size = evidence.shape[1] - 2 * margin
    rows = []
    for each, steps in zip(evidence, by, strict=True):
        whole = int(np.floor(steps))
        share, first = steps - whole, margin + whole
        after = each[min(first + 1, len(each) - size) :][:size]
        rows.append((1.0 - share) * each[first : first + size] + share * after)
    return np.stack(rows)

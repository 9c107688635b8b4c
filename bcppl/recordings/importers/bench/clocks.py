"""How late the wrench's stamps are relative to the pose's: stated, or estimated from contacts.

By the paths about the onsets of contacts, where a peg comes to rest on a part (`resting`): first every 2 ms,
then where it is not improbable. Releases are left out: an arm that presses like a spring and is withdrawn
smoothly has begun to move so long before it leaves the part that all of them seem too early.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from bcppl.arrays import Array
from bcppl.contact.sensing.noise import position_noise
from bcppl.recordings.importers.bench.configuration.field_types import factor
from bcppl.recordings.importers.bench.configuration.fields import ClockFields
from bcppl.recordings.importers.bench.contacts import contacts
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
# s from an estimate, beyond which no lateness may have more than a share of its evidence. A path that stops
# where the force begins, and one that stops where it is full, differ by a stiff part or a soft one: each
# explains most of the other, and a little friction or inertia decides.
_FAR, _RIVAL = 0.01, 0.45
_DRIFT, _DRIFTS = 5e-5, np.linspace(-2e-4, 2e-4, 41)  # s/s: standard deviation of a drift, and its values
MOST_CONTACTS = 24
_KNOWN = 0.004  # s: a lateness of a larger standard deviation is not known


@dataclass(frozen=True)
class Lateness:
    """How late a force's clock is.

    Attributes:
        late: s, at the time `at` (s) on the force's clock.
        spread: its standard deviation, s.
        drift: of the force's clock against the path's, s/s.
        drift_spread: its standard deviation.
        at: s.
        contacts: how many it is estimated from.
        contradicting: s, on the force's clock, of those that by themselves put it elsewhere.
    """

    late: float
    spread: float
    drift: float
    drift_spread: float
    at: float
    contacts: int
    contradicting: tuple[float, ...] = ()


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
    if found is None:
        cure = "straight guarded touches at 20 mm/s and more"
        if _blind(position) > _KNOWN:
            cure = f"poses at 200 Hz and more, for those at {1.0 / position.step:.0f} Hz are too far apart"
        report.append(
            f"clocks: the motion does not show how late the wrench is (from {-1000.0 * within:.0f} to "
            f"{1000.0 * within:.0f} ms), and nothing is taken off; state clock.wrench_late, or log {cure}"
        )
        return wrench
    if found.contradicting:
        which = ", ".join(f"{time - float(wrench.times[0]):.1f}" for time in found.contradicting[:5])
        report.append(
            f"clocks: the contacts at {which} s of the wrench's log put its lateness elsewhere than the "
            f"others ({1000.0 * found.late:.1f} ms), as where a clock is set while it is read, and nothing "
            "is taken off; cut the log between them, or state clock.wrench_late"
        )
        return wrench
    words = f"clocks: the wrench is {1000.0 * found.late:.1f} ± {1000.0 * found.spread:.1f} ms late"
    if fields.estimate != "offset":
        words += f" and drifts by {1e6 * found.drift:.0f} ± {1e6 * found.drift_spread:.0f} ppm"
    report.append(f"{words}, by {found.contacts} contacts, which is taken off")
    times = wrench.times - found.late
    return replace(wrench, times=times - found.drift * (wrench.times - found.at))


def lateness(force: Stream, position: Stream, within: float, drifts: bool = False) -> Lateness | None:
    """How late a force is relative to a path; None where the motion does not show it to 4 ms.

    Contacts that contradict each other, as those do at which the peg turns, put wider estimates anywhere.
    `benchmarks/clocks.py` has how far off estimates are, of several kinds of arms.

    Args:
        force: (T, 3) in the world's axes, N, at even stamps `contacts.STEP` apart, zero in free air.
        position: (P, 3) of the peg in the world, m.
        within: the largest lateness, either way, s.
        drifts: whether the clocks drift apart.
    """
    noise = max(position_noise(position.values), _LEAST_NOISE)
    felt = list(contacts(force))
    if not felt:
        return None
    felt = felt[:: -(-len(felt) // MOST_CONTACTS)]
    times = np.array([contact.time for contact in felt])
    middle = float(times.mean())
    coarse, fine = (_thinned(position, step) for step in _THIN)
    steps = round(within / _COARSE)
    every = np.asarray(_COARSE * np.arange(-steps, steps + 1))
    separate = log_evidence(felt, coarse, noise, every)
    weight = _weight(_of_all(separate))
    probable = every[weight > weight.max() - _IMPROBABLE]
    low, high = probable[0] - _COARSE, probable[-1] + _COARSE
    if high - low > _WIDEST:
        return None
    rates = _DRIFTS if drifts else np.zeros(1)
    behind = (times - middle) / _FINE
    margin = int(np.ceil(np.abs(behind).max() * rates.max()))
    first, last = round(low / _FINE) - margin, round(high / _FINE) + margin
    lates = np.asarray(_FINE * np.arange(first, last + 1))
    each = log_evidence(felt, fine, noise, lates)
    lates = lates[margin : len(lates) - margin]
    weights = np.stack([_weight(_of_all(_shifted(each, rate * behind, margin))) for rate in rates])
    weights -= 0.5 * np.square(rates / _DRIFT)[:, None]
    share = np.exp(weights - weights.max())
    share /= share.sum()
    late, drift = share.sum(axis=0) @ lates, share.sum(axis=1) @ rates
    variance = share.sum(axis=0) @ np.square(lates - late)
    spread = float(np.sqrt(variance + _LEAST**2 + np.square(_blind(position))))
    # Along the drift: at the ends of a long log clocks are farther apart than an estimate may be off.
    behind = drift * (times - middle) / _COARSE
    if margin := int(np.ceil(np.abs(behind).max())):
        wider = np.asarray(_COARSE * np.arange(-steps - margin, steps + margin + 1))
        separate = log_evidence(felt, coarse, noise, wider)
    along = _shifted(separate, behind, margin)
    far = np.abs(every - late) > max(_FAR, 3.0 * spread)
    most = _of_all(along).max(axis=1)
    if spread > _KNOWN or most[far].max(initial=0.0) > _RIVAL * most[~far].max(initial=0.0):
        return None
    own = along.reshape(len(felt), len(far), -1).max(axis=2)
    there, here = (own[:, where].max(axis=1, initial=-np.inf) for where in (far, ~far))
    contradicts = there > here + _IMPROBABLE
    return Lateness(
        late=float(late),
        spread=spread,
        drift=float(drift),
        drift_spread=float(np.sqrt(share.sum(axis=1) @ np.square(rates - drift))),
        at=middle,
        contacts=len(felt),
        contradicting=tuple(times[contradicts].tolist()),
    )


def _blind(position: Stream) -> float:
    """How late a wrench may be, s, without that poses so far apart in time show it."""
    return float(_BLIND * position.step * max(1.0, position.step / _SLOW))


def _thinned(stream: Stream, step: float) -> Stream:
    every = max(1, round(step / stream.step))
    return replace(stream, times=stream.times[::every], values=stream.values[::every])


def _weight(evidence: Array) -> Array:
    """The logarithm (L,) of the weight of latenesses."""
    return np.asarray(np.logaddexp.reduce(_POWER * evidence, axis=1))


def _of_all(evidence: Array) -> Array:
    """Of all contacts (L, lags * compliances), from that of each (K, L, lags, compliances)."""
    most = evidence.max(axis=3, keepdims=True)
    # Contacts differ a little in what yields: what is shared alone makes a lateness surer than it is.
    alike = gaussian_filter1d(np.exp(evidence - most), _ALIKE, axis=3, mode="nearest")
    total = (np.log(np.maximum(alike, 1e-300)) + most).sum(axis=0)
    return np.asarray(total.reshape(len(total), -1))


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

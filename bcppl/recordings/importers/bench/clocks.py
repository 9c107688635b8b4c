"""How late the wrench's stamps are relative to the pose's: stated, or estimated from contacts.

First to some milliseconds, by correlating how the force bends with how the path bends over the whole log: at
each onset and each release of a contact the force grows, and the peg accelerates, along the contact's normal.
Then, near there, by the paths about the onsets (`yielding`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import correlate

from bcppl.arrays import Array
from bcppl.recordings.importers.bench.configuration.field_types import factor
from bcppl.recordings.importers.bench.configuration.fields import ClockFields
from bcppl.recordings.importers.bench.contacts import STEP, contact_at, onsets
from bcppl.recordings.importers.bench.yielding import Lateness, fitted
from bcppl.recordings.streams import Stream, values_at

_WITHIN = 0.1  # s: the largest lateness, either way, that is looked for
_SMOOTH = 0.015  # s over which curvature is measured
_CLIP = 3.0  # N: more of a force says no more of when it begins, and an impact would outweigh all else
_CLEAR = 0.04  # s from the best lag, beyond which others are compared with it
_DISTINCT = 0.75  # of the best lag's correlation that no other may reach
_NEAR, _NEARER = 0.015, 0.005  # s by which the lag may be wrong at first, and then
_LEAST_NOISE = 2e-5  # m: paths differ by as much from what the model of an arm makes of them
_BLIND, _SLOW = (
    0.5,
    0.004,
)  # of the interval of poses, about which a fit is too sure; s, from which on more so
MOST_CONTACTS = 24
KNOWN = 0.004  # s: a lateness of a larger standard deviation is not taken off


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
    """How late a force is relative to a path; None where no lag stands out, or no contact shows it.

    In 64 simulated logs (wrench at 1 kHz, poses at 500 Hz, lateness from -50 to 50 ms) the error was 0.25 and
    0.5 ms (median) where poses scatter by 20 um, by a soft (2500 N/m) and a stiff arm, at most 2.1 ms; 0.75
    and 1.0 ms where they scatter by 50 um, 90 % within 3.0 and 1.9 ms, at most 4.8. From poses at 125 Hz it
    was up to 20 ms: their standard deviation says so.

    Args:
        force: (T, 3) in the world's axes, N, at even stamps `contacts.STEP` apart, zero in free air.
        position: (P, 3) of the peg in the world, m.
        within: the largest lateness, either way, s.
        drifts: whether the clocks drift apart.
    """
    late = _coarse(force, position, within)
    if late is None:
        return None
    noise = float(np.median(np.abs(np.diff(position.values, n=2, axis=0)))) / (0.6745 * 6.0**0.5)
    noise = max(noise, _LEAST_NOISE)
    times = list(onsets(force))
    times = times[:: -(-len(times) // MOST_CONTACTS)] if times else []
    found: Lateness | None = None
    for reach in (_NEAR, _NEARER):
        each = [contact_at(t, force, position, noise, late, reach) for t in times]
        contacts = [contact for contact in each if contact is not None]
        if not contacts:
            return None
        found = fitted(contacts, late, drifts=drifts)
        late = found.late
    if found is None:
        return None
    coarse = _BLIND * position.step * max(1.0, position.step / _SLOW)
    return replace(found, spread=float(np.hypot(found.spread, coarse)))


def _coarse(force: Stream, position: Stream, within: float) -> float | None:
    """The lag (s) at which force and path bend alike; None where they do nearly as much at another."""
    begin, end = max(force.times[0], position.times[0]), min(force.times[-1], position.times[-1])
    stamps = np.arange(begin, end, STEP)
    if len(stamps) < 4 * within / STEP:
        return None
    felt = np.stack([np.interp(stamps, force.times, c) for c in force.values.T], axis=1)
    felt *= np.minimum(1.0, _CLIP / np.maximum(np.linalg.norm(felt, axis=1, keepdims=True), 1e-9))
    path = values_at(position, stamps)
    axes = [correlate(_bends(felt[:, k]), _bends(path[:, k]), mode="full", method="fft") for k in range(3)]
    agreement = np.sum(axes, axis=0)
    lags = STEP * (np.arange(len(agreement)) - (len(stamps) - 1))
    near = np.abs(lags) <= within + _CLEAR
    lags, agreement = lags[near], agreement[near]
    best = int(np.where(np.abs(lags) <= within, agreement, -np.inf).argmax())
    others = np.abs(lags - lags[best]) > _CLEAR
    if agreement[best] <= 0.0 or (agreement[others] > _DISTINCT * agreement[best]).any():
        return None
    return float(lags[best])


def _bends(values: Array) -> Array:
    return np.asarray(gaussian_filter1d(values, _SMOOTH / STEP, order=2))

"""Contacts of a log that show its clocks: their onsets by the force, and the approach of the peg to each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from bcppl.arrays import Array, Indices
from bcppl.contact.sensing import OnsetDetector
from bcppl.recordings.streams import Stream

STEP = 0.001  # s between samples of the force
THRESHOLD, REACHED = 1.5, 3.5  # N; a force that stays below the second is the tool's own inertia
_LASTING, _APART = 0.03, 0.05  # s: a contact lasts, and is at least so far from the next
_FREE = 0.07  # s of free motion before a contact
BEFORE, AFTER = 0.04, 0.025  # s of the peg's path about an onset: few arms stop sooner
_AT_REST = 0.005  # s before the onset, from which on the path may not be straight
_STOP, _STOPS_AFTER = 4.0, 0.006  # m/s^2 by which an arm begins to stop, s after the onset
_BENT = 0.3  # share of an approach's acceleration that may be another one after the onset
_FEWEST = 6  # rows of the approach
_ROWS = 10.0  # of a slow pose stream that an approach is to have


@dataclass(frozen=True, eq=False)
class Contact:
    """One onset: the force from before it, and the peg's path about it, weighed by its errors.

    Attributes:
        time: of the onset, s, on the force's clock.
        force_times: (F,) s, evenly by `STEP`.
        force: (F, 3) in the world's axes, N, from its level before the onset.
        path_times: (R,) s on the pose's clock.
        weigh: the inverse of a factor (R, R) of the covariance of the path's errors.
        path: (R, 3) whitened positions.
        straight: (R, 3) orthonormal: whitened paths of constant acceleration.
    """

    time: float
    force_times: Array
    force: Array
    path_times: Array
    weigh: Array
    path: Array
    straight: Array

    def unexplained(self, moved: Array) -> Array:
        """What of the path (R, 3) neither acceleration nor a motion (R, 3) m explains; whitened."""
        rest = self.path - self.weigh @ moved
        return np.asarray(rest - self.straight @ (self.straight.T @ rest))


def onsets(force: Stream) -> Iterator[float]:
    """Times (s) at which contacts begin, of a force (T, 3) evenly by `STEP`, N, zero in free air."""
    size = np.linalg.norm(force.values, axis=1)
    free, after = round(_FREE / STEP), round(0.004 / STEP)
    begins, ends = _contacts(size)
    for k, begin in enumerate(begins):
        room = begin - (ends[k - 1] if k else 0)
        if room < free:
            continue
        first = begin - min(room, round(0.15 / STEP))
        seen = slice(first, begin + after + 1)
        detector = OnsetDetector(
            rest=max(10, (begin - first) // 2),
            threshold=THRESHOLD,
            before=begin - first,
            after=after - 1,
            resolution=1e-3,
        )
        for onset in detector.onsets(force.times[seen], force.values[seen])[:1]:
            yield onset.time


def _contacts(size: Array) -> tuple[Indices, Indices]:
    """The first and the last sample of contacts; pauses that are short belong to them."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (size > THRESHOLD).astype(int), [0]])))
    begins, ends = edges[::2], edges[1::2]
    kept = np.append(True, begins[1:] - ends[:-1] > _APART / STEP) if len(begins) else np.empty(0, bool)
    begins, ends = begins[kept], ends[np.append(kept[1:], True)[: len(kept)]]
    strong = np.array([size[a:b].max() >= REACHED for a, b in zip(begins, ends, strict=True)], dtype=bool)
    kept = strong & (ends - begins >= _LASTING / STEP)
    return begins[kept], ends[kept]


def contact_at(
    onset: float, force: Stream, position: Stream, noise: float, late: float, reach: float
) -> Contact | None:
    """A contact as it shows the clocks; None where rows are missing about it.

    Args:
        onset: s, on the force's clock.
        force: (T, 3) evenly by `STEP`, N.
        position: (P, 3) of the peg in the world, m.
        noise: standard deviation of a position, m.
        late: of the force's clock, s, nearly.
        reach: s by which that may be wrong.
    """
    times = np.arange(onset - 0.004, onset + AFTER + 2.0 * reach + 0.02, STEP)
    level = (force.times > onset - 0.06) & (force.times < onset - 0.004)
    if times[-1] > force.times[-1] or not level.any():
        return None
    columns = [np.interp(times, force.times, c) - c[level].mean() for c in force.values.T]
    before = max(BEFORE, _ROWS * position.step) + reach
    rows = slice(*np.searchsorted(position.times, [onset - late - before, onset - late + AFTER]).tolist())
    at = position.times[rows]
    since = at - (onset - late)
    approach = since < -_AT_REST
    if approach.sum() < _FEWEST or (~approach).sum() < 3 or np.diff(at).max() > 3.0 * position.step:
        return None
    place = position.values[rows]
    bent = _acceleration(since[approach], place[approach], noise)
    stop = 0.5 * np.maximum(since - _STOPS_AFTER, 0.0) ** 2
    bend = 0.5 * np.maximum(since + _AT_REST, 0.0) ** 2
    errors = np.square(noise) * np.eye(len(at)) + np.square(_STOP) * np.outer(stop, stop)
    errors += np.square(_BENT * bent) * np.outer(bend, bend)
    weigh = solve_triangular(np.linalg.cholesky(errors), np.eye(len(at)), lower=True)
    straight = np.linalg.qr(weigh @ np.stack([np.ones_like(since), since, since**2], axis=1))[0]
    return Contact(onset, times, np.stack(columns, axis=1), at, weigh, weigh @ place, straight)


def _acceleration(times: Array, place: Array, noise: float) -> float:
    """The size (m/s^2) of an approach's acceleration beyond what noise of its positions looks like."""
    design = np.stack([np.ones_like(times), times, times**2], axis=1)
    found = 2.0 * np.linalg.lstsq(design, place, rcond=None)[0][2]
    spread = 2.0 * noise * float(np.sqrt(np.linalg.inv(design.T @ design)[2, 2]))
    return float(np.sqrt(max(found @ found - 3.0 * spread**2, 0.0)))

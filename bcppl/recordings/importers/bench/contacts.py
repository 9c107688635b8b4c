"""Contacts of a log that show its clocks: when they begin by the force, and how the force grows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bcppl.arrays import Array, Indices
from bcppl.contact.sensing import OnsetDetector
from bcppl.recordings.streams import Stream

STEP = 0.001  # s between samples of the force
THRESHOLD, REACHED = 1.5, 3.5  # N; a force that stays below the second is the tool's own inertia
_LASTING, _APART = 0.03, 0.05  # s: a contact lasts, and is at least so far from the next
_FREE = 0.07  # s of free motion before a contact
_AFTER = 0.1  # s of a contact that are compared with the path, at most
_LEAST = 0.006  # s of it, at least
_LEFT = 0.5  # of the threshold, below which a contact that has begun is over
_RESTING = 0.004  # s before an onset up to which the force's level is that of free air


@dataclass(frozen=True, eq=False)
class Contact:
    """The beginning of a contact, by the force alone.

    Attributes:
        time: of the onset, s, on the force's clock.
        normal: (3,) the force's direction in the world's axes.
        times: (F,) s, evenly by `STEP`, from the onset on.
        force: (F,) along the normal, N, from its level before the onset.
    """

    time: float
    normal: Array
    times: Array
    force: Array


def contacts(force: Stream) -> Iterator[Contact]:
    """The contacts of a force (T, 3) in the world's axes, evenly by `STEP`, N, zero in free air."""
    size = np.linalg.norm(force.values, axis=1)
    for onset, risen in _onsets(force, size):
        begin = int(np.searchsorted(force.times, onset))
        level = (force.times > onset - 0.06) & (force.times < onset - _RESTING)
        # A peg that bounces leaves the part again.
        left = np.flatnonzero(size[risen:] < _LEFT * THRESHOLD)
        lasts = risen - begin + int(left[0]) if len(left) else len(size) - begin
        rows = slice(begin, begin + min(lasts, round(_AFTER / STEP)))
        grown = force.values[rows] - force.values[level].mean(axis=0) if level.any() else np.empty((0, 3))
        if len(grown) * STEP < _LEAST:
            continue
        normal = grown.sum(axis=0)
        normal /= np.linalg.norm(normal)
        yield Contact(onset, normal, force.times[rows], grown @ normal)


def _onsets(force: Stream, size: Array) -> Iterator[tuple[float, int]]:
    """The times of onsets, and the samples at which the force is above the threshold."""
    free, after = round(_FREE / STEP), round(0.004 / STEP)
    begins, ends = _lasting(size)
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
            yield onset.time, begin


def _lasting(size: Array) -> tuple[Indices, Indices]:
    """The first and the last sample of contacts; pauses that are short belong to them."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (size > THRESHOLD).astype(int), [0]])))
    begins, ends = edges[::2], edges[1::2]
    kept = np.append(True, begins[1:] - ends[:-1] > _APART / STEP) if len(begins) else np.empty(0, bool)
    begins, ends = begins[kept], ends[np.append(kept[1:], True)[: len(kept)]]
    strong = np.array([size[a:b].max() >= REACHED for a, b in zip(begins, ends, strict=True)], dtype=bool)
    kept = strong & (ends - begins >= _LASTING / STEP)
    return begins[kept], ends[kept]

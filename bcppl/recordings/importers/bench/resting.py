"""How late a force is relative to a path: a peg that rests on a rigid part does not move.

From the onset of a contact on the tip stays where it met the part, and the encoders run ahead by
what the structure between them and the tip yields,

    path along the force = place at the onset - compliance (force, lagging by the structure's damping),

whatever moves the arm: a spring, as under impedance control, or a controller that stops on contact. So
nothing is assumed about the arm. Before the onset the path is any smooth one that moves into the part. The
evidence of a lateness is that of this motion relative to a path that is smooth, or at rest, for reasons of
its own; a contact that shows neither counts for little.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.signal import lfilter
from scipy.stats import norm

from bcppl.arrays import Array
from bcppl.recordings.importers.bench.contacts import STEP, Contact
from bcppl.recordings.streams import Stream

BEFORE = 0.05  # s of the path before an onset
_FEWEST = 8  # rows there
_PLACE, _SPEED = 0.1, 0.2  # m and m/s: standard deviations of where and how fast a peg moves
# m^2/s^3, of the white acceleration of a path: a straight one, one that is not, an arm's stop.
_WANDERS = (1e-5, 1e-3, 0.08)
# Of a peg that rests: m/s at which it slides along a part that is not normal to the force, and its wander.
_SLIDING, _SETTLING = 0.003, 8e-4
_INTO = 0.001  # m/s at which a peg meets a part, at least
LAGS = np.array([0.0, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032])  # s
COMPLIANCES = np.concatenate([[0.0], np.geomspace(1e-6, 3e-4, 60)])  # m/N
_STRAY = 0.1  # probability that a contact shows no lateness


def log_evidence(contacts: Sequence[Contact], position: Stream, noise: float, lates: Array) -> Array:
    """Logarithms of the evidence (K, L, lags, compliances) of contacts for latenesses, relative to none.

    Args:
        contacts: by the force.
        position: (P, 3) of the peg in the world, m.
        noise: standard deviation of a position, m.
        lates: (L,) s.
    """
    ratios = np.zeros((len(contacts), len(lates), len(LAGS), len(COMPLIANCES)))
    for k, contact in enumerate(contacts):
        yielded = _yielded(contact)
        along = Stream("path", position.times, position.values @ contact.normal)
        for i, late in enumerate(lates):
            ratio = _log_ratio(contact, yielded, along, noise, late)
            ratios[k, i] = 0.0 if ratio is None else ratio
    return np.asarray(np.logaddexp(np.log(_STRAY), np.log1p(-_STRAY) + ratios))


def _yielded(contact: Contact) -> Array:
    """By what (F, lags) the path falls behind, in N."""
    decays = [np.exp(-STEP / lag) if lag > 0.0 else 0.0 for lag in LAGS]
    return -np.stack([lfilter([1.0 - d], [1.0, -d], contact.force) for d in decays], axis=1)


def _log_ratio(contact: Contact, yielded: Array, along: Stream, noise: float, late: float) -> Array | None:
    """Of a contact's lateness, (lags, compliances); None where rows are missing."""
    step, times = along.step, along.times
    onset, before = contact.time - late, max(BEFORE, _FEWEST * step)
    rows = slice(*np.searchsorted(times, [onset - before, contact.times[-1] - late]).tolist())
    since, place = times[rows] - onset, along.values[rows]
    free = since < 0.0
    if free.sum() < _FEWEST // 2 or (~free).sum() < 3 or np.diff(since).max() > 3.0 * step:
        return None
    place = place - place[free].mean()
    at, rest = since + before, since[~free]
    errors = np.square(noise) * np.eye(len(at))
    resting = np.square(noise) * np.eye(len(rest)) + _smooth(rest, _SETTLING, _SLIDING, 0.0)
    moved = np.stack([np.interp(rest, contact.times - contact.time, column) for column in yielded.T], axis=1)
    of_rest = _smooth(at, _SETTLING, _SLIDING, _PLACE) + errors
    smooth, contacts = [_log_normal(of_rest, place)[0]], []
    for wander in _WANDERS:
        whole = _smooth(at, wander, _SPEED, _PLACE) + errors
        to_place, to_speed = _with_onset(at[free], before, wander)
        factor = cholesky(whole[np.ix_(free, free)], lower=True)
        columns = np.column_stack([place[free], to_place, to_speed, whole[np.ix_(free, ~free)]])
        gain = cho_solve((factor, True), columns)
        approach = -0.5 * place[free] @ gain[:, 0] - np.log(np.diagonal(factor)).sum()
        expected = whole[np.ix_(~free, free)] @ gain
        after = whole[np.ix_(~free, ~free)] - expected[:, 3:]
        smooth.append(approach + _log_normal(after, place[~free] - expected[:, 0])[0])
        variance = np.square([_PLACE, _SPEED]) + wander * np.array([before**3 / 3.0, before])
        variance[0] += np.square(_SPEED * before)
        variance -= [to_place @ gain[:, 1], to_speed @ gain[:, 2]]
        into = norm.logcdf((-to_speed @ gain[:, 0] - _INTO) / np.sqrt(variance[1]))
        left = place[~free] - to_place @ gain[:, 0]
        density, solved = _log_normal(resting + variance[0], np.column_stack([left, moved]))
        linear, square = moved.T @ solved[:, 0], np.einsum("ra,ra->a", moved, solved[:, 1:])
        by_compliance = linear[:, None] * COMPLIANCES - 0.5 * square[:, None] * COMPLIANCES**2
        contacts.append(approach + into + density + by_compliance)
    null = np.logaddexp.reduce(smooth) - np.log(len(smooth))
    return np.asarray(np.logaddexp.reduce(contacts, axis=0) - np.log(len(contacts)) - null)


def _smooth(at: Array, wander: float, speed: float, place: float) -> Array:
    """The covariance of a path of white acceleration, by its speed and place at time 0."""
    least, apart = np.minimum.outer(at, at), np.abs(np.subtract.outer(at, at))
    wandered = wander * (least**3 / 3.0 + least**2 * apart / 2.0)
    return np.asarray(wandered + np.square(speed) * np.outer(at, at) + np.square(place))


def _with_onset(at: Array, onset: float, wander: float) -> tuple[Array, Array]:
    """The covariances of a path's places at times before an onset with its place and speed there."""
    place = wander * (at**3 / 3.0 + at**2 * (onset - at) / 2.0) + np.square(_SPEED) * at * onset
    return place + np.square(_PLACE), wander * at**2 / 2.0 + np.square(_SPEED) * at


def _log_normal(covariance: Array, columns: Array) -> tuple[float, Array]:
    """The logarithm of the density of the first of columns, without 2 pi, and the solutions for all."""
    factor = cholesky(covariance, lower=True)
    solved = cho_solve((factor, True), columns)
    first, of_first = (columns, solved) if columns.ndim == 1 else (columns[:, 0], solved[:, 0])
    return float(-0.5 * first @ of_first - np.log(np.diagonal(factor)).sum()), solved

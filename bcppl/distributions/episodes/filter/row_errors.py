"""Errors of the rows of an episode, as a process in time: the same for all particles."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from torch import Tensor

from bcppl.arrays import Array
from bcppl.compiled import compiled
from bcppl.distributions.episodes.filter.branches import OF_CONTACT, Segments
from bcppl.distributions.episodes.filter.conditioning import dot, factorise, whiten
from bcppl.distributions.episodes.rows import CONTINUES, EPISODE, FELT, FORCE, NOISE, TIME

# Rows of a piece of an episode and the seconds between its first and the next one's, at least: it is an
# outlier as a whole, and a contact that is not one is felt amid others.
_PIECE, _LASTING = 4, 0.1
_MORE = 1.1  # times the load before, by which what is held slips in a later piece of an episode


class Hypothesis(NamedTuple):
    """What may hold for all of a recording's touches.

    Attributes:
        log_weight: of its probability.
        compliance: of part and peg where they touch, m/N.
        noise: by which the rows' own errors are wider than stated.
        scale: by which the errors that all touches share are wider than stated.
        delay: the interval in which the wrench's delay lies, from 1 on (`rows.late`); 0 for no delay.
    """

    log_weight: float
    compliance: float
    noise: float = 1.0
    scale: float = 1.0
    delay: int = 0


class RowErrors(NamedTuple):
    """The errors of a row, as of `ContactEpisodes`; `blur` m are added."""

    blur: float
    shared: float
    drift: float
    lasting: float
    varying: float
    rough: float


def _first(same: list[bool], time: list[float]) -> list[int]:
    """The index of each segment's first row, of rows that may go on with the episode of the one before."""
    first: list[int] = []
    for k, at in enumerate(time):
        if k and same[k - 1] and (k - first[-1] < _PIECE or at - time[first[-1]] < _LASTING):
            continue
        first.append(k)
    return first


def segments_of(rows: Tensor, errors: RowErrors, hypotheses: tuple[Hypothesis, ...]) -> Segments:
    """The segments of rows (R, COLUMNS), with their errors under each hypothesis."""
    columns = rows[:, [FELT, NOISE, FORCE, TIME, EPISODE, CONTINUES]].contiguous()
    return _segments(columns.numpy().tobytes(), errors, hypotheses)


@lru_cache(maxsize=64)
def _segments(columns: bytes, errors: RowErrors, hypotheses: tuple[Hypothesis, ...]) -> Segments:
    felt, noise, force, time, episode, continues = np.frombuffer(columns).reshape(-1, 6).T.copy()
    contact = felt == 1.0
    same = contact[1:] & contact[:-1] & (episode[1:] == episode[:-1])
    first = np.array(_first(same.tolist(), time.tolist()))
    last = np.append(first[1:], len(felt))
    within = np.append(False, same)[first]
    compliance, scale = np.array([(h.compliance, h.noise) for h in hypotheses]).T
    own = noise**2 + errors.blur**2
    alone = scale[:, None] ** 2 * (own + errors.shared**2 + errors.drift**2)
    own = scale[:, None] ** 2 * own + (errors.rough * compliance[:, None] * force * contact) ** 2
    count, shape = len(hypotheses), (len(hypotheses), len(felt), int((last - first).max()))
    segments = Segments(
        first=first,
        last=last,
        contact=contact[first].astype(np.int64),
        begins=(contact[first] & ~within & (continues[first] != 1.0)).astype(np.int64),
        slips=np.zeros(len(first), np.int64),
        own=alone,
        common=np.stack([(scale * errors.shared) ** 2, (errors.varying * compliance) ** 2], axis=1),
        errors=np.zeros(shape),
        factor=np.zeros(shape),
        log_determinant=np.zeros((count, len(first))),
        white=np.zeros((*shape[:2], OF_CONTACT)),
        known=np.zeros((count, len(first), OF_CONTACT, OF_CONTACT)),
        loaded=np.zeros(len(felt)),
    )
    _set_errors(segments, within, time, force, own, (scale * errors.drift) ** 2, errors.lasting)
    _set_factors(segments, force)
    return segments


@compiled
def _set_errors(
    segments: Segments, within: Array, time: Array, force: Array, own: Array, drift: Array, lasting: float
) -> None:
    """Set the covariances of the rows' errors, of `own` (H, R) and lasting ones, and where contacts slip."""
    most = 0.0
    for s in range(len(segments.first)):
        if not segments.contact[s]:
            continue
        first, last = segments.first[s], segments.last[s]
        # What is held by friction slips when it is loaded more than it was.
        before = most if within[s] else 0.0
        most = before
        for i in range(first, last):
            most = max(most, force[i], 1e-3)
            segments.loaded[i] = most - before
            for h in range(len(drift)):
                for j in range(first, last):
                    apart = abs(time[i] - time[j])
                    segments.errors[h, i, j - first] = drift[h] * math.exp(-apart / lasting)
                segments.errors[h, i, i - first] += own[h, i]
        segments.loaded[first:last] /= max(most - before, 1e-9)
        segments.slips[s] = int(most > _MORE * before)


@compiled
def _set_factors(segments: Segments, force: Array) -> None:
    """Set the factors of episodes' covariances, as of `factorise`, and what these make of the contact's."""
    rows = segments.errors.shape[2]
    none, never = np.zeros((rows, 0)), np.zeros(0)
    white = np.zeros((OF_CONTACT, rows))
    for h in range(len(segments.errors)):
        for s in range(len(segments.first)):
            if not segments.contact[s]:
                continue
            first, last = segments.first[s], segments.last[s]
            factor, count = segments.factor[h, first:last], last - first
            own = segments.errors[h, first:last]
            segments.log_determinant[h, s] = factorise(own, none, never, never, factor)
            whiten(factor, np.ones(count), white[0, :count])
            whiten(factor, force[first:last], white[1, :count])
            for a in range(OF_CONTACT):
                segments.white[h, first:last, a] = white[a, :count]
                for b in range(OF_CONTACT):
                    segments.known[h, s, a, b] = dot(white[a, :count], white[b, :count])

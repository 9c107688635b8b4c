"""A Rao-Blackwellised filter over the episodes of a probe: Gaussian errors that all touches share, and jumps.

The gap at a row is the measured one plus a linear function of M parameters, which are normal a priori, plus
the row's own errors, which are normal and correlated within an episode. So given what is discrete the
parameters are normal at any time and are integrated out by a Kalman filter, one for each hypothesis: of the
contact's compliance and the noise's scale from the beginning, of a jump of some parameters, or of an outlier,
at an episode that surprises. Hypotheses multiply there, and the most probable ones are kept (a Gaussian
mixture filter: Alspach and Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, IEEE
TAC 17, 1972). Each row's probability is conditional on those before it, so the product is a density of all
rows, whatever was dropped, but for the share of what was.

A row without contact has the probability that its gap is positive, and the parameters the first two moments
given that (assumed density filtering).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from bcppl.arrays import Array, Indices
from bcppl.compiled import compiled
from bcppl.threads import parallel_sum, thread_count

KEPT = 8  # hypotheses of a particle
INLIER, OUTLIER = 0, 1  # what an episode is; from 2 on, after which jump
_FAINT = 12.0  # nats below the most probable hypothesis, from which on one is dropped
_CLEAR = 0.02  # m: farther from the part than this a peg without contact says nothing
_SURPRISING = 3.0  # standard deviations of a chi-square


class Segments(NamedTuple):
    """S segments of consecutive rows: an episode of contact, or one row without contact.

    Attributes:
        first, last: (S,) the index of a segment's first row, and that after its last.
        contact: (S,) 1 for an episode.
        factor: (H, R, n) of each hypothesis, rows of the Cholesky factors of the episodes' covariances, each
            within its own segment; for a row without contact the first number is its standard deviation.
    """

    first: Indices
    last: Indices
    contact: Indices
    factor: Array


class Prior(NamedTuple):
    """What holds before the first row.

    Attributes:
        log_weight, compliance, scale: (H,) of each hypothesis: its log-probability, the compliance of a
            contact in m/N, and the factor of the shared errors' standard deviations.
        delay: (H,) the place of its delay among those for which gaps are given.
        mean, variance: (M,) of the parameters.
        jump_log_probability: (J,) at each episode.
        jump_variance: (J, M).
        outlier: the probability that an episode, or a row without contact, is one.
        farthest: m, the range over which an outlier's gap is spread evenly.
    """

    log_weight: Array
    compliance: Array
    scale: Array
    delay: Indices
    mean: Array
    variance: Array
    jump_log_probability: Array
    jump_variance: Array
    outlier: float
    farthest: float


class Branches(NamedTuple):
    """The hypotheses of N particles after some rows.

    Attributes:
        number: (N,) how many there are; others are not used.
        log_weight: (N, B) unnormalised: their sum is the likelihood of the rows so far.
        which: (N, B) the hypothesis of the prior.
        mean: (N, B, M) of the parameters.
        covariance: (N, B, M, M).
        event: (N, B, S) of each segment so far: `INLIER`, `OUTLIER`, or 2 plus the number of a jump.
        squared: (N, B, S) squared whitened errors of an episode, as predicted; 0 without contact.
    """

    number: Indices
    log_weight: Array
    which: Indices
    mean: Array
    covariance: Array
    event: Indices
    squared: Array

    @property
    def log_evidence(self) -> Array:
        """(N,) the log-likelihood of the rows so far."""
        used = np.arange(self.log_weight.shape[1]) < self.number[:, None]
        return np.asarray(np.logaddexp.reduce(np.where(used, self.log_weight, -np.inf), axis=1))

    @property
    def weights(self) -> Array:
        """(N, B) normalised, 0 for those that are not used."""
        used = np.arange(self.log_weight.shape[1]) < self.number[:, None]
        shifted = np.where(used, self.log_weight, -np.inf) - self.log_evidence[:, None]
        return np.asarray(np.exp(shifted))

    @property
    def trimmed(self) -> Branches:
        """The same without what no particle uses."""
        most = int(self.number.max(initial=1))
        return Branches._make([self.number, *(np.ascontiguousarray(each[:, :most]) for each in self[1:])])


def begun(prior: Prior, particles: int) -> Branches:
    """The hypotheses of N particles before the first row."""
    hypotheses, parameters = len(prior.log_weight), len(prior.mean)
    size = max(KEPT, hypotheses)
    count = np.full(particles, hypotheses)
    log_weight, which = np.zeros((particles, size)), np.zeros((particles, size), dtype=np.int64)
    log_weight[:, :hypotheses], which[:, :hypotheses] = prior.log_weight, np.arange(hypotheses)
    mean = np.zeros((particles, size, parameters))
    covariance = np.zeros((particles, size, parameters, parameters))
    mean[:, :hypotheses] = prior.mean
    for h in range(hypotheses):
        covariance[:, h] = np.diag(prior.variance * prior.scale[h] ** 2)
    none = np.zeros((particles, size, 0))
    return Branches(count, log_weight, which, mean, covariance, none.astype(np.int64), none)


def _with_room(each: Array | Indices, *sizes: int) -> Array | Indices:
    """A copy of (N, B, ...) with the axes after the particles' grown to `sizes`; what is added is 0."""
    grown: Array | Indices = np.zeros((len(each), *sizes, *each.shape[1 + len(sizes) :]), each.dtype)
    grown[tuple(slice(size) for size in each.shape)] = each
    return grown


def filtered(
    before: Branches,
    prior: Prior,
    segments: Segments,
    distance: Array,
    force: Array,
    columns: Array,
    trust: Array | None = None,
) -> Branches:
    """The hypotheses after further rows.

    Args:
        before: after the rows before these.
        prior: of all hypotheses.
        segments: of these rows.
        distance: (N, D, R) gaps at the peg as measured, with each delay, m.
        force: (R,) N.
        columns: (N, D, R, M) the gap's change by each parameter, m.
        trust: (N, D, R) factors of the errors and columns of contacts; 1 unless given.
    """
    trust = np.ones_like(distance) if trust is None else trust
    new = len(segments.first)
    branches = max(KEPT, before.log_weight.shape[1])
    grown = [_with_room(each, branches) for each in before[1:-2]]
    grown += [_with_room(each, branches, each.shape[2] + new) for each in before[-2:]]
    after = Branches._make([before.number.copy(), *grown])

    def work(begin: int, end: int) -> int:
        _filter(begin, end, *after, prior, segments, distance, force, columns, trust)
        return 0

    if new:
        parallel_sum(work, 0, len(before.number), 8, thread_count())
    return after


@compiled
def _log_ndtr(z: float) -> float:
    """Logarithm of the standard normal distribution function."""
    if z > -30.0:
        return math.log(0.5 * math.erfc(-z / math.sqrt(2.0)))
    inverse = 1.0 / (z * z)
    return (
        -0.5 * z * z
        - math.log(-z)
        - 0.5 * math.log(2.0 * math.pi)
        + math.log(1.0 - inverse + 3.0 * inverse**2)
    )


@compiled
def _log_sum(a: float, b: float) -> float:
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high)) if low > -np.inf else high


@compiled
def _times(covariance: Array, column: Array, product: Array) -> float:
    """Set `product` (M,) to a symmetric matrix times a column (M,); returns the column's square by it.

    The inner loop is over neighbouring numbers, which the processor takes several at a time.
    """
    parameters, square = len(column), 0.0
    product[:] = 0.0
    for b in range(parameters):
        share = column[b]
        if share != 0.0:
            for a in range(parameters):
                product[a] += share * covariance[b, a]
    for a in range(parameters):
        square += column[a] * product[a]
    return square


@compiled
def _update(
    error: Array, columns: Array, factor: Array, mean: Array, covariance: Array, pull: Array
) -> tuple[float, float]:
    """Condition the parameters on an episode's rows, in place.

    `error` (n,) and `columns` (n, M) are whitened in place by `factor` (n, n).

    Returns:
        the log-density of the rows, and the squares of their standardised errors.
    """
    count, parameters = columns.shape
    log_density, squared = 0.0, 0.0
    for i in range(count):
        for j in range(i):
            error[i] -= factor[i, j] * error[j]
            columns[i] -= factor[i, j] * columns[j]
        error[i] /= factor[i, i]
        columns[i] /= factor[i, i]
        innovation, variance = error[i], 1.0 + _times(covariance, columns[i], pull)
        for a in range(parameters):
            innovation += columns[i, a] * mean[a]
        for a in range(parameters):
            share = pull[a] / variance
            mean[a] -= share * innovation
            for b in range(parameters):
                covariance[a, b] -= share * pull[b]
        squared += innovation * innovation / variance
        log_density -= 0.5 * math.log(variance) + math.log(factor[i, i])
    return log_density - 0.5 * (squared + count * math.log(2.0 * math.pi)), squared


@compiled
def _filter(
    begin: int,
    end: int,
    number: Indices,
    log_weight: Array,
    which: Indices,
    mean: Array,
    covariance: Array,
    event: Indices,
    squared: Array,
    prior: Prior,
    segments: Segments,
    distance: Array,
    force: Array,
    columns: Array,
    trust: Array,
) -> None:
    parameters, jumps, size = columns.shape[3], len(prior.jump_log_probability), log_weight.shape[1]
    new, longest = len(segments.first), segments.factor.shape[2]
    offset = event.shape[2] - new
    most = size * (2 + jumps)
    log_in = math.log1p(-prior.outlier)
    log_out = math.log(prior.outlier) if prior.outlier > 0.0 else -np.inf
    kept = 1.0
    for j in range(jumps):
        kept -= math.exp(prior.jump_log_probability[j])
    log_kept = math.log(kept)
    # Candidates at one episode: which branch each comes from, and its state.
    weight, source, kind = np.empty(most), np.empty(most, np.int64), np.empty(most, np.int64)
    square, means = np.empty(most), np.empty((most, parameters))
    covariances = np.empty((most, parameters, parameters))
    error, column, pull = np.empty(longest), np.empty((longest, parameters)), np.empty(parameters)
    old_which, old_event, old_squared = which[0].copy(), event[0].copy(), squared[0].copy()
    for n in range(begin, end):
        for s in range(new):
            first, last = segments.first[s], segments.last[s]
            if segments.contact[s] == 0:
                for b in range(number[n]):
                    delay = prior.delay[which[n, b]]
                    if distance[n, delay, first] > _CLEAR:
                        continue
                    own = columns[n, delay, first]
                    spread = segments.factor[which[n, b], first, 0]
                    gap, variance = distance[n, delay, first], spread * spread
                    variance += _times(covariance[n, b], own, pull)
                    for a in range(parameters):
                        gap += own[a] * mean[n, b, a]
                    root = math.sqrt(variance)
                    score = gap / root
                    positive = _log_ndtr(score)
                    inside = log_in + positive
                    log_weight[n, b] += _log_sum(inside, log_out)
                    if parameters and inside > log_out and score < 5.0:
                        hazard = math.exp(-0.5 * score**2 - 0.5 * math.log(2.0 * math.pi) - positive)
                        bend = hazard * (hazard + score) / variance
                        for a in range(parameters):
                            mean[n, b, a] += pull[a] / root * hazard
                            for c in range(parameters):
                                covariance[n, b, a, c] -= pull[a] * pull[c] * bend
                continue
            rows, found = last - first, 0
            stray = log_out - rows * math.log(prior.farthest)
            for b in range(number[n]):
                h = which[n, b]
                delay = prior.delay[h]
                for option in range(1 + jumps):
                    means[found], covariances[found] = mean[n, b], covariance[n, b]
                    if option:
                        for a in range(parameters):
                            covariances[found, a, a] += (
                                prior.jump_variance[option - 1, a] * prior.scale[h] ** 2
                            )
                    for i in range(rows):
                        sunk = prior.compliance[h] * force[first + i]
                        share = trust[n, delay, first + i]
                        error[i] = share * (distance[n, delay, first + i] + sunk)
                        column[i] = share * columns[n, delay, first + i]
                    log_density, square[found] = _update(
                        error[:rows],
                        column[:rows],
                        segments.factor[h, first:last],
                        means[found],
                        covariances[found],
                        pull,
                    )
                    source[found] = b
                    if option == 0:
                        inlier = log_weight[n, b] + log_in + log_density
                        outlier = log_weight[n, b] + stray
                        surprise = square[found] - rows > _SURPRISING * math.sqrt(2.0 * rows) + 1.0
                        if parameters == 0 or not surprise:
                            # Nothing differs between the two but a state that is hardly ever the outlier's.
                            weight[found], kind[found] = _log_sum(inlier, outlier), INLIER
                            found += 1
                            break
                        weight[found], kind[found] = inlier + log_kept, INLIER
                        found += 1
                        means[found], covariances[found] = mean[n, b], covariance[n, b]
                        weight[found], kind[found], source[found] = outlier, OUTLIER, b
                        square[found] = square[found - 1]
                        found += 1
                    else:
                        kind[found] = OUTLIER + option
                        weight[found] = (
                            log_weight[n, b] + log_in + log_density + prior.jump_log_probability[option - 1]
                        )
                        found += 1
            best, left = weight[:found].max(), 0
            old_which[:] = which[n]
            old_event[:] = event[n]
            old_squared[:] = squared[n]
            while left < min(size, found):
                c = int(weight[:found].argmax())
                if weight[c] < best - _FAINT:
                    break
                log_weight[n, left], which[n, left] = weight[c], old_which[source[c]]
                mean[n, left], covariance[n, left] = means[c], covariances[c]
                event[n, left], squared[n, left] = old_event[source[c]], old_squared[source[c]]
                event[n, left, offset + s], squared[n, left, offset + s] = kind[c], square[c]
                weight[c] = -np.inf
                left += 1
            number[n] = left

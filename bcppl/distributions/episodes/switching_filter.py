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

import numpy as np

from bcppl.arrays import Array
from bcppl.compiled import compiled, summed
from bcppl.distributions.episodes.branches import INLIER, KEPT, OUTLIER, Branches, Prior, Segments
from bcppl.threads import parallel_sum, thread_count

_FAINT = 12.0  # nats below the most probable hypothesis, from which on one is dropped
_CLEAR = 0.02  # m: farther from the part than this a peg without contact says nothing
_SURPRISING = 3.0  # standard deviations of a chi-square
# Particles of a chunk of work, and rows of all of them, at least: fewer take less than a thread's beginning.
_CHUNK, _ROWS = 8, 2000


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
    if not len(segments.first):
        return before
    particles, (_, branches, known) = len(before.number), before.event.shape
    size, parameters = (particles, max(KEPT, branches)), before.mean.shape[2]
    episodes = known + int(segments.contact.sum())
    # Memory that is only asked for: what no branch uses is never touched.
    after = Branches(
        before.number.copy(),
        np.zeros(size),
        np.zeros(size, np.int64),
        np.zeros((*size, parameters)),
        np.zeros((*size, parameters, parameters)),
        np.zeros((*size, episodes), np.int64),
        np.zeros((*size, episodes)),
    )

    def work(begin: int, end: int) -> int:
        _filter(begin, end, before, after, prior, segments, distance, force, columns, trust)
        return 0

    rows = max(1, len(force))
    parallel_sum(work, 0, particles, max(_CHUNK, _ROWS // rows), thread_count())
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


@summed
def _times(covariance: Array, column: Array, product: Array) -> float:
    """Set `product` (M,) to a symmetric matrix times a column (M,); returns the column's square by it.

    Of the matrix the lower triangle is read.
    """
    parameters, square = len(column), 0.0
    product[:] = 0.0
    for a in range(parameters):
        share, dot = column[a], 0.0
        for b in range(a):
            product[b] += share * covariance[a, b]
            dot += covariance[a, b] * column[b]
        product[a] += dot + share * covariance[a, a]
    for a in range(parameters):
        square += column[a] * product[a]
    return square


@summed
def _update(
    error: Array, columns: Array, factor: Array, mean: Array, covariance: Array, pull: Array
) -> tuple[float, float]:
    """Condition the parameters on an episode's rows, in place; of the covariance the lower triangle.

    `error` (n,) and `columns` (n, M) are whitened in place by `factor` (n, n).

    Returns:
        the log-density of the rows, and the squares of their standardised errors.
    """
    count, parameters = columns.shape
    log_density, squared = 0.0, 0.0
    for i in range(count):
        for j in range(i):
            share = factor[i, j]
            error[i] -= share * error[j]
            for a in range(parameters):
                columns[i, a] -= share * columns[j, a]
        error[i] /= factor[i, i]
        for a in range(parameters):
            columns[i, a] /= factor[i, i]
        innovation, variance = error[i], 1.0 + _times(covariance, columns[i], pull)
        for a in range(parameters):
            innovation += columns[i, a] * mean[a]
        for a in range(parameters):
            share = pull[a] / variance
            mean[a] -= share * innovation
            for b in range(a + 1):
                covariance[a, b] -= share * pull[b]
        squared += innovation * innovation / variance
        log_density -= 0.5 * math.log(variance) + math.log(factor[i, i])
    return log_density - 0.5 * (squared + count * math.log(2.0 * math.pi)), squared


@compiled
def _filter(
    begin: int,
    end: int,
    before: Branches,
    after: Branches,
    prior: Prior,
    segments: Segments,
    distance: Array,
    force: Array,
    columns: Array,
    trust: Array,
) -> None:
    number, log_weight, which, mean, covariance, event, squared = after
    parameters, jumps, size = columns.shape[3], len(prior.jump_log_probability), log_weight.shape[1]
    known, longest, most = before.event.shape[2], segments.factor.shape[2], size * (2 + jumps)
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
    error, whitened, pull = np.empty(longest), np.empty((longest, parameters)), np.empty(parameters)
    old_which, old_event, old_squared = which[0].copy(), event[0].copy(), squared[0].copy()
    for n in range(begin, end):
        own = n if len(before.mean) > 1 else 0
        for b in range(number[n]):
            log_weight[n, b], which[n, b] = before.log_weight[own, b], before.which[own, b]
            mean[n, b], covariance[n, b] = before.mean[own, b], before.covariance[own, b]
            event[n, b, :known], squared[n, b, :known] = before.event[own, b], before.squared[own, b]
        episode = known
        for s in range(len(segments.first)):
            first, last = segments.first[s], segments.last[s]
            if segments.contact[s] == 0:
                score, positive, either = np.nan, 0.0, 0.0
                for b in range(number[n]):
                    delay = prior.delay[which[n, b]]
                    if distance[n, delay, first] > _CLEAR:
                        continue
                    column = columns[n, delay, first]
                    spread = segments.factor[which[n, b], first, 0]
                    gap, variance = distance[n, delay, first], spread * spread
                    variance += _times(covariance[n, b], column, pull)
                    for a in range(parameters):
                        gap += column[a] * mean[n, b, a]
                    root = math.sqrt(variance)
                    # Hypotheses that differ in the compliance alone are the same without contact.
                    if gap / root != score:
                        score = gap / root
                        positive = _log_ndtr(score)
                        either = _log_sum(log_in + positive, log_out)
                    inside = log_in + positive
                    log_weight[n, b] += either
                    if parameters and inside > log_out and score < 5.0:
                        hazard = math.exp(-0.5 * score**2 - 0.5 * math.log(2.0 * math.pi) - positive)
                        bend = hazard * (hazard + score) / variance
                        for a in range(parameters):
                            mean[n, b, a] += pull[a] / root * hazard
                            for c in range(a + 1):
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
                        for a in range(parameters):
                            whitened[i, a] = share * columns[n, delay, first + i, a]
                    log_density, square[found] = _update(
                        error[:rows],
                        whitened[:rows],
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
            old_which[:], old_event[:], old_squared[:] = which[n], event[n], squared[n]
            while left < min(size, found):
                c = int(weight[:found].argmax())
                if weight[c] < best - _FAINT:
                    break
                log_weight[n, left], which[n, left] = weight[c], old_which[source[c]]
                mean[n, left], covariance[n, left] = means[c], covariances[c]
                event[n, left], squared[n, left] = old_event[source[c]], old_squared[source[c]]
                event[n, left, episode], squared[n, left, episode] = kind[c], square[c]
                weight[c] = -np.inf
                left += 1
            number[n], episode = left, episode + 1
        for b in range(number[n]):
            for a in range(parameters):
                for c in range(a):
                    covariance[n, b, c, a] = covariance[n, b, a, c]

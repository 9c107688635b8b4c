"""A Rao-Blackwellised filter over the episodes of a probe: Gaussian errors that all touches share, and jumps.

The gap at a row is the measured one plus a linear function of M parameters, which are normal a priori, plus
the row's own errors, which are normal and correlated within an episode. So given what is discrete the
parameters are normal at any time and are integrated out by a Kalman filter, one for each hypothesis: of the
contact's compliance and the noise's scale from the beginning, of a change of some parameters in an episode,
or of an outlier, where an episode surprises. A change is a Wiener process that runs while a contact is loaded
more than it was: what is held by friction slips then, at once or slowly, and not under a steady force.
Hypotheses multiply there, and the most probable ones are kept (a Gaussian mixture filter: Alspach and
Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, IEEE TAC 17, 1972). Each row's
probability is conditional on those before it, so the product is a density of all rows, whatever was dropped,
but for the share of what was.

A row without contact has the probability that its gap is positive, and the parameters the first two moments
given that (assumed density filtering).
"""

from __future__ import annotations

import math

import numpy as np

from bcppl.arrays import Array
from bcppl.compiled import compiled, summed
from bcppl.distributions.episodes.branches import INLIER, KEPT, OUTLIER, SHARED, Branches, Prior, Segments
from bcppl.threads import parallel_sum, thread_count

_FAINT = 12.0  # nats below the most probable hypothesis, from which on one is dropped
_UNLIKELY = 10.0  # the same before an episode, of a hypothesis with a change
_CLEAR = 0.02  # m: farther from the part than this a peg without contact says nothing
_SURPRISING = 1.0  # standard deviations of a chi-square
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
    error: Array,
    columns: Array,
    own: Array,
    kept: Array,
    loading: Array,
    renewed: float,
    change: Array,
    mean: Array,
    covariance: Array,
    pull: Array,
) -> tuple[float, float]:
    """Condition the state on an episode's rows, in place; of the covariance the lower triangle.

    The state (S,) is the parameters and what the rows share. It has a `mean` (S,) and a `covariance`; `pull`
    (S,) is room. The gap less its expectation, `error` (n,), has derivatives `columns` (n, S) and variances
    `own` (n,) besides. The last state is that of the row before by a correlation `kept` (n,), and `renewed`,
    its variance, stays. Before each row parameters change by a share `loading` (n,) of variances `change`
    (M,).

    Returns:
        the log-density of the rows, and the squares of their standardised errors.
    """
    count, states = columns.shape
    log_density, squared, last = 0.0, 0.0, states - 1
    for i in range(count):
        for a in range(len(change)):
            covariance[a, a] += change[a] * loading[i]
        if i:
            mean[last] *= kept[i]
            for a in range(last):
                covariance[last, a] *= kept[i]
            covariance[last, last] = kept[i] ** 2 * covariance[last, last] + (1.0 - kept[i] ** 2) * renewed
        innovation, variance = error[i], own[i] + _times(covariance, columns[i], pull)
        for a in range(states):
            innovation += columns[i, a] * mean[a]
        for a in range(states):
            share = pull[a] / variance
            mean[a] -= share * innovation
            for b in range(a + 1):
                covariance[a, b] -= share * pull[b]
        squared += innovation * innovation / variance
        log_density -= 0.5 * math.log(variance)
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
    parameters, changes, size = columns.shape[3], len(prior.change_log_probability), log_weight.shape[1]
    known, longest, most = (
        before.event.shape[2],
        int((segments.last - segments.first).max()),
        2 * size * changes,
    )
    states = parameters + SHARED
    log_in = math.log1p(-prior.outlier)
    log_out = math.log(prior.outlier) if prior.outlier > 0.0 else -np.inf
    # Candidates at one episode: which branch each comes from, and its state.
    weight, source, kind = np.empty(most), np.empty(most, np.int64), np.empty(most, np.int64)
    square, means, covariances = np.empty(most), np.empty((most, states)), np.empty((most, states, states))
    error, slopes, pull = np.empty(longest), np.empty((longest, states)), np.empty(states)
    changed = np.empty(parameters)
    old_which, old_event, old_squared = which[0].copy(), event[0].copy(), squared[0].copy()
    for n in range(begin, end):
        own, kept = n if len(before.mean) > 1 else 0, n if len(before.which) > 1 else 0
        for b in range(number[n]):
            h = before.which[kept, b]
            # Before the first row a state is that of its hypothesis, and held once for all particles.
            place = h if len(before.which) > len(before.mean) else b
            log_weight[n, b], which[n, b] = before.log_weight[kept, b], h
            mean[n, b], covariance[n, b] = before.mean[own, place], before.covariance[own, place]
            event[n, b, :known], squared[n, b, :known] = before.event[own, place], before.squared[own, place]
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
                    gap, variance = distance[n, delay, first], segments.own[which[n, b], first]
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
            likely = log_weight[n, : number[n]].max() - _UNLIKELY
            for b in range(number[n]):
                h = which[n, b]
                delay = prior.delay[h]
                for i in range(rows):
                    share = trust[n, delay, first + i]
                    error[i] = share * (
                        distance[n, delay, first + i] + prior.compliance[h] * force[first + i]
                    )
                    for a in range(parameters):
                        slopes[i, a] = share * columns[n, delay, first + i, a]
                    slopes[i, parameters] = segments.sunk[h, first + i]
                    slopes[i, parameters + 1 :] = 1.0
                for change in range(changes):
                    if change and log_weight[n, b] + prior.change_log_probability[change] < likely:
                        continue
                    for a in range(parameters):
                        changed[a] = prior.change_variance[change, a] * prior.scale[h] ** 2
                    for into in (found, found + 1):
                        means[into, :parameters], means[into, parameters:] = mean[n, b], 0.0
                        covariances[into, :parameters, :parameters] = covariance[n, b]
                        covariances[into, parameters:] = 0.0
                        for a in range(SHARED):
                            covariances[into, parameters + a, parameters + a] = segments.shared[h, a]
                    # As an outlier it says nothing of what has changed, but what comes after it does.
                    for a in range(parameters):
                        covariances[found + 1, a, a] += changed[a]
                    log_density, square[found] = _update(
                        error[:rows],
                        slopes[:rows],
                        segments.own[h, first:last],
                        segments.kept[first:last],
                        segments.loading[first:last],
                        segments.shared[h, SHARED - 1],
                        changed,
                        means[found],
                        covariances[found],
                        pull,
                    )
                    inlier = log_weight[n, b] + log_in + log_density
                    outlier = log_weight[n, b] + stray
                    source[found], source[found + 1] = b, b
                    kind[found], kind[found + 1] = 2 * change + INLIER, 2 * change + OUTLIER
                    surprise = square[found] - rows > _SURPRISING * math.sqrt(2.0 * rows) + 1.0
                    if change == 0 and (parameters == 0 or not surprise):
                        # Nothing differs between the two but a state that is hardly ever the outlier's.
                        weight[found] = _log_sum(inlier, outlier)
                        found += 1
                        break
                    weight[found] = inlier + prior.change_log_probability[change]
                    weight[found + 1] = outlier + prior.change_log_probability[change]
                    square[found + 1] = square[found]
                    found += 2
            best, left = weight[:found].max(), 0
            old_which[:], old_event[:], old_squared[:] = which[n], event[n], squared[n]
            while left < min(size, found):
                c = int(weight[:found].argmax())
                if weight[c] < best - _FAINT:
                    break
                log_weight[n, left], which[n, left] = weight[c], old_which[source[c]]
                mean[n, left] = means[c, :parameters]
                covariance[n, left] = covariances[c, :parameters, :parameters]
                event[n, left], squared[n, left] = old_event[source[c]], old_squared[source[c]]
                event[n, left, episode], squared[n, left, episode] = kind[c], square[c]
                weight[c] = -np.inf
                left += 1
            number[n], episode = left, episode + 1
        for b in range(number[n]):
            for a in range(parameters):
                for c in range(a):
                    covariance[n, b, c, a] = covariance[n, b, a, c]

"""A row without contact: its gap is positive, or about zero where the peg rubs along the part."""

from __future__ import annotations

import math

import numpy as np

from bcppl.compiled import compiled
from bcppl.distributions.episodes.filter.branches import Branches, Prior, Segments
from bcppl.distributions.episodes.filter.conditioning import dot, squared_by
from bcppl.distributions.episodes.filter.gaps import Gaps, line
from bcppl.distributions.episodes.filter.workspace import Workspace

# Standard deviations by which the gap of a peg between two walls seems less: it is the least of two that err
# in opposite directions, so by the mean size of a normal error.
BETWEEN = math.sqrt(2.0 / math.pi)
RUBBING = 1.0  # standard deviations of the gap by which a command may be blocked without being felt
CLEAR = 0.02  # m: farther from the part than this a peg without contact says nothing
LOG_TWO_PI = math.log(2.0 * math.pi)


@compiled
def log_sum(a: float, b: float) -> float:
    """The logarithm of the sum of two numbers given by theirs."""
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high)) if low > -np.inf else high


@compiled
def assimilate_free(
    n: int,
    s: int,
    after: Branches,
    prior: Prior,
    segments: Segments,
    gaps: Gaps,
    room: Workspace,
    update: bool,
) -> None:
    """Weigh a particle's hypotheses for a row without contact, and `update` their parameters' moments."""
    row, number, parameters = segments.first[s], after.number[n], after.mean.shape[2]
    log_in = math.log1p(-prior.outlier)
    log_out = math.log(prior.outlier) if prior.outlier > 0.0 else -np.inf
    score, positive, either = np.nan, 0.0, 0.0
    for b in range(number):
        which, mean, covariance = after.which[n, b], after.mean[n, b], after.covariance[n, b]
        delay = prior.delay[which]
        column, pull = room.columns[delay, 0], room.pull
        if not room.filled[delay]:
            room.distance[delay, 0], room.filled[delay] = line(gaps, n, delay, row, column), True
        if room.distance[delay, 0] > CLEAR:
            continue
        gap = room.distance[delay, 0] + dot(column, mean)
        variance = segments.own[which, row] + squared_by(covariance, column, pull)
        variance += dot(gaps.residual[n, row], gaps.residual[n, row])
        root = math.sqrt(variance)
        # Hypotheses that differ in the compliance alone are the same without contact.
        if gap / root + BETWEEN != score:
            score = gap / root + BETWEEN
            positive = _log_free(score)
            either = log_sum(log_in + positive, log_out)
        after.log_weight[n, b] += either
        if update and log_in + positive > log_out and positive < 0.0:
            density = math.exp(-0.5 * score**2 - 0.5 * LOG_TWO_PI - positive)
            hazard = density * (1.0 - RUBBING * score)
            bend = density * (score + RUBBING - RUBBING * score**2) + hazard**2
            bend = max(bend, 0.0) / variance
            for a in range(parameters):
                mean[a] += pull[a] / root * hazard
                share = pull[a] * bend
                for c in range(parameters):
                    covariance[a, c] -= share * pull[c]


@compiled
def _log_free(score: float) -> float:
    """Log-probability of a row without contact whose gap is so many standard deviations.

    A peg may rub along the part with a force that is not felt, and is then at its surface. The score is that
    of a peg between two walls: `BETWEEN` is added.
    """
    log_density = -0.5 * score * score - 0.5 * LOG_TWO_PI
    return min(0.0, log_sum(_log_ndtr(score), math.log(RUBBING) + log_density))


@compiled
def _log_ndtr(z: float) -> float:
    """Logarithm of the standard normal distribution function."""
    if z > -30.0:
        return math.log(0.5 * math.erfc(-z / math.sqrt(2.0)))
    inverse = 1.0 / (z * z)
    return -0.5 * z * z - math.log(-z) - 0.5 * LOG_TWO_PI + math.log(1.0 - inverse + 3.0 * inverse**2)

"""The probability of a row without contact: its gap is positive, or about zero where the peg rubs along."""

from __future__ import annotations

import math

import numpy as np

from bcppl.arrays import Array
from bcppl.compiled import compiled

# Standard deviations by which the gap of a peg between two walls seems less: it is the least of two that err
# in opposite directions, so by the mean size of a normal error.
BETWEEN = math.sqrt(2.0 / math.pi)
RUBBING = 1.0  # standard deviations of the gap by which a command may be blocked without being felt
CLEAR = 0.02  # m: farther from the part than this a peg without contact says nothing
LOG_TWO_PI = math.log(2.0 * math.pi)


@compiled
def log_free(score: float) -> float:
    """Log-probability of a row without contact whose gap is so many standard deviations.

    A peg may rub along the part with a force that is not felt, and is then at its surface. The score is that
    of a peg between two walls: `BETWEEN` is added.
    """
    log_density = -0.5 * score * score - 0.5 * LOG_TWO_PI
    return min(0.0, log_sum(_log_ndtr(score), math.log(RUBBING) + log_density))


@compiled
def log_sum(a: float, b: float) -> float:
    """The logarithm of the sum of two numbers given by theirs."""
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high)) if low > -np.inf else high


@compiled
def log_total(each: Array) -> float:
    """The logarithm of the sum of numbers given by theirs, one of them finite."""
    high = each.max()
    return float(high + math.log(np.exp(each - high).sum()))


@compiled
def _log_ndtr(z: float) -> float:
    """Logarithm of the standard normal distribution function."""
    if z > -30.0:
        return math.log(0.5 * math.erfc(-z / math.sqrt(2.0)))
    inverse = 1.0 / (z * z)
    return -0.5 * z * z - math.log(-z) - 0.5 * LOG_TWO_PI + math.log(1.0 - inverse + 3.0 * inverse**2)

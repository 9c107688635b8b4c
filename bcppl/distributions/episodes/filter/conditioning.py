"""A normal over M parameters, conditioned on the gaps of an episode: the arithmetic of one hypothesis."""

from __future__ import annotations

import math

import numpy as np

from bcppl.arrays import Array
from bcppl.compiled import compiled, summed


@summed
def dot(first: Array, second: Array) -> float:
    """The dot product of two vectors."""
    total = 0.0
    for a in range(len(first)):
        total += first[a] * second[a]
    return total


@summed
def squared_by(covariance: Array, column: Array, product: Array) -> float:
    """Set `product` (M,) to a symmetric matrix times a column (M,); returns the column's square by it."""
    square = 0.0
    for a in range(len(column)):
        product[a] = dot(covariance[a], column)
        square += column[a] * product[a]
    return square


@compiled
def begin_contact(mean: Array, covariance: Array, variances: Array) -> None:
    """Set the last parameters, those of a contact, to ones of which nothing is known but their variances."""
    for k in range(len(variances)):
        a = len(mean) - len(variances) + k
        mean[a] = 0.0
        covariance[a, :] = 0.0
        covariance[:, a] = 0.0
        covariance[a, a] = variances[k]


@compiled
def informed(covariance: Array, known: Array, after: Array) -> float:
    """Set `after` (2, 2) to the covariance of two parameters when information (2, 2) on them has come.

    Returns:
        the logarithm of the determinant of the covariance by that of `after`.
    """
    a = 1.0 + covariance[0, 0] * known[0, 0] + covariance[0, 1] * known[1, 0]
    b = covariance[0, 0] * known[0, 1] + covariance[0, 1] * known[1, 1]
    c = covariance[1, 0] * known[0, 0] + covariance[1, 1] * known[1, 0]
    d = 1.0 + covariance[1, 0] * known[0, 1] + covariance[1, 1] * known[1, 1]
    determinant = a * d - b * c
    for k in range(2):
        after[0, k] = (d * covariance[0, k] - b * covariance[1, k]) / determinant
        after[1, k] = (a * covariance[1, k] - c * covariance[0, k]) / determinant
    return math.log(determinant)


@summed
def set_joint(columns: Array, pull: Array, errors: Array, residual: Array, joint: Array) -> None:
    """Set `joint` (n, n), the lower triangle, to the covariance of gaps by parameters and other errors."""
    for i in range(len(columns)):
        for j in range(i + 1):
            joint[i, j] = errors[i, j] + dot(residual[i], residual[j]) + dot(pull[i], columns[j])


@summed
def factorise(joint: Array, columns: Array, change: Array, loaded: Array, factor: Array) -> float:
    """Set `factor` (n, n) to the Cholesky factor of the gaps' covariance, its diagonal inverted.

    `joint` is that without the change, whose variances are `change` (M,); by row i it has come by the share
    `loaded[i]`.

    Returns:
        the logarithm of its determinant.
    """
    log_determinant = 0.0
    for i in range(len(joint)):
        for j in range(i + 1):
            factor[i, j] = joint[i, j]
    for a in range(len(change)):
        if change[a] > 0.0:
            for i in range(len(joint)):
                for j in range(i + 1):
                    factor[i, j] += change[a] * loaded[j] * columns[i, a] * columns[j, a]
    for i in range(len(joint)):
        variance = factor[i, i]
        for j in range(i):
            known = factor[i, j]
            for k in range(j):
                known -= factor[i, k] * factor[j, k]
            factor[i, j] = known * factor[j, j]
            variance -= factor[i, j] * factor[i, j]
        factor[i, i] = 1.0 / math.sqrt(variance)
        log_determinant += math.log(variance)
    return log_determinant


@summed
def whiten(factor: Array, error: Array, white: Array) -> float:
    """Set `white` (n,) to errors whitened by a factor as of `factorise`; returns the sum of their squares."""
    squared = 0.0
    for i in range(len(error)):
        rest = error[i]
        for k in range(i):
            rest -= factor[i, k] * white[k]
        white[i] = rest * factor[i, i]
        squared += white[i] * white[i]
    return squared


@summed
def condition(
    factor: Array,
    white: Array,
    pull: Array,
    columns: Array,
    change: Array,
    loaded: Array,
    gain: Array,
    mean: Array,
    covariance: Array,
) -> None:
    """Condition parameters, before the change, on an episode's gaps; `gain` (n, M) is room."""
    for i in range(len(white)):
        for a in range(len(mean)):
            gain[i, a] = pull[i, a] + loaded[i] * change[a] * columns[i, a]
        for k in range(i):
            for a in range(len(mean)):
                gain[i, a] -= factor[i, k] * gain[k, a]
        for a in range(len(mean)):
            gain[i, a] *= factor[i, i]
            mean[a] -= gain[i, a] * white[i]
    covariance -= np.dot(gain.T, gain)

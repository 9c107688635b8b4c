"""Gaps as linear functions of errors, fitted over where the errors may be: statistical linear regression.

Where flat faces meet, which corner of the peg touches depends on how it is turned, and the gap has a kink.
Its derivative there is that of one corner or of another: a likelihood that is linear about one point jumps by
several nats with a micrometre of the part's pose. The regression is over all that the errors may be, so it is
continuous wherever the gap is, and what it leaves over is an error of its own.

Source: Lefebvre, Bruyninckx and De Schutter, Kalman filters for non-linear systems, Int. J. Control 77, 2004.
The points are those of the cubature rule of degree 3 (Arasaratnam and Haykin, Cubature Kalman filters, IEEE
TAC 54, 2009), turned so that each is about one standard deviation off along five axes of six: a far one
reaches other places of the part than errors do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arrays import Array
from bcppl.compiled import compiled
from bcppl.devices import HOST, numbers, on_device_of, to_device
from bcppl.distributions.episodes.displaced import Lines
from bcppl.distributions.episodes.linear_errors import LinearErrors
from bcppl.distributions.manifold import MeasuresGap

# A conference matrix of order 6: its rows are orthogonal.
_CONFERENCE = np.array(
    [
        [0, 1, 1, 1, 1, 1],
        [1, 0, 1, -1, -1, 1],
        [1, 1, 0, 1, -1, -1],
        [1, -1, 1, 0, 1, -1],
        [1, -1, -1, 1, 0, 1],
        [1, 1, -1, -1, 1, 0],
    ],
    dtype=np.float64,
)
_POINTS = math.sqrt(6.0 / 5.0) * np.concatenate([_CONFERENCE, -_CONFERENCE])
_PEGS = 20_000  # at a time, about
# Variances (m^2, rad^2) that are added: a peg's place is hardly ever known better.
_LEAST = np.array([2e-5] * 3 + [1e-3] * 3) ** 2


class Spread(NamedTuple):
    """What the shared errors of each particle may be: mean (N, M) and covariance (N, M, M)."""

    mean: Tensor
    covariance: Tensor


def regressed(gap: MeasuresGap, pose: Tensor, rows: Tensor, bench: LinearErrors, errors: Spread) -> Lines:
    """The gaps as linear functions of shared errors, fitted over what these may be.

    Args:
        gap: measures gaps.
        pose: (N, 7) world_from_part.
        rows: (R, COLUMNS).
        bench: the errors that all touches share.
        errors: what they may be.
    """
    late, effect = to_device(bench.late_effects(rows), pose.device)
    by, turn = bench.effect_again(rows).twist, poses.rotation_matrix(rows[:, :7])  # (R, 6, M), (R, 3, 3)
    shape = (len(pose), len(rows))
    middle, slope, residual = np.empty(shape), np.empty((*shape, 6)), np.empty((*shape, 6))
    # Few parts at a time: pegs at all points of all parts take gigabytes, and longer than those in a cache.
    most = max(1, _PEGS // (len(rows) * len(_POINTS)))
    for first in range(0, len(pose), most):
        own = slice(first, first + most)
        errors_here = to_device(Spread(errors.mean[own], errors.covariance[own]), HOST)
        twist, root, peg = _pegs(by, turn, rows[:, :7], errors_here)
        pegs = on_device_of(peg.flatten(1, 2), pose)
        distance = numbers(gap(pose[own], pegs).distance).reshape(*peg.shape[:3])
        _fitted(distance, twist, root, middle[own], slope[own], residual[own])
    fitted = [on_device_of(each, pose) for each in (middle, slope, residual)]
    gradient = _by_part(fitted[1], pose, on_device_of(rows[:, :7], pose), on_device_of(turn, pose))
    return Lines(fitted[0], fitted[1], gradient, late, *effect, fitted[2])


def _pegs(by: Tensor, turn: Tensor, peg: Tensor, errors: Spread) -> tuple[Array, Array, Tensor]:
    """Mean twists (N, R, 6) of pegs, roots (N, R, 6, 6) of their covariances, and pegs (N, R, P, 7) there."""
    half = by.flatten(0, 1) @ errors.covariance  # (N, 6 R, M)
    shape = (len(half), len(peg))
    twist, root, steps = np.empty((*shape, 6)), np.empty((*shape, 6, 6)), np.empty((*shape, len(_POINTS), 6))
    tensors = (by, half, errors.mean, turn)
    by_row, by_half, mean, turns = (np.ascontiguousarray(each.numpy()) for each in tensors)
    _spread(by_row, by_half, mean, turns, twist, root, steps)
    return twist, root, poses.retract(peg[:, None].expand(*steps.shape[:3], 7), torch.from_numpy(steps))


@compiled
def _spread(
    by: Array, half: Array, mean: Array, turn: Array, twist: Array, root: Array, steps: Array
) -> None:
    """Set mean twists of the peg, roots of their covariances, and tangents (N, R, P, 6) of the points."""
    covariance, at = np.empty((6, 6)), np.empty(6)
    parameters = mean.shape[1]
    for n in range(len(twist)):
        for r in range(len(turn)):
            for i in range(6):
                total = 0.0
                for m in range(parameters):
                    total += by[r, i, m] * mean[n, m]
                twist[n, r, i] = total
                for j in range(i + 1):
                    total = 0.0
                    for m in range(parameters):
                        total += half[n, 6 * r + i, m] * by[r, j, m]
                    covariance[i, j] = total
                covariance[i, i] += _LEAST[i]
            factor = root[n, r]
            factor[:] = 0.0
            for i in range(6):
                for j in range(i + 1):
                    rest = covariance[i, j]
                    for k in range(j):
                        rest -= factor[i, k] * factor[j, k]
                    factor[i, j] = math.sqrt(rest) if i == j else rest / factor[j, j]
            for p in range(len(_POINTS)):
                for i in range(6):
                    at[i] = twist[n, r, i]
                    for k in range(i + 1):
                        at[i] += factor[i, k] * _POINTS[p, k]
                for i in range(3):
                    steps[n, r, p, 3 + i] = at[3 + i]
                    steps[n, r, p, i] = turn[r, i, 0] * at[0] + turn[r, i, 1] * at[1] + turn[r, i, 2] * at[2]


@compiled
def _fitted(distance: Array, twist: Array, root: Array, middle: Array, slope: Array, residual: Array) -> None:
    """Set the line through gaps (N, R, P) at no error, its slope by a twist, and what it leaves over.

    The sum of products of two gaps' residuals (6,) is the covariance of what their lines leave over.
    """
    half = len(_POINTS) // 2
    along = np.empty(half)
    for n in range(len(twist)):
        for r in range(twist.shape[1]):
            gaps, total = distance[n, r], 0.0
            for p in range(2 * half):
                total += gaps[p] / (2 * half)
            along[:] = 0.0
            for p in range(half):
                odd = 0.5 * (gaps[p] - gaps[half + p])
                # Across the points of each pair it is even: what is odd is linear in six directions.
                residual[n, r, p] = (0.5 * (gaps[p] + gaps[half + p]) - total) / math.sqrt(half)
                for k in range(6):
                    along[k] += odd * _POINTS[p, k] / half
            for i in range(5, -1, -1):
                rest = along[i]
                for k in range(i + 1, 6):
                    rest -= root[n, r, k, i] * slope[n, r, k]
                slope[n, r, i] = rest / root[n, r, i, i]
            for i in range(6):
                total -= slope[n, r, i] * twist[n, r, i]
            middle[n, r] = total


def _by_part(slope: Tensor, part: Tensor, peg: Tensor, turn: Tensor) -> Tensor:
    """The gap's derivatives (N, R, 6) by the part's pose: it changes as if the peg were moved back."""
    normal = -(turn @ slope[..., :3, None])[..., 0]
    moment = (turn @ slope[..., 3:, None])[..., 0]
    moment = moment + torch.linalg.cross(normal, peg[:, :3] - part[:, None, :3])
    return torch.cat([normal, -(moment @ poses.rotation_matrix(part))], dim=-1)

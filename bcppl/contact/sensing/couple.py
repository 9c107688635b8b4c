"""Torques on a peg that no single contact exerts."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.optimize import nnls

from bcppl.arrays import Array
from bcppl.geometry.parts import Part

# N m: what a sensor, the tool's weight or a peg that is off in the hand leave of a torque is less.
LEAST = 1.0
TURNED = 0.0004  # m
_SUM = 1e3  # weight of the condition that a place is within the box


def couple_of(wrench: Array, peg: Part) -> Array:
    """What is left of the torque on a peg at the place where one force, with its size, leaves least.

    The place is in the box around the peg. What is left several contacts exert, which press against each
    other: those of a peg that leans in a hole.

    Args:
        wrench: (R, 6) on the peg, in its frame about its origin, N and N m.
        peg: that is held.

    Returns:
        (R, 3) N m, in the peg's frame.
    """
    sides = np.stack([peg.vertices.min(axis=0), peg.vertices.max(axis=0)], axis=1)
    corners = np.array(list(itertools.product(*sides)))
    levers = np.cross(corners, wrench[:, None, :3])
    within = np.full(len(corners), _SUM)
    left = np.empty((len(wrench), 3))
    for k, (own, torque) in enumerate(zip(levers, wrench[:, 3:], strict=True)):
        shares, _ = nnls(np.vstack([own.T, within]), np.append(torque, _SUM))
        left[k] = torque - own.T @ shares
    return left


def turn_against(wrench: Array, peg: Part) -> Array:
    """The rotation of a peg against the couple on it, which its contacts prevent.

    Args:
        wrench: (R, 6) on the peg, as of `couple_of`.
        peg: that is held.

    Returns:
        (R, 3) a rotation vector in the peg's frame, rad, by which a place as far off as the peg is wide moves
        0.4 mm; 0 without a couple.
    """
    couple = couple_of(wrench, peg)
    size = np.linalg.norm(couple, axis=1, keepdims=True)
    breadth = np.sort(np.ptp(peg.vertices, axis=0))[1]
    return np.where(size > LEAST, -couple / np.maximum(size, LEAST) * TURNED / breadth, 0.0)

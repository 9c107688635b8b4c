"""The guess of a BOP object's pose: drawn about its ground truth, at a stated offset from it, or stated."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.optimize import brentq

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.poses import as_pose, retract


def draw(seed: int, translation: float, angle: float) -> Array:
    """A tangent (6,): a translation uniform in a box, a rotation uniform (Haar) within an angle.

    Under the Haar measure a rotation's angle a has density proportional to 1 - cos a, its axis is uniform.

    Args:
        seed: of the draw.
        translation: half width of the box, metres.
        angle: the largest rotation, radians.
    """
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-translation, translation, 3)
    mass = rng.uniform(0.0, angle - math.sin(angle))
    turn = brentq(lambda a: a - math.sin(a) - mass, 0.0, angle)
    axis = rng.normal(size=3)
    return np.concatenate([shift, turn * axis / np.linalg.norm(axis)])


def drawn(truth: Array, seed: int, translation: float, angle: float) -> Array:
    """A pose (7,) from which the truth (7,) is a draw away: the truth is uniform in the prior about it."""
    return retract(torch.from_numpy(truth), -torch.from_numpy(draw(seed, translation, angle))).numpy()


def offset_by(truth: Array, words: str) -> Array:
    """The pose (7,) at a stated offset from the truth (7,).

    Args:
        truth: the pose.
        words: three numbers in metres along the world's axes, three of a rotation vector in degrees in the
            part's.

    Raises:
        InputError: they are others.
    """
    offset = _numbers("--offset", words, 6, "x y z in metres and a rotation vector in degrees")
    offset[3:] = np.radians(offset[3:])
    return retract(torch.from_numpy(truth), torch.from_numpy(offset)).numpy()


def stated(words: str) -> Array:
    """The pose (7,) of seven numbers, metres and a quaternion w x y z.

    Raises:
        InputError: they are others.
    """
    return as_pose(_numbers("--guess", words, 7, "x y z qw qx qy qz in metres"), "--guess").numpy()


def _numbers(option: str, words: str, count: int, meaning: str) -> Array:
    try:
        values = np.array([float(word) for word in words.replace(",", " ").split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{option} is {words!r}; give {count} numbers, {meaning}.")
    return values

"""The pose within a prior at which something fits best: a search, coarse and quick."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.geometry.parts import Guess

ELITE = 8  # of the poses of a round, from which the next round is drawn
TAILS, TURNS = 0.02, 1.1  # m beyond the limits, but no more than these, and limits of turns: a search's reach
WIDEST, STEEPEST = 0.05, 0.6  # m and rad of tilt: a wider guess has too many places that look alike
NARROWEST = 0.02  # of the limits: spread of a round, at least


class Found(NamedTuple):
    """The best pose of a search.

    Attributes:
        pose: (7,) world_from_part.
        place: (6,) its coordinates in limits of the prior.
        score: of it.
    """

    pose: Array
    place: Array
    score: float


def limits(guess: Guess) -> Array:
    """Limits (6,) of a prior: metres along the world's axes, radians of tilt (two) and yaw."""
    tilt, yaw = (guess.tilt, guess.yaw) if guess.angle is None else (guess.angle, guess.angle)
    return np.array([*np.asarray(guess.translation, dtype=float), tilt, tilt, yaw])


def is_narrow(guess: Guess) -> bool:
    """Whether a guess says enough of where the part is for a search to tell right from wrong."""
    width = limits(guess)
    return bool(width[:3].max() <= WIDEST and width[3] <= STEEPEST)


def poses_at(guess: Guess, place: Array) -> Array:
    """Poses (N, 7) of the part at coordinates (N, 6), in limits of the prior."""
    tangent = place * limits(guess)
    yaw, tilt = np.zeros((2, len(place), 6))
    yaw[:, 5], tilt[:, :5] = tangent[:, 5], tangent[:, :5]
    center = torch.from_numpy(np.asarray(guess.world_from_part, dtype=float)).expand(len(place), 7)
    return np.asarray(
        poses.retract(poses.retract(center, torch.from_numpy(tilt)), torch.from_numpy(yaw)).numpy()
    )


def best_pose(
    score: Callable[[Array], Array],
    guess: Guess,
    start: Found | None = None,
    spread: float = 0.3,
    rounds: int = 4,
    draws: int = 48,
    reach: Array | None = None,
) -> Found:
    """The best of the poses that are drawn, from round to round about the best (the cross-entropy method).

    Args:
        score: of poses (N, 7): (N,), more is better.
        guess: the prior; poses hardly leave its limits.
        start: where to draw from at first, by `spread` in limits; all over the prior unless given.
        spread: of that.
        rounds: of the search.
        draws: poses of a round.
        reach: (6,) how far from the start the pose may be, metres and radians; anywhere unless given.
    """
    rng = np.random.default_rng(0)
    place = rng.uniform(-1.0, 1.0, (2 * draws, 6))
    place[0] = 0.0
    if start is not None:
        place = start.place + spread * rng.normal(size=(draws, 6))
        place[0] = start.place
    width = limits(guess)
    beyond = 1.0 + np.minimum(TAILS / np.maximum(width[:3], 1e-9), 1.0)
    high = np.array([*beyond, TURNS, TURNS, TURNS])
    low = -high
    if start is not None and reach is not None:
        near = reach / np.maximum(width, 1e-9)
        low, high = np.maximum(low, start.place - near), np.minimum(high, start.place + near)
    best = Found(np.asarray(guess.world_from_part, dtype=float), np.zeros(6), -math.inf)
    for _ in range(rounds):
        place = np.clip(place, low, high)
        there = poses_at(guess, place)
        scores = score(there)
        order = np.argsort(-scores)
        if scores[order[0]] > best.score:
            best = Found(there[order[0]], place[order[0]], float(scores[order[0]]))
        elite = place[order[:ELITE]]
        wide = np.maximum(elite.std(axis=0), NARROWEST)
        place = elite.mean(axis=0) + wide * rng.normal(size=(draws, 6))
    return best

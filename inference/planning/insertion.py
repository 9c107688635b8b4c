"""From a belief to a compliant insertion: where to press, how far to search, and how to push.

The peg comes down along the hole's axis at the posterior mean, presses softly, and goes round in a spiral
as wide as the belief is unsure, until it yields; then it is pushed with a stiffness that lets it turn with
the hole.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.holes import Hole, fit_in, hole_of
from bcppl.geometry.parts import Part
from bcppl.robot.insertion_plan import InsertionPlan
from bcppl.robot.plan import Manner, Plan

Array = npt.NDArray[np.float64]


class Attempt(NamedTuple):
    """How an insertion is made: metres, seconds, newtons, N/m along and N m/rad about the peg's axes.

    Attributes:
        above: where the peg starts above the hole.
        free, landing, searching, pushing: m/s at most. With a tenth of a millimetre of clearance and 0.2 mm
            and 0.4 degrees of doubt, searches at 5 mm/s passed over 2 of 21 holes, at 3 mm/s over none.
        touch: newtons at which the top is met.
        press: how far beyond that the search's command goes on; its spring along the axis presses by that.
        sure: the spiral reaches so many standard deviations of where the hole is.
        least, widest: between which the spiral's radius lies. It ends where the hole is, so that what is
            beyond costs time only where the belief was too sure.
        longest: the search's time at most; a spiral that would take longer is made up to twice as fast, then
            with a wider pitch.
        turns: rounds per second of the spiral at most.
        pitch: of the spiral, in clearances.
        force: at which the push stops.
        deep: share of the hole's depth that is pushed.
        search_stiffness, search_damping: firm across, so that friction holds the peg back by little.
        push_stiffness, push_damping: soft about all axes, so that the hole turns the peg.
    """

    above: float = 0.02
    free: float = 0.1
    landing: float = 0.015
    searching: float = 0.003
    pushing: float = 0.02
    touch: float = 0.7
    press: float = 0.006
    sure: float = 4.0
    least: float = 0.0003
    widest: float = 0.004
    longest: float = 15.0
    turns: float = 2.0
    pitch: float = 0.6
    force: float = 20.0
    deep: float = 0.95
    search_stiffness: tuple[float, ...] = (4000.0, 4000.0, 150.0, 300.0, 300.0, 300.0)
    search_damping: tuple[float, ...] = (180.0, 180.0, 60.0, 5.0, 5.0, 5.0)
    push_stiffness: tuple[float, ...] = (800.0, 800.0, 1500.0, 5.0, 5.0, 5.0)
    push_damping: tuple[float, ...] = (80.0, 80.0, 120.0, 0.6, 0.6, 0.6)


_STILL = 0.15  # s before anything moves, in which the wrench is tared
_SETTLE = 0.15  # s between the press and the search
_SUNK = 0.001  # m below the chamfer from which a peg is in a hole
_ROUND = 16  # knots per round, at least


def insertion_plan(
    belief: Belief, part: Part, peg: Part, hole: Hole | None = None, attempt: Attempt | None = None
) -> InsertionPlan:
    """A compliant insertion, laid out around a belief's mean and as wide as it is unsure.

    Args:
        belief: over world_from_part.
        part: what has the hole, its z axis out of its top.
        peg: what is held, its frame at the wrench sensor and its tip at its lowest z.
        hole: as `hole_of` finds it, which is asked unless it is given.
        attempt: speeds, forces and stiffness.

    Raises:
        InputError: the part has no hole or several, the peg does not fit, or a number of the attempt is not
            positive.
    """
    attempt = _checked(Attempt() if attempt is None else attempt)
    hole = hole_of(part) if hole is None else hole
    fit = fit_in(hole, peg)
    stands, clearance = torch.from_numpy(fit.hole_from_peg), fit.clearance
    place = torch.from_numpy(hole.part_from_hole)
    world_from_hole = poses.compose(belief.mean, place)
    doubt = _doubt(belief, world_from_hole, place)
    lands = max(0.001, attempt.sure * float(doubt[2, 2].sqrt()))
    times, tips, manners = _descent(attempt, lands)
    found, way = _spiral(doubt[:2, :2].numpy(), clearance, attempt)
    times = np.concatenate([times, times[-1] + found])
    tips = np.concatenate([tips, np.column_stack([way, np.full(len(way), tips[-1, 2])])])
    search_on: Manner = "searching"
    manners = (*manners, *((search_on,) * len(way)))

    def led(tip: Array) -> Array:
        """The peg's poses (K, 7) with its tip at places in the hole's frame."""
        hole_from_held = stands.expand(len(tip), 7).clone()
        hole_from_held[:, :3] += torch.from_numpy(tip)
        return np.asarray(poses.compose(world_from_hole, hole_from_held).numpy())

    search = Plan(
        "search",
        times,
        led(tips),
        manners,
        attempt.touch,
        np.array(attempt.search_stiffness),
        np.array(attempt.search_damping),
        sink=hole.chamfer + _SUNK,
    )
    deep = attempt.deep * hole.depth
    down = max(deep / attempt.pushing, 0.2)
    push = Plan(
        "push",
        np.array([0.0, down, down + 0.2]),
        led(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -deep], [0.0, 0.0, -deep]])),
        ("guarded", "held"),
        attempt.force,
        np.array(attempt.push_stiffness),
        np.array(attempt.push_damping),
    )
    return InsertionPlan(search, push, world_from_hole.numpy(), hole.depth, hole.chamfer)


def _checked(attempt: Attempt) -> Attempt:
    for name, value in attempt._asdict().items():
        if name.endswith(("stiffness", "damping")):
            given = value if isinstance(value, Sequence) and not isinstance(value, str) else ()
            if len(given) != 6:
                raise InputError(f"the insertion has {name} {value!r}; give six numbers.")
            for each in given:
                number_within(f"the insertion has {name} with {{}} in it", each, above=0.0)
        else:
            number_within(f"the insertion has {name} {{}}", value, above=0.0)
    return attempt


def _doubt(belief: Belief, world_from_hole: torch.Tensor, part_from_hole: torch.Tensor) -> torch.Tensor:
    """The covariance (3, 3) of where the hole's origin is, along the axes of its mean pose."""
    holes = poses.compose(belief.world_from_part, part_from_hole.expand(len(belief), 7))
    off = poses.transform(poses.inverse(world_from_hole), holes[:, :3])
    off = off - belief.weights @ off
    return (belief.weights[:, None] * off).T @ off


def _descent(attempt: Attempt, lands: float) -> tuple[Array, Array, tuple[Manner, ...]]:
    """Times (K,), tips (K, 3) in the hole's frame and manners (K - 1,) up to the beginning of a search."""
    lowest = -lands - 2.0 * attempt.touch / attempt.search_stiffness[2]
    pressed = lowest - attempt.press
    heights = np.array([attempt.above + lands, attempt.above + lands, lands, lowest, pressed, pressed])
    pace = [attempt.free, attempt.landing, 2.0 * attempt.landing]
    spans = [_STILL, *(np.abs(np.diff(heights[1:5])) / pace), _SETTLE]
    times = np.concatenate([[0.0], np.cumsum(np.maximum(spans, 0.05))])
    tips = np.column_stack([np.zeros((len(heights), 2)), heights])
    return times, tips, ("free", "free", "guarded", "held", "held")


def _spiral(doubt: Array, clearance: float, attempt: Attempt) -> tuple[Array, Array]:
    """Times (K,) from the start and places (K, 2) of a spiral that covers an ellipse of standard deviations.

    Rounds are a pitch apart, so that one of them passes the hole's middle within the clearance to each side.
    """
    variances, axes = np.linalg.eigh(doubt)
    spread = attempt.sure * np.sqrt(np.maximum(variances, 0.0))
    reach = np.clip(spread, attempt.least, attempt.widest) + clearance
    pitch = attempt.pitch * clearance
    # An ellipse's area over the pitch is the length of the way.
    pitch = max(pitch, math.pi * reach[0] * reach[1] / (2.0 * attempt.searching * attempt.longest))
    rounds = max(reach) / pitch
    angle = np.linspace(0.0, 2.0 * math.pi * rounds, max(2, math.ceil(_ROUND * rounds)) + 1)
    share = angle / angle[-1]
    way = (np.column_stack([np.cos(angle), np.sin(angle)]) * share[:, None] * reach) @ axes.T
    lengths = np.linalg.norm(np.diff(way, axis=0), axis=1)
    spans = np.maximum(lengths / attempt.searching, np.diff(angle) / (2.0 * math.pi * attempt.turns))
    spans *= min(1.0, attempt.longest / spans.sum())
    return np.cumsum(spans), way[1:]

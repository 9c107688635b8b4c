"""The probability under a belief that an insertion succeeds, by simulation."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.arguments import whole_number
from bcppl.arrays import Array, Mask
from bcppl.beliefs import Belief
from bcppl.contact.physics import PegPhysics, Rollout
from bcppl.geometry.holes import Hole, depth_reached, hole_of, lateral_error
from bcppl.geometry.parts import Part
from bcppl.inference.planning.waypoints import tip_of
from bcppl.inference.resampling import seeded, systematic
from bcppl.robot.plan import InsertionPlan, Plan, probe_of

_BESIDE, _SHARE = 0.002, 0.25  # m, and of the hole's width: a tip farther from its axis is not in the hole
_AT_ONCE = 50  # stamps that are simulated before particles whose search has ended are left out


class SuccessProbability(NamedTuple):
    """The probability that an insertion succeeds.

    Attributes:
        success: the share of the belief's weight that ends in the hole, deep enough.
        hole_found: the share for which the search finds the hole.
        standard_error: of `success`, from the number of particles simulated; since that of a share of 0 or 1
            is 0, it is computed with one success and one failure more.
    """

    success: float
    hole_found: float
    standard_error: float


def success_probability(
    belief: Belief,
    plan: InsertionPlan,
    physics: PegPhysics,
    hole: Hole | None = None,
    *,
    particles: int = 24,
    seed: int = 0,
) -> SuccessProbability:
    """The probability under a belief that a planned insertion succeeds.

    The same command is simulated for each particle's pose of the part. Each peg is then pushed from its pose
    at the end of the search, also where the search finds no hole, as by the arm. A contact force ends a push.

    Args:
        belief: over world_from_part.
        plan: from `insertion_plan`, for this belief or another.
        physics: of the part and the peg.
        hole: of the part; `hole_of(part, peg=peg)` unless given.
        particles: how many are drawn from the belief by weight and simulated; fewer if it has fewer.
        seed: of that draw.

    Raises:
        InputError: the part has no hole or several, the peg does not fit, or the number of particles is not
            positive.
    """
    whole_number("the success of an insertion is to be simulated for {} particles", particles)
    hole = hole_of(physics.part, peg=physics.peg) if hole is None else hole
    beginning = plan.search.world_from_peg[0]
    world_from_part = _draw(belief.relative(beginning), particles, seed)
    count = len(world_from_part)
    hole_found, world_from_peg = _search(plan, physics, hole, world_from_part)
    success = _push(plan, physics, hole, world_from_part, world_from_peg)
    smoothed = (success.sum() + 1.0) / (count + 2.0)
    error = math.sqrt(smoothed * (1.0 - smoothed) / count)
    return SuccessProbability(float(success.mean()), float(hole_found.mean()), error)


def _draw(belief: Belief, particles: int, seed: int) -> torch.Tensor:
    """Poses (M, 7) of equal weight."""
    with seeded(seed):
        chosen = systematic(belief.weights.log(), min(particles, len(belief)))
    return belief.world_from_part[chosen]


def _stopped_at_top(plan: InsertionPlan, peg: Part) -> Plan:
    """The search with its guarded motion stopped at the expected height of the hole's top."""
    search, hole_from_world = plan.search, poses.inverse(torch.from_numpy(plan.world_from_hole))
    if "guarded" not in search.manners:
        return search
    stop = search.manners.index("guarded") + 1
    tip = torch.tensor([[0.0, 0.0, tip_of(peg)]], dtype=torch.float64)
    lowest = poses.transform(torch.from_numpy(search.world_from_peg[stop]), tip)
    spring = search.force / max(float(search.stiffness[2]), 1e-9)
    undone = -float(poses.transform(hole_from_world, lowest)[0, 2]) - spring
    up = poses.rotation_matrix(torch.from_numpy(search.world_from_peg[stop])).numpy()[:, 2]
    stopped = search.world_from_peg.copy()
    stopped[stop:, :3] += undone * up
    return replace(search, world_from_peg=stopped)


def _search(
    plan: InsertionPlan, physics: PegPhysics, hole: Hole, world_from_part: torch.Tensor
) -> tuple[Mask, Array]:
    """Whether (N,) the search finds the hole, and the peg's poses (N, 7) at its end."""
    probe = probe_of(_stopped_at_top(plan, physics.peg))
    searching = probe.stamps >= plan.search.times[plan.search.manners.index("searching")] - 1e-9
    hole_found = np.zeros(len(world_from_part), dtype=bool)
    ends = np.full((len(world_from_part), 7), np.nan)
    left = np.arange(len(world_from_part))
    rollout = physics.start(world_from_part, probe)
    for first in range(0, len(probe.stamps), _AT_ONCE):
        rollout.advance(min(first + _AT_ONCE, len(probe.stamps)))
        world_from_peg = rollout.world_from_peg[:, first:]
        part_from_world = poses.inverse(world_from_part[left])[:, None].expand(*world_from_peg.shape[:2], 7)
        part_from_peg = poses.compose(part_from_world, torch.from_numpy(world_from_peg)).numpy()
        depth = depth_reached(hole, physics.peg, part_from_peg)
        sunk = (depth > plan.search.sink) & searching[first : rollout.count]
        ended = sunk.any(axis=1)
        rows, stamps = np.flatnonzero(ended), sunk[ended].argmax(axis=1)
        ends[left[ended]] = world_from_peg[rows, stamps]
        # A peg also sinks beside the part, or in another pocket of it, which ends the search too.
        hole_found[left[ended]] = lateral_error(hole, physics.peg, part_from_peg[rows, stamps]) < _beside(
            hole
        )
        if ended.all():
            break
        left, rollout = left[~ended], rollout[~ended]
        ends[left] = rollout.world_from_peg[:, -1]
    return hole_found, ends


def _beside(hole: Hole) -> float:
    """The distance (m) of a tip from a hole's axis from which on it is not in it."""
    left, front, right, back = hole.outline.bounds
    return min(_BESIDE, _SHARE * min(right - left, back - front))


def _push(
    plan: InsertionPlan, physics: PegPhysics, hole: Hole, world_from_part: torch.Tensor, ends: Array
) -> Mask:
    """Whether (N,) the pegs end in the hole, deep enough, pushed from the ends (N, 7) of their searches.

    One command serves all particles: the parts are moved instead of the pegs, until the pegs coincide.
    """
    pegs = torch.from_numpy(ends)
    start = torch.from_numpy(plan.push.world_from_peg[0])
    sunk = poses.transform(poses.inverse(start), pegs[:, :3])[:, 2]
    median = pegs[int((sunk - sunk.median()).abs().argmin())]
    push = plan.push_from(median.numpy())
    moved = poses.compose(poses.compose(median.expand(len(pegs), 7), poses.inverse(pegs)), world_from_part)
    probe = probe_of(push)
    rollout = physics.start(moved, probe).advance(len(probe.stamps))
    stamps = _stopped(rollout, push.force)
    world_from_peg = torch.from_numpy(rollout.world_from_peg[np.arange(len(pegs)), stamps])
    part_from_peg = poses.compose(poses.inverse(moved), world_from_peg).numpy()
    deep = depth_reached(hole, physics.peg, part_from_peg) >= plan.deep_enough
    return np.asarray(deep & (lateral_error(hole, physics.peg, part_from_peg) < _beside(hole)))


def _stopped(rollout: Rollout, force: float) -> npt.NDArray[np.int64]:
    """The stamps (N,) at which a force is exceeded twice in a row, or the last ones."""
    exceeded = np.linalg.norm(rollout.wrench[..., :3], axis=-1) > force
    twice = exceeded[:, 1:] & exceeded[:, :-1]
    last = exceeded.shape[1] - 1
    return np.asarray(np.where(twice.any(axis=1), twice.argmax(axis=1) + 1, last))

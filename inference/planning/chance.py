"""When to try: how probable it is under a belief that an insertion succeeds, simulated for its particles."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.arguments import seed_number, whole_number
from bcppl.beliefs import Belief
from bcppl.contact.physics import PegPhysics, Rollout
from bcppl.errors import InputError
from bcppl.geometry.holes import Hole, depth_reached, hole_of, lateral_error
from bcppl.geometry.parts import Part
from bcppl.inference.schemes import systematic
from bcppl.robot.insertion_plan import InsertionPlan
from bcppl.robot.motion import Probe
from bcppl.robot.plan import Plan

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_BESIDE = 0.002  # m: a tip farther from the hole's axis is not in the hole
_AT_ONCE = 50  # stamps that are simulated before those that have found the hole are left out


class Chance(NamedTuple):
    """How probable it is that an insertion succeeds.

    Attributes:
        success: the share of the belief's weight that ends in the hole, deep enough.
        found: the share for which the search finds the hole.
        error: the standard error of `success`, from the number of particles simulated; as a share that is
            0 or 1 shows none, it is that of a success and a failure more.
    """

    success: float
    found: float
    error: float


def chance_of_success(
    belief: Belief,
    plan: InsertionPlan,
    physics: PegPhysics,
    hole: Hole | None = None,
    *,
    particles: int = 24,
    seed: int = 0,
) -> Chance:
    """The probability under a belief that an insertion as planned succeeds.

    The same command is carried out against the part where each particle has it. Each peg is then pushed
    from where it stands, also where the search found nothing, as by the arm. As there, a push ends where its
    force is felt.

    Args:
        belief: over world_from_part.
        plan: from `insertion_plan`, of this belief or another.
        physics: of the part and the peg.
        hole: as `hole_of` finds it, which is asked unless it is given.
        particles: so many are drawn from the belief by their weights and simulated; fewer if it has fewer.
        seed: of that draw.

    Raises:
        InputError: the plan is of another kind, the part has no hole or several, the peg does not fit, or the
            number of particles is not positive.
    """
    if not isinstance(physics, PegPhysics):
        raise InputError(
            f"the chance of an insertion is to be simulated by a {type(physics).__name__}; give "
            "PegPhysics(part, peg)."
        )
    if not isinstance(plan, InsertionPlan):
        raise InputError(
            f"the chance of an insertion is asked of a {type(plan).__name__}; give what `insertion_plan` "
            "makes."
        )
    whole_number("the chance of an insertion is asked for {} particles", particles)
    hole = hole_of(physics.part) if hole is None else hole
    world_from_part = _drawn(belief, particles, seed)
    count = len(world_from_part)
    found, stands = _search(plan, physics, hole, world_from_part)
    success = _push(plan, physics, hole, world_from_part, stands)
    smoothed = (success.sum() + 1.0) / (count + 2.0)
    error = math.sqrt(smoothed * (1.0 - smoothed) / count)
    return Chance(float(success.mean()), float(found.mean()), error)


def _drawn(belief: Belief, particles: int, seed: int) -> torch.Tensor:
    """Poses (M, 7) of equal weight."""
    log_weights = belief.weights.log()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed_number(seed))
        chosen = systematic(log_weights, min(particles, len(belief)))
    return belief.world_from_part[chosen]


def _landed(plan: InsertionPlan, peg: Part) -> Plan:
    """The search with its guarded motion stopped where the hole's top is thought to be."""
    search, under = plan.search, poses.inverse(torch.from_numpy(plan.world_from_hole))
    if "guarded" not in search.manners:
        return search
    stops = search.manners.index("guarded") + 1
    tip = torch.tensor([[0.0, 0.0, float(peg.vertices[:, 2].min())]], dtype=torch.float64)
    lowest = poses.transform(torch.from_numpy(search.world_from_peg[stops]), tip)
    pressed = search.force / max(float(search.stiffness[2]), 1e-9)
    undone = -float(poses.transform(under, lowest)[0, 2]) - pressed
    up = poses.rotation_matrix(torch.from_numpy(search.world_from_peg[stops])).numpy()[:, 2]
    landed = search.world_from_peg.copy()
    landed[stops:, :3] += undone * up
    return replace(search, world_from_peg=landed)


def _search(
    plan: InsertionPlan, physics: PegPhysics, hole: Hole, world_from_part: torch.Tensor
) -> tuple[Mask, Array]:
    """Which particles (N,) find the hole, and where their peg stands then (N, 7)."""
    probe = _probe(_landed(plan, physics.peg))
    searching = probe.stamps >= plan.search.times[plan.search.manners.index("searching")] - 1e-9
    found = np.zeros(len(world_from_part), dtype=bool)
    stands = np.full((len(world_from_part), 7), np.nan)
    left = np.arange(len(world_from_part))
    rollout = physics.start(world_from_part, probe)
    for first in range(0, len(probe.stamps), _AT_ONCE):
        rollout.advance(min(first + _AT_ONCE, len(probe.stamps)))
        seen = rollout.world_from_peg[:, first:]
        part_from_world = poses.inverse(world_from_part[left])[:, None].expand(*seen.shape[:2], 7)
        part_from_peg = poses.compose(part_from_world, torch.from_numpy(seen)).numpy()
        deep = depth_reached(hole, physics.peg, part_from_peg)
        near = (deep > plan.search.sink) & searching[first : rollout.count]
        yields = near.any(axis=1)
        rows, first_sunk = np.flatnonzero(yields), near[yields].argmax(axis=1)
        stands[left[yields]] = seen[rows, first_sunk]
        # Beside the part, or in another pocket of it, a peg sinks too, and the search ends there.
        found[left[yields]] = lateral_error(hole, physics.peg, part_from_peg[rows, first_sunk]) < _BESIDE
        if yields.all():
            break
        left, rollout = left[~yields], rollout[~yields]
        stands[left] = rollout.world_from_peg[:, -1]
    return found, stands


def _push(
    plan: InsertionPlan, physics: PegPhysics, hole: Hole, world_from_part: torch.Tensor, stands: Array
) -> Mask:
    """Whether (N,) the pegs end in the hole, deep enough.

    One command serves all: instead of the pegs the parts are moved, until the pegs stand in the same place.
    """
    pegs = torch.from_numpy(stands)
    start = torch.from_numpy(plan.push.world_from_peg[0])
    sunk = poses.transform(poses.inverse(start), pegs[:, :3])[:, 2]
    middle = pegs[int((sunk - sunk.median()).abs().argmin())]
    push = plan.push_from(middle.numpy())
    moved = poses.compose(poses.compose(middle.expand(len(pegs), 7), poses.inverse(pegs)), world_from_part)
    probe = _probe(push)
    rollout = physics.start(moved, probe).advance(len(probe.stamps))
    ends = _stopped(rollout, push.force)
    there = torch.from_numpy(rollout.world_from_peg[np.arange(len(pegs)), ends])
    part_from_peg = poses.compose(poses.inverse(moved), there).numpy()
    deep = depth_reached(hole, physics.peg, part_from_peg) >= plan.deep_enough
    return np.asarray(deep & (lateral_error(hole, physics.peg, part_from_peg) < _BESIDE))


def _stopped(rollout: Rollout, force: float) -> npt.NDArray[np.int64]:
    """The stamps (N,) at which a force was felt twice in a row, or the last ones."""
    felt = np.linalg.norm(rollout.wrench[..., :3], axis=-1) > force
    twice = felt[:, 1:] & felt[:, :-1]
    last = felt.shape[1] - 1
    return np.asarray(np.where(twice.any(axis=1), twice.argmax(axis=1) + 1, last))


def _probe(plan: Plan) -> Probe:
    """The command of a plan of which nothing is stopped."""
    count = round(float(plan.times[-1] - plan.times[0]) * plan.rate)
    stamps = plan.times[0] + np.arange(count) / plan.rate
    return Probe(plan.name, plan.times, plan.world_from_peg, plan.stiffness, plan.damping, stamps)

"""An arm that executes an insertion: it searches until the peg sinks in, and pushes from there."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.geometry.parts import Part
from bcppl.models.worlds.bench.reality import BenchReality
from bcppl.models.worlds.guarded_motion import execute
from bcppl.robot.commands import stamps_of
from bcppl.robot.execution import TARE
from bcppl.robot.plan import InsertionPlan

_BESIDE = 0.002  # m: a tip farther from the hole's axis is not in the hole but beside the part


class InsertionResult(NamedTuple):
    """The result of an insertion.

    Attributes:
        inserted: whether the peg ended in the hole, at least 0.8 of its depth or 10 mm beyond its chamfer
            below the top of the part.
        found_at: when (s) the search ended because the peg sank in; NaN where it did not. The push follows
            all the same, and may still succeed, unless the search felt no contact at all.
        depth: of the tip below the top at the end, metres.
        peak_force: the largest force on the peg at a sample, N.
        sustained_force: the largest force on the peg over two samples in a row, N: an impact is shorter.
        time: of the whole insertion, s.
    """

    inserted: bool
    found_at: float
    depth: float
    peak_force: float
    sustained_force: float
    time: float


def insert(
    plan: InsertionPlan,
    part: Part,
    peg: Part,
    contact: ContactParameters,
    world_from_part: Array,
    part_from_hole: Array,
    error: Array,
    pose_error: Array,
    reality: BenchReality | None = None,
) -> InsertionResult:
    """Simulate an arm that executes an insertion.

    Args:
        plan: of the insertion.
        part: with the hole.
        peg: the held peg, truly.
        contact: the world's physics.
        world_from_part: (7,) true pose of the part; not used with a reality.
        part_from_hole: (7,) true pose of its hole.
        error: (T, 6) of the measured wrench, N and N m; T as `samples_of` the plan. A push from higher up
            takes longer, and begins again with those of its own.
        pose_error: (T, 6) of the peg's measured pose, m and radians, in the peg's axes.
        reality: in which the robot is wrong, and nothing slips any more; by default it is right.
    """
    reality = BenchReality.right(world_from_part) if reality is None else reality.settled()
    search = execute(
        plan.search, part, peg, contact, world_from_part, error, stop_at_hole=True, reality=reality
    )
    searched = [t for k, t in search.stops.items() if plan.search.manners[k] == "searching"]
    executed = [search]
    if searched or search.contact_pose is not None:
        done = len(search.wrench)
        tare = (search.felt[:TARE, :3] + error[:TARE, :3]).mean(axis=0)
        last = torch.from_numpy(search.encoders[-1])
        measured = poses.retract(last, torch.from_numpy(pose_error[done - 1]))
        pushed = plan.push_from(measured.numpy(), _below(search.contact_pose, measured))
        left = np.pad(error[done:], ((0, max(0, len(stamps_of(pushed)) - len(error) + done)), (0, 0)), "wrap")
        push = execute(
            pushed,
            part,
            peg,
            contact,
            world_from_part,
            left,
            after=search,
            tare=tare,
            reality=reality,
        )
        executed.append(push)
    world_from_hole = poses.compose(torch.from_numpy(reality.part_at()), torch.from_numpy(part_from_hole))
    tip = torch.tensor([[0.0, 0.0, float(peg.vertices[:, 2].min())]], dtype=torch.float64)
    end = poses.transform(torch.from_numpy(executed[-1].world_from_peg[-1]), tip)
    in_hole = poses.transform(poses.inverse(world_from_hole), end)[0]
    depth, beside = -float(in_hole[2]), float(in_hole[:2].norm())
    force = np.linalg.norm(np.concatenate([each.wrench for each in executed])[:, :3], axis=1)
    return InsertionResult(
        inserted=bool(depth >= plan.deep_enough and beside < _BESIDE),
        found_at=searched[0] if searched else math.nan,
        depth=depth,
        peak_force=float(force.max()),
        sustained_force=float(np.minimum(force[1:], force[:-1]).max()),
        time=len(force) / plan.search.rate,
    )


def _below(contact_pose: Array | None, world_from_peg: torch.Tensor) -> float | None:
    """How far (m) a peg is below its contact with the top, along its z; None without contact."""
    if contact_pose is None:
        return None
    peg_from_world = poses.inverse(torch.from_numpy(contact_pose))
    return -float(poses.transform(peg_from_world, world_from_peg[None, :3])[0, 2])


def samples_of(plan: InsertionPlan) -> int:
    """The number of samples of an insertion whose push begins where the top is expected, or below it."""
    return len(stamps_of(plan.search)) + len(stamps_of(plan.push))

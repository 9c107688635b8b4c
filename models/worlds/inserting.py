"""An arm that carries out an insertion: it searches until the peg yields, and pushes from where it stands."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.geometry.parts import Part
from bcppl.models.worlds.guarded_motion import TARE, execute, stamps_of
from bcppl.robot.insertion_plan import InsertionPlan

Array = npt.NDArray[np.float64]


_BESIDE = 0.002  # m: a tip farther from the hole's axis is not in the hole but beside the part


class InsertionResult(NamedTuple):
    """How an insertion went.

    Attributes:
        inserted: whether the peg ended in the hole, at least 0.8 of its depth or 10 mm beyond its chamfer
            below the top of the part.
        found: when (s) the search ended because the peg yielded; NaN where it did not. It is pushed then as
            well, and may slip in.
        depth: how deep the tip truly ended below the top, metres.
        peak_force: the largest force that was exerted on the peg at a sample, N.
        peak_press: the same but for single samples, over within which is an impact: of each two samples in a
            row the lesser, N.
        time: seconds that all of it took.
    """

    inserted: bool
    found: float
    depth: float
    peak_force: float
    peak_press: float
    time: float


def insert(
    plan: InsertionPlan,
    part: Part,
    peg: Part,
    contact: ContactParameters,
    world_from_part: Array,
    part_from_hole: Array,
    error: Array,
    wobble: Array,
) -> InsertionResult:
    """Simulate an arm that carries out an insertion.

    Args:
        plan: what it is asked to do.
        part: what has the hole.
        peg: what is held.
        contact: the world's physics.
        world_from_part: (7,) where the part truly is.
        part_from_hole: (7,) where its hole truly is.
        error: (T, 6) what the sensor adds to the wrench, N and N m; T as `samples_of` the plan.
        wobble: (T, 6) what the measured pose of the peg is off by, m and radians, in the peg's axes.
    """
    search = execute(plan.search, part, peg, contact, world_from_part, error, until_found=True)
    done = len(search.wrench)
    zero = (search.wrench[:TARE, :3] + error[:TARE, :3]).mean(axis=0)
    seen = poses.retract(torch.from_numpy(search.world_from_peg[-1]), torch.from_numpy(wobble[done - 1]))
    push = execute(
        plan.push_from(seen.numpy(), _below(search.met, seen)),
        part,
        peg,
        contact,
        world_from_part,
        error[done:],
        following=search,
        zero=zero,
    )
    world_from_hole = poses.compose(torch.from_numpy(world_from_part), torch.from_numpy(part_from_hole))
    tip = torch.tensor([[0.0, 0.0, float(peg.vertices[:, 2].min())]], dtype=torch.float64)
    there = poses.transform(torch.from_numpy(push.world_from_peg[-1]), tip)
    in_hole = poses.transform(poses.inverse(world_from_hole), there)[0]
    depth, beside = -float(in_hole[2]), float(in_hole[:2].norm())
    force = np.linalg.norm(np.concatenate([search.wrench, push.wrench])[:, :3], axis=1)
    searched = [t for k, t in search.stops.items() if plan.search.manners[k] == "searching"]
    return InsertionResult(
        inserted=bool(depth >= plan.deep_enough and beside < _BESIDE),
        found=searched[0] if searched else float("nan"),
        depth=depth,
        peak_force=float(force.max()),
        peak_press=float(np.minimum(force[1:], force[:-1]).max()),
        time=len(force) / plan.search.rate,
    )


def _below(met: Array | None, seen: torch.Tensor) -> float | None:
    """How far (m) a peg is below where it met the top, along its z; None where it met nothing."""
    if met is None:
        return None
    return -float(poses.transform(poses.inverse(torch.from_numpy(met)), seen[None, :3])[0, 2])


def samples_of(plan: InsertionPlan) -> int:
    """How many samples an insertion takes at most."""
    return len(stamps_of(plan.search)) + len(stamps_of(plan.push))

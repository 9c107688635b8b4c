"""Whether a robot's joints get a tool along a path of poses."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import seed_number, whole_number
from bcppl.errors import InputError
from bcppl.robot.kinematics import Robot

Array = npt.NDArray[np.float64]

NEAR = (0.0005, math.radians(0.5))  # m and rad: a pose is reached that is missed by no more
_LEVER = 0.3  # m that a radian is worth where both are brought down together
_DAMPING = 1e-4
_FARTHEST = 0.4  # rad or m by which a joint is moved in one step
_FIRST, _NEXT = 50, 25  # steps to the first pose of a path, and from one to the next


def joint_paths(
    robot: Robot,
    link: str,
    base_from_tool: Array,
    link_from_tool: Array | None = None,
    *,
    tries: int = 8,
    seed: int = 0,
) -> Array:
    """Joint angles along paths of poses, within the joints' limits.

    Damped least squares (Wampler, Manipulator inverse kinematic solutions based on vector formulations and
    damped least-squares methods, IEEE SMC 16, 1986) from several starts in one batch; a path's poses are
    reached one after another, each from the angles of the one before, so that the arm does not turn over
    between them. It looks at joints alone: what the arm's links may hit is not asked.

    Args:
        robot: named with a tip, so that no joint is left that does not move the link.
        link: what the tool is mounted on.
        base_from_tool: (P, K, 7) P paths of K poses in the robot's base frame.
        link_from_tool: (7,) how the tool is mounted; None: its frame is the link's.
        tries: starts for each path.
        seed: of the starts.

    Returns:
        (P, K, J) radians, metres where a joint is prismatic; NaN for the paths that are not reached.

    Raises:
        InputError: the poses are not (P, K, 7), the robot has no link of that name, or no joint moves.
    """
    tries, seed = whole_number("a path is tried from {} starts", tries), seed_number(seed)
    goal = poses.as_pose(torch.as_tensor(base_from_tool), "a path of the tool")
    if goal.ndim != 3:
        raise InputError(f"paths of the tool have shape {tuple(goal.shape)}; give (P, K, 7).")
    if not robot.joints:
        raise InputError(f"{robot.name} has no joint that moves {link!r}; name another link.")
    count, length = goal.shape[:2]
    low, high = (
        torch.tensor([_within(getattr(j, of)) for j in robot.joints], dtype=torch.float64)
        for of in ("lower", "upper")
    )
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(tries, len(robot.joints), generator=generator, dtype=torch.float64)
    share[0] = 0.5
    angles = (low + share * (high - low)).repeat(count, 1)
    mounted = None if link_from_tool is None else torch.as_tensor(link_from_tool)
    reached = torch.ones(count * tries, dtype=torch.bool)
    found = []
    for k in range(length):
        there = goal[:, k].repeat_interleave(tries, dim=0)
        for _ in range(_NEXT if k else _FIRST):
            missed, slope = _missed(robot, link, angles, there, mounted)
            near = _is_near(missed)
            # One way to a path's first pose is enough; those that are on their way go on together.
            if bool(near[reached].all() if k else near.reshape(count, tries).any(dim=1).all()):
                break
            angles = (angles + _step(missed, slope)).clamp(low, high)
        missed, _ = _missed(robot, link, angles, there, mounted)
        reached = reached & _is_near(missed)
        found.append(angles)
        if not bool(reached.any()):
            return np.full((count, length, len(robot.joints)), np.nan)
    paths = torch.stack(found, dim=1).reshape(count, tries, length, -1)
    good = reached.reshape(count, tries)
    chosen = paths[torch.arange(count), good.to(torch.int8).argmax(dim=1)]
    chosen[~good.any(dim=1)] = torch.nan
    return np.asarray(chosen.numpy())


def _within(limit: float) -> float:
    """A joint's limit; a joint without one may turn once either way."""
    return float(np.clip(limit, -2.0 * math.pi, 2.0 * math.pi))


def _missed(
    robot: Robot, link: str, angles: Tensor, goal: Tensor, mounted: Tensor | None
) -> tuple[Tensor, Tensor]:
    """By what (B, 6) poses are missed, metres and radians, and how that hangs on the angles (B, 6, J)."""
    angles = angles.detach().requires_grad_()
    missed = poses.local(goal, robot.base_from_link(link, angles, link_from_tool=mounted))
    slope = [torch.autograd.grad(missed[:, k].sum(), angles, retain_graph=k < 5)[0] for k in range(6)]
    return missed.detach(), torch.stack(slope, dim=1)


def _step(missed: Tensor, slope: Tensor) -> Tensor:
    """By what (B, J) the angles are to change."""
    scale = torch.tensor([1.0] * 3 + [_LEVER] * 3, dtype=torch.float64)
    error, slope = missed * scale, slope * scale[:, None]
    square = slope @ slope.transpose(-1, -2) + _DAMPING * torch.eye(6, dtype=torch.float64)
    step = -(slope.transpose(-1, -2) @ torch.linalg.solve(square, error[..., None]))[..., 0]
    largest = step.abs().amax(dim=-1, keepdim=True).clamp_min(1e-12)
    return step * (_FARTHEST / largest).clamp_max(1.0)


def _is_near(missed: Tensor) -> Tensor:
    shift, turn = missed[:, :3].norm(dim=-1), missed[:, 3:].norm(dim=-1)
    return (shift < NEAR[0]) & (turn < NEAR[1])

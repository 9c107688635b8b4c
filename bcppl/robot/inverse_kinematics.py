"""Inverse kinematics along paths of tool poses, within the joint limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import seed_number
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.robot.description import MOVING, Joint
from bcppl.robot.kinematics import Robot

NEAR = (0.0005, math.radians(0.5))  # m and rad: tolerance at which a pose is reached
_LEVER = 0.3  # m per radian in the norm of the error
_DAMPING = 1e-4
_FARTHEST = 0.4  # rad or m, largest change of a joint in one step
_STARTS = 8  # for each path
_FIRST, _NEXT = 50, 25  # steps, at most, to the first pose of a path and from one pose to the next


def joint_paths(
    robot: Robot,
    link: str,
    base_from_tool: Array,
    link_from_tool: Array | None = None,
    *,
    near: Array | None = None,
    seed: int = 0,
) -> Array:
    """Joint angles along paths of poses, within the limits of the joints and of those that mimic them.

    Damped least squares (Wampler, Manipulator inverse kinematic solutions based on vector formulations and
    damped least-squares methods, IEEE SMC 16, 1986) from several starts in one batch; each pose of a path is
    solved from the solution of the one before, so that the arm does not change its configuration in between.
    Collisions of the links are not checked.

    Args:
        robot: constructed with a tip, so that all joints move the link.
        link: to which the tool is mounted.
        base_from_tool: (P, K, 7) P paths of K poses in the robot's base frame.
        link_from_tool: (7,) the tool's pose on the link; None for the link's frame.
        near: (J,) angles that are the only start, so that the arm keeps its configuration; by default the
            middle of the limits and others within them.
        seed: of the starts.

    Returns:
        (P, K, J) radians, metres where a joint is prismatic; NaN for paths that are not reached.

    Raises:
        InputError: a pose is not valid, the robot has no link of that name, no joint moves, or the limits of
            joints that move together exclude each other.
    """
    seed = seed_number(seed)
    goal = poses.as_pose(torch.as_tensor(base_from_tool), "a path of the tool")
    if not robot.joints:
        raise InputError(f"{robot.name} has no joint that moves {link!r}; name another link.")
    count, length = goal.shape[:2]
    low, high = map(torch.from_numpy, _limits(robot))
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(_STARTS, len(robot.joints), generator=generator, dtype=torch.float64)
    share[0] = 0.5
    starts = low + share * (high - low) if near is None else torch.as_tensor(near).reshape(1, -1)
    angles = starts.clamp(low, high).repeat(count, 1)
    mounted = None if link_from_tool is None else torch.as_tensor(link_from_tool)
    reached = torch.ones(len(angles), dtype=torch.bool)
    path = []
    for k in range(length):
        target = goal[:, k].repeat_interleave(len(starts), dim=0)
        for _ in range(_NEXT if k else _FIRST):
            error, jacobian = _error(robot, link, angles, target, mounted)
            there = _is_near(error)
            # One solution for a path's first pose suffices; afterwards all that have reached theirs go on.
            if bool(there[reached].all() if k else there.reshape(count, -1).any(dim=1).all()):
                break
            angles = (angles + _step(error, jacobian)).clamp(low, high)
        error, _ = _error(robot, link, angles, target, mounted)
        reached = reached & _is_near(error)
        path.append(angles)
        if not bool(reached.any()):
            return np.full((count, length, len(robot.joints)), np.nan)
    paths = torch.stack(path, dim=1).reshape(count, len(starts), length, -1)
    good = reached.reshape(count, -1)
    chosen = paths[torch.arange(count), good.to(torch.int8).argmax(dim=1)]
    chosen[~good.any(dim=1)] = torch.nan
    return np.asarray(chosen.numpy())


class Driven(NamedTuple):
    """A joint whose value is `factor` times that of the robot's joint number `driver`, plus `constant`."""

    joint: Joint
    driver: int
    factor: float
    constant: float


def driven_joints(robot: Robot) -> Iterator[Driven]:
    """The J joints themselves, of factor 1, and all that mimic one of them, from the base outwards."""
    number = {joint.name: k for k, joint in enumerate(robot.joints)}
    joints = {joint.name: joint for joint in map(robot.joint_to, robot.links[1:]) if joint.kind in MOVING}
    for joint in joints.values():
        driver, factor, constant = joint, 1.0, 0.0
        while driver.mimics is not None and driver.name not in robot.held:
            name, multiplier, offset = driver.mimics
            driver, factor, constant = joints[name], factor * multiplier, constant + factor * offset
        if driver.name in number:
            yield Driven(joint, number[driver.name], factor, constant)


def _limits(robot: Robot) -> tuple[Array, Array]:
    """The lowest and the highest values (J,) of the joints; without a limit, a revolution either way."""
    most = 2.0 * math.pi
    low, high = np.full(len(robot.joints), -most), np.full(len(robot.joints), most)
    for joint, k, factor, constant in driven_joints(robot):
        if factor:
            ends = sorted((limit - constant) / factor for limit in (joint.lower, joint.upper))
            low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
    if (low > high).any():
        name = robot.joints[int(np.argmax(low > high))].name
        raise InputError(
            f"no value of joint {name!r} of {robot.name} is within its limits and those of the joints that "
            "mimic it; correct them in the URDF file."
        )
    return low, high


def _error(
    robot: Robot, link: str, angles: Tensor, goal: Tensor, mounted: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Pose errors (B, 6), metres and radians, and their Jacobian (B, 6, J) with respect to the angles."""
    angles = angles.detach().requires_grad_()
    error = poses.local(goal, robot.base_from_link(link, angles, link_from_tool=mounted))
    rows = [torch.autograd.grad(error[:, k].sum(), angles, retain_graph=k < 5)[0] for k in range(6)]
    return error.detach(), torch.stack(rows, dim=1)


def _step(error: Tensor, jacobian: Tensor) -> Tensor:
    """The damped least-squares step (B, J) of the angles."""
    scale = torch.tensor([1.0] * 3 + [_LEVER] * 3, dtype=torch.float64)
    error, jacobian = error * scale, jacobian * scale[:, None]
    square = jacobian @ jacobian.transpose(-1, -2) + _DAMPING * torch.eye(6, dtype=torch.float64)
    step = -(jacobian.transpose(-1, -2) @ torch.linalg.solve(square, error[..., None]))[..., 0]
    largest = step.abs().amax(dim=-1, keepdim=True).clamp_min(1e-12)
    return step * (_FARTHEST / largest).clamp_max(1.0)


def _is_near(error: Tensor) -> Tensor:
    shift, turn = error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)
    return (shift < NEAR[0]) & (turn < NEAR[1])

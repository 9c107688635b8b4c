"""Constraints of motion planning: collisions, contact, direction, duration, force and the arm's reach."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.gap import PegGap
from bcppl.geometry.parts import Part
from bcppl.inference.planning.constraints import Constraint, per_candidate
from bcppl.inference.planning.motions import expected_contacts, free_path, pressing_force, whole_path
from bcppl.robot.arm_with_peg import ArmWithPeg
from bcppl.robot.commands import interpolated_command
from bcppl.robot.inverse_kinematics import joint_paths
from bcppl.robot.plan import Plan, probe_of
from bcppl.sensors.candidates import Candidate, duration_of, motion_of, placement_of

_CONTACT = 0.0005  # m: a peg so near to the part is in contact with it
_FROM_BELOW = math.radians(120.0)  # of a direction to that straight from above
_SHIFT, _TURN = 0.02, math.radians(10.0)  # m and rad between the poses at which reach is asked for


def approach_within(direction: Sequence[float], angle: float, violation: str = "") -> Constraint:
    """Plans' guarded motions and views' optical axes are within an angle of a direction.

    Args:
        direction: (3,) in the world, of any length, of the peg's motion or the camera's optical axis;
            [0, 0, -1] for touches from above.
        angle: radians.
        violation: a phrase for candidates that violate it.

    Raises:
        InputError: the direction has no length, or the angle is no number from 0 to pi.
    """
    number_within("candidates are to approach within an angle of {}", angle, least=0.0, most=math.pi)
    along = np.asarray(direction, dtype=np.float64)
    if along.shape != (3,) or not (np.isfinite(along).all() and np.linalg.norm(along) > 0.0):
        raise InputError(f"a direction of approach is {direction}; give three numbers, not all zero.")
    along = along / np.linalg.norm(along)

    def satisfies(candidate: Candidate) -> bool:
        motion, placement = motion_of(candidate), placement_of(candidate)
        directions = [] if motion is None else [direction for _, direction in expected_contacts(motion)]
        if placement is not None:
            pose = torch.as_tensor(placement.world_from_sensor)
            directions.append(poses.rotation_matrix(pose)[:, 2].numpy())
        return all(bool(one @ along > math.cos(angle) - 1e-9) for one in directions)

    stated = f"approach at more than {math.degrees(angle):.3g}° to the direction that was asked for"
    return per_candidate(violation or stated, satisfies)


def not_from_below() -> Constraint:
    """Touches, views and hands come from above or from the side, at most 30 degrees from below.

    The hand is at the end of the peg's axis, so that axis is within 120 degrees of up all along a plan.
    """
    approach = approach_within((0.0, 0.0, -1.0), _FROM_BELOW, "come from below")

    def is_held_from_above(candidate: Candidate) -> bool:
        motion = motion_of(candidate)
        if motion is None:
            return True
        up = poses.rotation_matrix(torch.from_numpy(whole_path(motion)))[:, 2, 2]
        return bool((up > math.cos(_FROM_BELOW) - 1e-9).all())

    def satisfied(candidates: Sequence[Candidate]) -> list[bool]:
        return [
            approaches and is_held_from_above(candidate)
            for candidate, approaches in zip(candidates, approach.satisfied(candidates), strict=True)
        ]

    return Constraint(approach.violation, satisfied)


def collision_free(gap: PegGap, world_from_part: Array | torch.Tensor) -> Constraint:
    """Plans' free paths do not lead through the part at a pose (7,); see `free_path`."""
    free = _distances(gap, world_from_part, free_path)
    return Constraint("lead through the part", lambda plans: [bool((d > 0.0).all()) for d in free(plans)])


def contact_at_mid_stroke(gap: PegGap, world_from_part: Array | torch.Tensor) -> Constraint:
    """Plans' guarded motions make contact with the part at a pose (7,) in the middle of their stroke."""

    def middles(plan: Plan) -> Array:
        return np.array([pose for pose, _ in expected_contacts(plan)]).reshape(-1, 7)

    met = _distances(gap, world_from_part, middles)
    return Constraint(
        "would meet the part elsewhere or not at all",
        lambda plans: [bool((np.abs(d) < _CONTACT).all()) for d in met(plans)],
    )


def _distances(
    gap: PegGap, world_from_part: Array | torch.Tensor, path_of: Callable[[Plan], Array]
) -> Callable[[Sequence[Candidate]], list[Array]]:
    """The distances (M,) of part and peg along each candidate's path (M, 7); (0,) without a motion."""
    part = poses.as_pose(world_from_part, "the part's pose")[None]

    def distances(candidates: Sequence[Candidate]) -> list[Array]:
        motions = [motion_of(candidate) for candidate in candidates]
        paths = [np.empty((0, 7)) if motion is None else path_of(motion) for motion in motions]
        if not sum(map(len, paths)):
            return [np.empty(0)] * len(paths)
        distance = gap(part, torch.from_numpy(np.concatenate(paths))).distance[0].numpy()
        return np.split(distance, np.cumsum([len(path) for path in paths])[:-1])

    return distances


def above_table(peg: Part | None, height: float, margin: float = 0.002) -> Constraint:
    """Plans keep the peg's lowest point a margin (m) above a table of a height (m), views their sensor."""
    number_within("the table is {} m high", height)
    hull = np.zeros((1, 3)) if peg is None else np.ascontiguousarray(peg.mesh.convex_hull.vertices)
    corners = torch.from_numpy(hull)

    def satisfies(candidate: Candidate) -> bool:
        motion, placement = motion_of(candidate), placement_of(candidate)
        if placement is not None and not placement.world_from_sensor[2] > height:
            return False
        if motion is None:
            return True
        lowest = poses.transform(torch.from_numpy(whole_path(motion)), corners)[..., 2].min()
        return bool(lowest > height + margin)

    return per_candidate("lead into the table", satisfies)


def duration_at_most(seconds: float) -> Constraint:
    """Plans last at most so many seconds."""
    number_within("candidates may last {} s", seconds, least=0.0)
    return per_candidate(f"last longer than {seconds:.3g} s", lambda one: duration_of(one) <= seconds + 1e-9)


def force_at_most(force: float) -> Constraint:
    """Plans press with at most a force (N); see `pressing_force`."""
    limit = number_within("candidates may press with {} N", force, above=0.0)

    def satisfies(candidate: Candidate) -> bool:
        motion = motion_of(candidate)
        return motion is None or pressing_force(motion) <= limit

    return per_candidate(f"press with more than {limit:g} N", satisfies)


def within_reach(arm: ArmWithPeg, *, seed: int = 0) -> Constraint:
    """The arm's joints can follow plans, and place a camera on the wrist at views' poses.

    Plans are followed at poses at most 20 mm and 10 degrees apart. Cameras that are not on the wrist satisfy
    it. See `bcppl.robot.inverse_kinematics.joint_paths`.
    """
    base_from_world = poses.inverse(torch.as_tensor(arm.world_from_base))

    def satisfied(candidates: Sequence[Candidate]) -> list[bool]:
        reached = np.ones(len(candidates), dtype=bool)
        groups: dict[int, list[int]] = {}
        paths: dict[int, Array] = {}
        for k, candidate in enumerate(candidates):
            motion, placement = motion_of(candidate), placement_of(candidate)
            if motion is not None:
                paths[k] = _followed(motion)
                groups.setdefault(len(paths[k]), []).append(k)
            if placement is not None and placement.wrist_from_sensor is not None:
                wrist = poses.compose(
                    torch.as_tensor(placement.world_from_sensor),
                    poses.inverse(torch.as_tensor(placement.wrist_from_sensor)),
                )
                path = poses.compose(base_from_world, wrist)[None, None].numpy()
                reached[k] = np.isfinite(joint_paths(arm.robot, arm.link, path, seed=seed)).all()
        for which in groups.values():
            stacked = torch.from_numpy(np.stack([paths[k] for k in which]))
            path = poses.compose(base_from_world, stacked).numpy()
            joints = joint_paths(arm.robot, arm.link, path, arm.link_from_peg, seed=seed)
            reached[which] = np.isfinite(joints).all(axis=(1, 2))
        return reached.tolist()

    return Constraint(f"are out of {arm.robot.name}'s reach", satisfied)


def _followed(plan: Plan) -> Array:
    """Poses (M, 7) along a plan's path, without those at which the peg rests."""
    knots = torch.from_numpy(plan.world_from_peg)
    away = poses.local(knots[:-1], knots[1:])
    parts = torch.maximum(away[:, :3].norm(dim=1) / _SHIFT, away[:, 3:].norm(dim=1) / _TURN)
    ends = np.append(0.0, np.cumsum(np.maximum(1.0, np.ceil(parts.numpy()))))
    times = np.interp(np.arange(ends[-1] + 1.0), ends, plan.times)
    path, _ = interpolated_command(probe_of(plan), times)
    moves = np.abs(np.diff(path, axis=0)).max(axis=1) > 1e-9
    return path[np.concatenate([[True], moves])]

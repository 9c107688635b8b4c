"""Properties of a planned motion: where it is expected to make contact, its free path, its pressing force."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp

from bcppl import poses
from bcppl.arrays import Array
from bcppl.robot.plan import Plan

_SPACING, _TURN = 0.002, math.radians(2.0)  # m and radians between poses of a free path


def expected_contacts(plan: Plan) -> list[tuple[Array, Array]]:
    """The peg's pose (7,) amid each guarded stroke, and the stroke's direction (3,) in the world."""
    contacts = []
    for k, manner in enumerate(plan.manners):
        way = plan.world_from_peg[k + 1, :3] - plan.world_from_peg[k, :3]
        length = float(np.linalg.norm(way))
        if manner == "guarded" and length > 0.0:
            middle = plan.world_from_peg[k].copy()
            middle[:3] += 0.5 * way
            contacts.append((middle, way / length))
    return contacts


def pressing_force(plan: Plan) -> float:
    """The largest force (N) with which a plan presses on surfaces, after contact.

    It is the force that stops a guarded motion, plus the spring force of the command's path beyond. Motions
    that are held without contact before them count as if they made contact where the first of them begins.
    Impacts may exceed it.
    """
    largest, direction, stopped_by = 0.0, np.zeros(3), 0.0
    for k, manner in enumerate(plan.manners):
        begin, end = plan.world_from_peg[k, :3], plan.world_from_peg[k + 1, :3]
        length = float(np.linalg.norm(end - begin))
        if manner == "free":
            direction, stopped_by = np.zeros(3), 0.0
        elif manner == "guarded":
            largest, stopped_by = max(largest, plan.force), plan.force
            direction, contact = (end - begin) / max(length, 1e-12), end
        else:
            if not direction.any() and length > 0.0:
                direction, contact = (end - begin) / length, begin
            elif not direction.any():
                continue
            turn = poses.rotation_matrix(torch.from_numpy(plan.world_from_peg[k + 1])).numpy()
            stiffness = float(np.square(turn.T @ direction) @ np.asarray(plan.stiffness)[:3])
            largest = max(largest, stopped_by + stiffness * max(float((end - contact) @ direction), 0.0))
    return largest


def free_path(plan: Plan) -> Array:
    """Poses (M, 7) of the peg, at most 2 mm and 2 degrees apart, on its motions before and after contact.

    These are the free motions, and those that are held before any guarded motion. The return from a contact
    counts from the pose at which the peg is free again: how it leaves the surface depends on the contact.
    """
    path, in_contact = [plan.world_from_peg[:1]], False
    for k, manner in enumerate(plan.manners):
        if manner == "guarded":
            in_contact = True
        elif not in_contact:
            path.append(_interpolate(plan.world_from_peg[k], plan.world_from_peg[k + 1]))
        elif manner == "free":
            path.append(plan.world_from_peg[k + 1 : k + 2])
            in_contact = False
    return np.concatenate(path)


def whole_path(plan: Plan) -> Array:
    """Poses (M, 7) of the commanded peg all along a plan: at the ends of straight motions, amid turns too."""
    knots = plan.world_from_peg
    turns = [k for k in range(len(knots) - 1) if (knots[k, 3:] != knots[k + 1, 3:]).any()]
    return np.concatenate([knots, *(_interpolate(knots[k], knots[k + 1]) for k in turns)])


def _interpolate(start: Array, stop: Array) -> Array:
    """Poses (M, 7) on the straight motion between two."""
    ends = Rotation.from_quat(np.stack([start, stop])[:, [4, 5, 6, 3]])
    turn = float((ends[0].inv() * ends[1]).magnitude())
    steps = max(1, math.ceil(float(np.linalg.norm(stop[:3] - start[:3])) / _SPACING), math.ceil(turn / _TURN))
    share = np.linspace(0.0, 1.0, steps + 1)
    turns = Slerp([0.0, 1.0], ends)(share)
    return np.column_stack(
        [start[:3] + share[:, None] * (stop - start)[:3], turns.as_quat()[:, [3, 0, 1, 2]]]
    )

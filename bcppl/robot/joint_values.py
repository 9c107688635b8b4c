"""Checks of joint angles, joint offsets and fixed joint values against the joint limits.

Degrees in place of radians and millimetres in place of metres are the common mistakes, and their size shows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.robot.description import Joint

FAR = 1.0  # rad beyond a joint limit: no encoder error is as large
WOUND = 4.0 * math.pi  # rad: two revolutions, the largest value of a joint without limits


def check_angles(robot: str, joints: Sequence[Joint], values: Tensor) -> None:
    """Refuse joint angles (..., J) that are not finite, or outside the limits by as much as a wrong unit."""
    _check_finite(robot, joints, values, "angles", "leave such stamps out")
    if values.numel() == 0:
        return
    detached = values.detach().reshape(-1, len(joints))
    low, high = detached.amin(dim=0).tolist(), detached.amax(dim=0).tolist()
    for joint, least, most in zip(joints, low, high, strict=True):
        if _limited(joint) and (least < joint.lower - _margin(joint) or most > joint.upper + _margin(joint)):
            worst = least if joint.lower - least > most - joint.upper else most
            wrong, unit, units = _units(joint)
            raise InputError(
                f"joint {joint.name} of {robot} reads {worst:.4g} {unit} and its limits are "
                f"{joint.lower:.4g} to {joint.upper:.4g}: the angles are probably in {wrong} or in "
                f"another order; give {units} in the order {', '.join(each.name for each in joints)}."
            )


def check_offsets(robot: str, joints: Sequence[Joint], offsets: Tensor) -> None:
    """Refuse offsets (N, ..., J) that are not finite, or with a median above half a revolution or the travel.

    A few particles may be anywhere, and so may all within a leapfrog trajectory, whose offsets carry
    gradients.
    """
    _check_finite(robot, joints, offsets, "offsets", "give 0 for a joint without an error")
    if offsets.requires_grad or offsets.numel() == 0:
        return
    sizes = offsets.abs().reshape(-1, len(joints)).median(dim=0).values.tolist()
    for joint, size in zip(joints, sizes, strict=True):
        if size > (_margin(joint) if joint.kind == "prismatic" else math.pi):
            wrong, unit, units = _units(joint)
            raise InputError(
                f"the offsets of joint {joint.name} of {robot} have a median size of {size:.4g} {unit}: "
                f"they are probably in {wrong}; give {units}."
            )


def held_values(robot: str, moving: Mapping[str, Joint], held: Mapping[str, float]) -> dict[str, float]:
    """The values of fixed joints by name, radians or metres; refused are those far outside the limits."""
    values = {}
    for name, value in held.items():
        if name not in moving:
            raise InputError(f"{robot} has no joint {name!r} to hold; its joints are {', '.join(moving)}.")
        joint = moving[name]
        wrong, unit, units = _units(joint)
        values[name] = number_within(f"joint {name} of {robot} is to be held at {{}} {unit}", value)
        low, high, within = -WOUND, WOUND, ""
        if _limited(joint):
            low, high = joint.lower - _margin(joint), joint.upper + _margin(joint)
            within = f", outside its limits {joint.lower:.4g} to {joint.upper:.4g}"
        if not low <= values[name] <= high:
            raise InputError(
                f"joint {name} of {robot} is to be held at {values[name]:.4g} {unit}{within}: the value is "
                f"probably in {wrong}; give {units}."
            )
    return values


def _check_finite(robot: str, joints: Sequence[Joint], values: Tensor, kind: str, advice: str) -> None:
    finite = torch.isfinite(values.detach()).reshape(-1, len(joints)).all(dim=0)
    if not bool(finite.all()):
        joint = joints[int(torch.nonzero(~finite)[0])]
        raise InputError(
            f"joint {kind} of {robot} hold a number that is not finite, at {joint.name}; {advice}."
        )


def _limited(joint: Joint) -> bool:
    return math.isfinite(joint.upper - joint.lower)


def _margin(joint: Joint) -> float:
    """How far beyond its limits a value may be: of a prismatic joint its travel, where that is known."""
    travel = joint.upper - joint.lower
    if joint.kind != "prismatic":
        return FAR
    return travel if 0.0 < travel < math.inf else WOUND


def _units(joint: Joint) -> tuple[str, str, str]:
    """The probable wrong unit of a value, the symbol of the right one, and its name."""
    return ("millimetres", "m", "metres") if joint.kind == "prismatic" else ("degrees", "rad", "radians")

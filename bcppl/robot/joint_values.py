"""Checks of joint angles, of what their readings lack, and of the values of joints that do not move.

Degrees in place of radians and millimetres in place of metres are what people get wrong, and both show by
their size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.errors import InputError
from bcppl.robot.description import Joint

FAR = 1.0  # rad beyond a limit: no encoder is that wrong, so the angles are something else
WOUND = 4.0 * math.pi  # rad: two turns, and nobody holds a joint without limits beyond them


def refuse_not_finite(robot: str, joints: Sequence[Joint], what: str, values: Tensor) -> None:
    """Refuse joint values (..., J) that hold a number that is not finite.

    Args:
        robot: its name.
        joints: the J joints.
        what: "angles", which come with stamps, or "offsets".
        values: of them.

    Raises:
        InputError: they do; names the joint.
    """
    finite = torch.isfinite(values.detach()).reshape(-1, len(joints)).all(dim=0)
    if not bool(finite.all()):
        joint = joints[int(torch.nonzero(~finite)[0])]
        advice = "leave such stamps out" if what == "angles" else "give 0 where nothing is lacking"
        raise InputError(
            f"joint {what} of {robot} hold a number that is not finite, at {joint.name}; {advice}."
        )


def refuse_far_angles(robot: str, joints: Sequence[Joint], values: Tensor) -> None:
    """Refuse angles (..., J) that lie so far outside the limits that they are no radians (or metres).

    Raises:
        InputError: they do; names the joint.
    """
    detached = values.detach().reshape(-1, len(joints))
    names = ", ".join(joint.name for joint in joints)
    for k, joint in enumerate(joints):
        if len(detached) == 0 or not math.isfinite(joint.upper - joint.lower):
            continue
        low, high = float(detached[:, k].min()), float(detached[:, k].max())
        beyond = FAR if joint.kind != "prismatic" else _travel(joint)
        if low < joint.lower - beyond or high > joint.upper + beyond:
            worst = low if joint.lower - low > high - joint.upper else high
            wrong, unit, units = _units(joint)
            raise InputError(
                f"joint {joint.name} of {robot} reads {worst:.4g} {unit} and its limits are "
                f"{joint.lower:.4g} to {joint.upper:.4g}: the angles are probably in {wrong} or in "
                f"another order; give {units} in the order {names}."
            )


def refuse_far_offsets(robot: str, joints: Sequence[Joint], offsets: Tensor) -> None:
    """Refuse offsets (N, ..., J) most of which are larger than any encoder's: half a turn, a whole travel.

    One particle may be anywhere, and so may all on the way of a leapfrog, whose offsets carry gradients.

    Raises:
        InputError: they are; names the joint.
    """
    if offsets.requires_grad or offsets.numel() == 0:
        return
    usual = offsets.abs().reshape(-1, len(joints)).median(dim=0).values.tolist()
    for joint, size in zip(joints, usual, strict=True):
        if size > (math.pi if joint.kind != "prismatic" else _travel(joint)):
            wrong, unit, units = _units(joint)
            raise InputError(
                f"the offsets of joint {joint.name} of {robot} are of a size of {size:.4g} {unit}: "
                f"they are probably in {wrong}; give {units}."
            )


def held_values(robot: str, moving: Mapping[str, Joint], held: object) -> dict[str, float]:
    """The values of joints that do not move, radians or metres, by name.

    Raises:
        InputError: they are no mapping, a joint is none of the robot's that move, or a value is no finite
            number, or far outside the limits.
    """
    if not isinstance(held, Mapping):
        raise InputError(f"held joints of {robot} are given as {held!r}; give {{name: value}}.")
    found = {}
    for name, value in held.items():
        if name not in moving:
            raise InputError(f"{robot} has no joint {name!r} to hold; its joints are {', '.join(moving)}.")
        joint = moving[name]
        wrong, unit, units = _units(joint)
        number = number_within(f"joint {name} of {robot} is to be held at {{}} {unit}", value)
        limited = math.isfinite(joint.upper - joint.lower)
        beyond = FAR if joint.kind != "prismatic" else _travel(joint)
        low, high = (joint.lower - beyond, joint.upper + beyond) if limited else (-WOUND, WOUND)
        if not low <= number <= high:
            within = f", outside its limits {joint.lower:.4g} to {joint.upper:.4g}" if limited else ""
            raise InputError(
                f"joint {name} of {robot} is to be held at {number:.4g} {unit}{within}: the value is "
                f"probably in {wrong}; give {units}."
            )
        found[name] = number
    return found


def _travel(joint: Joint) -> float:
    """How far a prismatic joint moves, metres; without limits the arm's own size is not known either."""
    travel = joint.upper - joint.lower
    return travel if 0.0 < travel < math.inf else WOUND


def _units(joint: Joint) -> tuple[str, str, str]:
    """What a value is probably in, and what it is read as."""
    return ("millimetres", "m", "metres") if joint.kind == "prismatic" else ("degrees", "rad", "radians")

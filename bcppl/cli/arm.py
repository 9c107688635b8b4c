"""The arm that holds the peg, from the options of a command."""

from __future__ import annotations

from bcppl import poses
from bcppl.arrays import Array
from bcppl.cli.options import NUMBERS
from bcppl.errors import InputError
from bcppl.robot.arm_with_peg import ArmWithPeg

ORIGIN = "0 0 0 1 0 0 0"


def arm_with_peg(
    robot: str | None, link: str | None, link_from_peg: str | None, world_from_base: str | None
) -> ArmWithPeg | None:
    """The arm that --robot names, and how it stands and holds the peg; None without --robot.

    Raises:
        InputError: an option is missing, or is not what its help says.
    """
    if robot is None:
        if (link, link_from_peg, world_from_base) != (None, None, None):
            raise InputError("--link, --link-from-peg, --world-from-base need an arm; give it with --robot.")
        return None
    if link is None:
        raise InputError("--robot is given without --link; name the link of the arm that holds the peg.")
    from bcppl.models.robots import load_robot  # reads URDF files, which takes seconds to import

    arm = load_robot(robot, tip=link)
    if link_from_peg is None:
        raise InputError(
            "--robot is given without --link-from-peg; state how the link holds the peg (panda_hand, whose "
            'z leads along the fingers, at about "0 0 0.1 0 1 0 0").'
        )
    held = _pose("--link-from-peg", link_from_peg)
    return ArmWithPeg(arm, link, held, _pose("--world-from-base", world_from_base or ORIGIN))


def _pose(option: str, words: str) -> Array:
    try:
        numbers = [float(word) for word in words.replace(",", " ").split()]
    except ValueError:
        raise InputError(f"{option} is {words!r}; give seven numbers, {NUMBERS}, in metres.") from None
    return poses.as_pose(numbers, option).numpy()

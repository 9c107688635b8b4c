"""An arm that holds a peg: what reach and a picture of the arm are computed from."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from bcppl.arrays import Array

if TYPE_CHECKING:
    from bcppl.robot.kinematics import Robot  # whose import takes seconds


class ArmWithPeg(NamedTuple):
    """An arm that holds the peg.

    Attributes:
        robot: with a tip, so that its joints are those that move the link.
        link: that holds the peg.
        link_from_peg: (7,) the peg's frame, whose tip is at its lowest z, in the link's: where the link's z
            axis is along the fingers, turned by pi.
        world_from_base: (7,) the robot's base.
    """

    robot: Robot
    link: str
    link_from_peg: Array
    world_from_base: Array

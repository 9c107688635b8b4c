"""Plans of an insertion: a search for the hole, then a push from the pose at which the search ends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.robot.plan import Plan


@dataclass(frozen=True, eq=False)
class InsertionPlan:
    """A search for a hole, and a push into it from the pose at which the search ends.

    The two have their own stiffness: a search is stiff laterally and compliant along the axis; a push leaves
    the peg compliant in rotation. Between them the controller's stiffness is changed and its command set to
    the peg's pose, which unloads the springs.

    Attributes:
        search: ends with its last motion or, earlier, where a "searching" motion detects the hole.
        push: its first pose is the peg's expected pose at the end of the search; see `push_from`.
        world_from_hole: (7,) estimated pose of the hole: its origin in the plane of the part's top, z out of
            the material.
        depth: of the hole, metres.
        chamfer: depth below the top down to which the hole is wider, metres.

    Raises:
        InputError: the search has no searching motion, or the depth is not positive.
    """

    search: Plan
    push: Plan
    world_from_hole: Array
    depth: float
    chamfer: float

    def __post_init__(self) -> None:
        if "searching" not in self.search.manners:
            raise InputError(
                f"the search {self.search.name!r} of an insertion has no searching motion; give at least one."
            )
        if not self.depth > 0.0:
            raise InputError(f"an insertion is planned {self.depth:g} m deep; give a positive depth.")

    @property
    def deep_enough(self) -> float:
        """The least depth (m) of an inserted peg: 0.8 of the hole's, or 10 mm past the chamfer."""
        return min(0.8 * self.depth, self.chamfer + 0.01)

    def push_from(self, world_from_peg: Array, sunk: float | None = None) -> Plan:
        """The push, transformed as a whole to begin at a pose (7,) and shortened to end at the planned depth.

        The peg has rotated with the hole that it is in, so the path is along its own axes.

        Args:
            world_from_peg: the peg's pose.
            sunk: its depth (m) below the top, where contact located it; None for the depth relative to the
                push's first pose.
        """
        start = torch.from_numpy(self.push.world_from_peg[0])
        pose = torch.as_tensor(world_from_peg)
        path = poses.compose(poses.inverse(start), torch.from_numpy(self.push.world_from_peg))
        if sunk is None:
            sunk = -float(poses.transform(poses.inverse(start), pose[None, :3])[0, 2])
        length = float(path[:, 2].abs().max())
        if length > 0.0:
            path[:, :3] *= max(length - sunk, 0.0) / length
        return replace(self.push, world_from_peg=poses.compose(pose, path).numpy())

"""What an arm is asked to do to put a peg into a hole: search until it yields, then push where it stands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.errors import InputError
from bcppl.robot.plan import Plan

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class InsertionPlan:
    """A search for a hole, and a push into it that begins where the search has ended.

    The two have their own stiffness: a search is led firmly across and pressed on softly along the axis; a
    push leaves the peg free to turn with the hole. A controller is told to change between them, as a robot's
    owner would, and the command is set to where the peg then stands, which unloads its springs.

    Attributes:
        search: ends where its last motion does or, before, where a "searching" motion finds the hole.
        push: its first pose is where the peg is thought to stand then; see `push_from`.
        world_from_hole: (7,) where the hole is thought to be: its origin in the plane of the part's top, z
            out of the material.
        depth: of the hole, metres.
        chamfer: how far below the top the hole is wider, metres.

    Raises:
        InputError: the search does not search, the depth is not positive, or the pose is not (7,).
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
        if np.shape(self.world_from_hole) != (7,):
            raise InputError(
                f"an insertion's world_from_hole has shape {np.shape(self.world_from_hole)}; give (7,)."
            )

    @property
    def deep_enough(self) -> float:
        """From how deep below the top (m) the peg is in: 0.8 of the depth, or 10 mm beyond the chamfer."""
        return min(0.8 * self.depth, self.chamfer + 0.01)

    def push_from(self, world_from_peg: Array, sunk: float | None = None) -> Plan:
        """The push, moved as a whole so that it begins at a pose (7,) and ends as deep as planned.

        The peg turns with the hole that it is in, so the way is along its own axes.

        Args:
            world_from_peg: where the peg stands.
            sunk: how far (m) it is then below the top, where that was felt; None to take it from where the
                hole is thought to be.
        """
        start = torch.from_numpy(self.push.world_from_peg[0])
        stands = torch.as_tensor(world_from_peg)
        way = poses.compose(poses.inverse(start), torch.from_numpy(self.push.world_from_peg))
        if sunk is None:
            sunk = -float(poses.transform(poses.inverse(start), stands[None, :3])[0, 2])
        length = float(way[:, 2].abs().max())
        if length > 0.0:
            way[:, :3] *= max(length - sunk, 0.0) / length
        return replace(self.push, world_from_peg=poses.compose(stands, way).numpy())

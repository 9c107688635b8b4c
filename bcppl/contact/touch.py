"""The observation of a touch."""

from __future__ import annotations

from dataclasses import dataclass

from bcppl.arrays import Array, as_array, spanned


@dataclass(frozen=True, eq=False, repr=False)
class Touch:
    """Observation: the raw wrench, and the measured pose of the grasped peg.

    Attributes:
        times: (T,) seconds, increasing.
        wrench: (T, 6) force (N) then torque (N m) of the environment on the peg or finger, in the peg's frame
            about its origin (for a push: in the world's axes, about the tip). Not tared.
        world_from_peg: (T, 7) measured pose of the peg; empty (0, 7) for a push, whose path is in the action.
    """

    times: Array
    wrench: Array
    world_from_peg: Array

    def __post_init__(self) -> None:
        for name in ("times", "wrench", "world_from_peg"):
            object.__setattr__(self, name, as_array(getattr(self, name)))

    def __repr__(self) -> str:
        return f"Touch({spanned(self.times)})"

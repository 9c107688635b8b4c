"""What an arm reads, and what a program asks of any arm."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from bcppl.arrays import Array


class Reading(NamedTuple):
    """What an arm reads at a stamp (s of its clock).

    Attributes:
        wrench: (6,) of the environment on the peg, in the peg's frame about its origin, N and N m.
        posed: (s) the stamp of the pose, that of the wrench where one message has both.
        world_from_peg: (7,).
    """

    stamp: float
    wrench: Array
    posed: float
    world_from_peg: Array


class Arm(Protocol):
    """A connection to an arm that follows a pose by a spring.

    Attributes:
        ahead: s after which a command takes effect.
        settles: s for which it stands still before it takes up another stiffness.
    """

    ahead: float
    settles: float

    def read(self) -> list[Reading]:
        """The readings since the last call, one at least; waits for it.

        Raises:
            TimeoutError: the arm sends none.
        """

    def command(self, world_from_peg: Array, stiffness: Array) -> None:
        """Follow a pose (7,) by a spring of stiffness (6,): N/m along, N m/rad about the peg's axes."""

    def close(self) -> None:
        """End the connection; the arm then holds where it is."""

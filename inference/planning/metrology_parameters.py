"""Parameters of a plan of 3-2-1 touches."""

from __future__ import annotations

import math
from typing import NamedTuple

from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.inference.planning.waypoints import Waypoint


class MetrologyParameters(NamedTuple):
    """Parameters of the plan.

    Attributes:
        first_contact: when it is expected, seconds.
        duration: of the plan, seconds.
        guarded_speed, free_speed, sliding_speed: m/s; exceeded only as far as the plan would otherwise not
            end in time.
        haste: by which factor they may be. A plan that needs more keeps to them, and lasts longer.
        slowest_slide: m/s; where there is time to spare, slides are slower, down to this.
        contact_force: newtons that stop a guarded motion.
        press_depth: metres of the command beyond the point of contact: an impact may have stopped it.
        side_depth: metres below the top at which sides are touched, where the part is high enough.
        lean, turn: radians by which the pressed peg leans away from a side and towards it, and turns about
            its axis both ways, at the end of each slide along a side; 0 leaves it out.
        standard_deviations: half a stroke, in standard deviations of the surface's position along it.
        shortest_half_stroke, longest_half_stroke: limits of that, metres.
    """

    first_contact: float = 3.0
    duration: float = 6.0
    guarded_speed: float = 0.06
    free_speed: float = 0.25
    sliding_speed: float = 0.09
    haste: float = 1.25
    slowest_slide: float = 0.02
    contact_force: float = 4.0
    press_depth: float = 0.003
    side_depth: float = 0.012
    standard_deviations: float = 3.0
    lean: float = 0.0
    turn: float = 0.0
    shortest_half_stroke: float = 0.003
    longest_half_stroke: float = 0.012

    def free(self, position: Array) -> Waypoint:
        """Of a free motion to a position (3,)."""
        return Waypoint(position, "free", self.free_speed)

    def slide(self, position: Array) -> Waypoint:
        """Of a slide to a position (3,)."""
        return Waypoint(position, "held", self.sliding_speed)

    def touch(self, clear: Array, stop: Array, pressed: Array) -> list[Waypoint]:
        """Of a guarded stroke between two positions (3,), and a press to a third."""
        speed = self.guarded_speed
        return [self.free(clear), Waypoint(stop, "guarded", speed), Waypoint(pressed, "held", speed)]


# Where the peg's pose in the hand is uncertain. The time for it is that before the first contact.
ROCKED = MetrologyParameters(first_contact=1.5, lean=math.radians(4.0), turn=math.radians(8.0))


def checked(parameters: MetrologyParameters) -> MetrologyParameters:
    """The parameters; InputError where one is out of range."""
    for name, value in parameters._asdict().items():
        if name in ("lean", "turn"):
            number_within(f"a plan of 3-2-1 touches has {name} {{}} radians", value, least=0.0)
        else:
            number_within(f"a plan of 3-2-1 touches has {name} {{}}", value, above=0.0)
    return parameters

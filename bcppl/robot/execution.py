"""A plan while an arm executes it: what is commanded, and where its motions are stopped.

The rules are those of a robot's program: the wrench is read sample by sample, tared, noise and bias included.
A motion is stopped at the sample after two in a row that exceed its force.

    executor = Executor(plan, limits=Limits())
    while executor.state == "moving":
        wrench, world_from_peg = arm.read()
        executor.sample(wrench[:3], lambda: world_from_peg)
        arm.command(executor.commanded(), plan.stiffness, plan.damping)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.robot.commands import STEP, command_of, continued, interpolated_command, stamps_of
from bcppl.robot.plan import Plan

TARE = 10  # samples
SUSTAINED = 2  # samples in a row: an impact is shorter

State = Literal["moving", "finished", "in hole", "aborted"]


class Limits(NamedTuple):
    """What an arm may not exceed.

    Attributes:
        force: N, over two samples in a row, at which the plan is aborted.
        speed: m/s, of motions that may touch: guarded and searching ones.
        free_speed: m/s, of all others.
    """

    force: float = 60.0
    speed: float = 0.1
    free_speed: float = 0.5


class Executor:
    """A plan while it is executed.

    Args:
        plan: of the arm.
        tare: (3,) N, the sensor's reading without contact; by default the mean of the first ten samples,
            during which no motion is stopped.
        stop_at_hole: whether the execution ends when a search has found its hole.
        limits: of the arm; None for none.

    Attributes:
        probe: the command so far, with the stamps of all samples.
        stops: (s) when each guarded or searching motion was stopped, by its number in the plan.
        contact_pose: (7,) measured when the last guarded motion was stopped; None where none was.
        state: "aborted" where a limit was exceeded, "in hole" where `stop_at_hole` ended it.
        reason: of what was aborted, one sentence.

    Raises:
        InputError: the plan takes less than the eleven samples by which the wrench is tared, is sampled
            faster than the command can be changed, or is faster than a limit.
    """

    def __init__(
        self,
        plan: Plan,
        *,
        tare: Array | None = None,
        stop_at_hole: bool = False,
        limits: Limits | None = None,
    ) -> None:
        stamps = stamps_of(plan)
        if len(stamps) <= TARE or plan.rate * STEP > 1.0 + 1e-9:
            raise InputError(
                f"plan {plan.name!r} has {len(stamps)} samples at {plan.rate:g} Hz; make it longer than "
                f"{TARE} samples, by which the wrench is tared, at {1.0 / STEP:g} Hz or less."
            )
        if limits is not None:
            _refuse_speed(plan, limits)
        self.plan, self.limits, self.stop_at_hole = plan, limits, stop_at_hole
        self.stops: dict[int, float] = {}
        self.probe = command_of(plan, self.stops)
        self.contact_pose: Array | None = None
        self.state: State = "moving"
        self.reason = ""
        self._tare = tare
        self._forces: list[Array] = []  # the first ones and the newest ones, N
        self._held: Array | None = None
        self._motion = np.clip(
            np.searchsorted(plan.times, stamps + 1e-9, side="right") - 1, 0, len(plan.manners) - 1
        )

    @property
    def taken(self) -> int:
        """How many samples were given."""
        return len(self._forces)

    def commanded(self, time: float | None = None) -> Array:
        """The commanded pose (7,) of the peg at a time (s), by default at the next sample.

        Where the plan was aborted, the peg is held where it was then.
        """
        if self._held is not None:
            return self._held
        stamps = self.probe.stamps
        at = float(stamps[min(self.taken, len(stamps) - 1)]) if time is None else time
        pose: Array = interpolated_command(self.probe, np.array([at]))[0][0]
        return pose

    def sample(self, force: Array, world_from_peg: Callable[[], Array]) -> bool:
        """What was measured at the next of the plan's stamps; whether the command has changed by it.

        Args:
            force: (3,) N, as the sensor reads it.
            world_from_peg: gives the measured pose (7,), where it is asked for.
        """
        number, stamps = self.taken, self.probe.stamps
        self._forces.append(np.asarray(force))
        if number + 1 == len(stamps):
            self.state = "finished"
        of = int(self._motion[number])
        if self._exceeds_limit(number):
            self._held = np.asarray(world_from_peg())
            self.state = "aborted"
            self.reason = (
                f"plan {self.plan.name!r} was aborted at {stamps[number]:.2f} s, in a motion that is "
                f"{self.plan.manners[of]}: the force exceeded the limit of {self._limit:g} N."
            )
            return True
        if of in self.stops or self.state == "finished":
            return False
        stopped = self._stops(number, of, world_from_peg)
        if self.state == "in hole":
            self.stops[of] = float(stamps[number])
            return False
        following = int(self._motion[number + 1])
        if not stopped or self.plan.manners[following] != self.plan.manners[of]:  # otherwise it ends now
            return False
        self.stops[following] = float(stamps[number + 1])
        self.probe = continued(self.probe, command_of(self.plan, self.stops), stamps[number + 1])
        return True

    @property
    def _limit(self) -> float:
        return np.inf if self.limits is None else self.limits.force

    def _exceeds_limit(self, number: int) -> bool:
        return np.isfinite(self._limit) and self._pressed(number, self._limit)

    def _pressed(self, number: int, force: float) -> bool:
        """Whether the newest samples exceed a force (N), from the reading without contact."""
        if number < TARE and self._tare is None:
            return False
        rest = np.mean(self._forces[:TARE], axis=0) if self._tare is None else self._tare
        newest = np.array(self._forces[-SUSTAINED:]) - rest
        return len(newest) == SUSTAINED and bool((np.linalg.norm(newest, axis=1) > force).all())

    def _stops(self, number: int, of: int, world_from_peg: Callable[[], Array]) -> bool:
        """Whether a motion is to be stopped, after the sample of a number."""
        plan, stamps = self.plan, self.probe.stamps
        may_guard = number >= TARE or self._tare is not None
        if plan.manners[of] == "guarded" and stamps[number + 1] < plan.times[of + 1] and may_guard:
            stopped = self._pressed(number, plan.force)
            if stopped:
                self.contact_pose = np.array(world_from_peg())
            return stopped
        if plan.manners[of] != "searching" or self._found_before(of):
            return False
        stopped = self._sunk(world_from_peg(), float(stamps[number])) > plan.sink
        if stopped and self.stop_at_hole:
            self.state = "in hole"
        return stopped

    def _sunk(self, world_from_peg: Array, time: float) -> float:
        """How far (m) a peg is below its contact with a surface, along the commanded z; infinite without."""
        if self.contact_pose is None:
            return math.inf
        led = interpolated_command(self.probe, np.array([time]))[0][0]
        along = Rotation.from_quat(led[[4, 5, 6, 3]]).inv()
        return float(along.apply(self.contact_pose[:3] - world_from_peg[:3])[2])

    def _found_before(self, motion: int) -> bool:
        """Whether the search that a motion belongs to has found its hole."""
        while motion >= 0 and self.plan.manners[motion] == "searching":
            if motion in self.stops:
                return True
            motion -= 1
        return False


def _refuse_speed(plan: Plan, limits: Limits) -> None:
    for name, value in limits._asdict().items():
        number_within(f"the arm's limit of {name} is {{}}", value, above=0.0)
    speeds = np.linalg.norm(np.diff(plan.world_from_peg[:, :3], axis=0), axis=1) / np.diff(plan.times)
    for k, (speed, manner) in enumerate(zip(speeds, plan.manners, strict=True)):
        limit = limits.speed if manner in ("guarded", "searching") else limits.free_speed
        if speed > limit * (1.0 + 1e-9):
            raise InputError(
                f"motion {k} of plan {plan.name!r} is {manner} at {1e3 * speed:.0f} mm/s, above the arm's "
                f"limit of {1e3 * limit:.0f}; give it more time, or another limit."
            )

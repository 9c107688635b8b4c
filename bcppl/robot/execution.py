"""A plan while an arm executes it: what is commanded, and where its motions are stopped.

The rules are those of a robot's program: the wrench is read sample by sample, tared, noise and bias included.
A motion is stopped at the sample after two in a row that exceed its force. Until the tare is complete the
first sample stands for it.

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
from bcppl.robot.commands import ROUNDED, STEP, command_of, continued, interpolated_command, stamps_of
from bcppl.robot.plan import Plan

TARE = 10  # samples
SCATTER = 2.0  # N, root mean square: samples that vary by more are no tare
SUSTAINED = 2  # samples in a row: an impact is shorter
ROUNDING = 1e-4  # relative: of speeds, by times that count from 1970

State = Literal["moving", "finished", "in hole", "no contact", "aborted"]


class Limits(NamedTuple):
    """What an arm may not exceed.

    Attributes:
        force: N, over two samples in a row, at which the plan is aborted.
        speed: m/s, of motions that may touch: all but free ones.
        free_speed: m/s, of free ones.
        turning: rad/s, of all.
    """

    force: float = 60.0
    speed: float = 0.1
    free_speed: float = 0.5
    turning: float = 3.0


class Executor:
    """A plan while it is executed.

    Args:
        plan: of the arm.
        tare: (3,) N, the sensor's reading without contact; by default the mean of the first ten samples. A
            plan that does not begin with a free motion, such as the push of an insertion, needs that of the
            plan before it.
        stop_at_hole: whether the execution ends when a search has found its hole.
        limits: of the arm; None for none.

    Attributes:
        probe: the command so far, with the stamps of all samples.
        stops: (s) when each guarded or searching motion was stopped, by its number in the plan.
        contact_pose: (7,) measured when the last guarded motion was stopped, or else when what follows met a
            surface; None where nothing was met.
        tare: (3,) N; None before it is complete.
        state: "aborted" where a limit was exceeded, or would be because a motion was stopped early and the
            next one has farther to go, or the tare is none; "in hole" where `stop_at_hole` ended
            it, which takes a contact before or, deep in a hole, with its walls; "no contact" where with
            `stop_at_hole` nothing was felt to the end: the part is elsewhere, or the sensor is dead.
        reason: of "aborted" and "no contact", one sentence.

    Raises:
        InputError: the plan takes less than the eleven samples by which the wrench is tared, does not begin
            with a free motion and has no tare, is sampled faster than the command can be changed, or is
            faster than a limit; or the tare is no force.
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
        if tare is None and plan.manners[0] != "free":
            raise InputError(
                f"plan {plan.name!r} begins with a motion that is {plan.manners[0]}, which allows no tare; "
                "give the reading without contact as `tare`, or begin with a free motion."
            )
        if limits is not None:
            _refuse_speed(plan, limits)
        self.plan, self.limits, self.stop_at_hole = plan, limits, stop_at_hole
        self.stops: dict[int, float] = {}
        self.probe = command_of(plan, self.stops)
        self.contact_pose: Array | None = None
        self.state: State = "moving"
        self.reason = ""
        self.tare: Array | None = None if tare is None else _force("the tare", tare)
        if self.tare is not None and not np.isfinite(self.tare).all():
            raise InputError("the tare is not finite; give what the sensor reads without contact, in N.")
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

        Where the state is not "moving" any more, nothing changes.

        Args:
            force: (3,) N, as the sensor reads it.
            world_from_peg: gives the measured pose (7,), where it is asked for.

        Raises:
            InputError: the force has another shape.
        """
        if self.state != "moving":
            return False
        number, stamps = self.taken, self.probe.stamps
        self._forces.append(_force("a sample", force))
        of = int(self._motion[number])
        if violation := self._violation():
            self._abort(number, of, violation, world_from_peg)
            return True
        if number + 1 == len(stamps):
            self._finish()
        if of in self.stops or self.state != "moving":
            return False
        stopped = self._stops(number, of, world_from_peg)
        if stopped and self.stop_at_hole and self.plan.manners[of] == "searching":
            self.state = "in hole"
            self.stops[of] = float(stamps[number])
            return False
        following = int(self._motion[number + 1])
        if not stopped or self.plan.manners[following] != self.plan.manners[of]:  # otherwise it ends now
            return False
        self.stops[following] = float(stamps[number + 1])
        self.probe = continued(self.probe, command_of(self.plan, self.stops), stamps[number + 1])
        if too_fast := self._too_fast(float(stamps[number + 1])):
            self._abort(number, of, too_fast, world_from_peg)
        return True

    def _violation(self) -> str:
        """What the newest sample violates, a limit or a condition of the tare; empty where nothing."""
        limit = math.inf if self.limits is None else self.limits.force
        if not np.isfinite(self._forces[-1]).all():
            return "the sensor read a force that is no number; see its cable and its driver."
        if self._pressed(limit):
            return f"the force exceeded the limit of {limit:g} N."
        if self.tare is not None or self.taken < TARE:
            return ""
        rest = np.mean(self._forces, axis=0)
        scatter = float(np.sqrt(np.square(self._forces - rest).sum(axis=1).mean()))
        if scatter > SCATTER:
            return f"the wrench varied by {scatter:.1f} N while it was tared; begin at rest, without contact."
        if (read := float(np.linalg.norm(rest))) > limit:
            return f"it was tared at {read:.0f} N, above {limit:g} N; give a `tare` without contact."
        self.tare = rest
        return ""

    def _abort(self, number: int, of: int, why: str, world_from_peg: Callable[[], Array]) -> None:
        self._held = np.asarray(world_from_peg())
        self.state = "aborted"
        self.reason = (
            f"plan {self.plan.name!r} was aborted at {self.probe.stamps[number]:.2f} s, in a motion that is "
            f"{self.plan.manners[of]}: {why}"
        )

    def _too_fast(self, after: float) -> str:
        """Which limit the command would exceed after a time (s), for a motion was stopped; empty for none."""
        if self.limits is None:
            return ""
        later = self.probe.command_times >= after - 1e-9
        times, path = self.probe.command_times[later], self.probe.command[later]
        # By their middles: a clock that counts from 1970 resolves no nanosecond. The last may end later.
        amid = np.searchsorted(self.plan.times, 0.5 * (times[1:] + times[:-1]), side="right") - 1
        manners = np.array([float(manner == "free") for manner in self.plan.manners])
        free = manners[np.minimum(amid, len(manners) - 1)]
        # Corners are rounded: the end of a free motion is led at the beginning of the next.
        free = np.convolve(free, np.ones(ROUNDED + 1))[: len(free)]
        limit = np.where(free > 0.0, self.limits.free_speed, self.limits.speed)
        speed, turning = _speeds(times, path)
        remedy = "go back to where the stroke began, or take more time."
        if (speed > limit * (1.0 + ROUNDING)).any():
            worst = int((speed / limit).argmax())
            return (
                f"it was stopped early, and what follows would be led at {1e3 * speed[worst]:.0f} mm/s, over "
                f"the limit of {1e3 * limit[worst]:.0f}; {remedy}"
            )
        if (turning > self.limits.turning * (1.0 + ROUNDING)).any():
            return (
                f"it was stopped early, and what follows would turn the peg by {turning.max():.2g} rad/s, "
                f"over the limit of {self.limits.turning:g}; {remedy}"
            )
        return ""

    def _finish(self) -> None:
        self.state = "finished"
        if self.stop_at_hole and self.contact_pose is None:
            self.state = "no contact"
            self.reason = (
                f"plan {self.plan.name!r} felt no contact; see that the part is where it is believed to be, "
                "and that the sensor reads forces."
            )

    def _pressed(self, force: float) -> bool:
        """Whether the newest samples exceed a force (N), from the reading without contact."""
        newest = np.array(self._forces[-SUSTAINED:]) - (self._forces[0] if self.tare is None else self.tare)
        return len(newest) == SUSTAINED and bool((np.linalg.norm(newest, axis=1) > force).all())

    def _stops(self, number: int, of: int, world_from_peg: Callable[[], Array]) -> bool:
        """Whether a motion is to be stopped, after the sample of a number."""
        plan, stamps = self.plan, self.probe.stamps
        manner, pressed = plan.manners[of], self._pressed(plan.force)
        guarded = manner == "guarded" and bool(stamps[number + 1] < plan.times[of + 1])
        if guarded and pressed:
            self.contact_pose = np.array(world_from_peg())
        landed = any(plan.manners[k] == "guarded" for k in self.stops)
        searching = manner == "searching" and not self._found_before(of)
        held_up = False
        if pressed and not landed and (manner == "held" or searching):
            # It met nothing on its way down. What holds it up now is a lower surface, or the hole's bottom.
            held_up = self._held_up(world_from_peg(), number)
            if held_up and self.contact_pose is None:
                self.contact_pose = np.array(world_from_peg())
        if not searching:
            return guarded and pressed
        # What holds it from the side is the walls of the hole.
        if pressed and not landed and not held_up:
            return True
        return self.contact_pose is not None and self._sunk(world_from_peg(), number) > plan.sink

    def _sunk(self, world_from_peg: Array, number: int) -> float:
        """How far (m) a peg is below its contact with a surface, along the commanded z, at a sample."""
        assert self.contact_pose is not None
        _, along = self._led(number)
        return float(along.apply(self.contact_pose[:3] - world_from_peg[:3])[2])

    def _held_up(self, world_from_peg: Array, number: int) -> bool:
        """Whether the spring presses a peg along the commanded z rather than across it: no wall does so."""
        led, along = self._led(number)
        spring = along.apply(world_from_peg[:3] - led[:3]) * np.asarray(self.plan.stiffness)[:3]
        return bool(spring[2] > np.linalg.norm(spring[:2]))

    def _led(self, number: int) -> tuple[Array, Rotation]:
        """The commanded pose (7,) at a sample, and the rotation from the world into its axes."""
        led = interpolated_command(self.probe, self.probe.stamps[number : number + 1])[0][0]
        return led, Rotation.from_quat(led[[4, 5, 6, 3]]).inv()

    def _found_before(self, motion: int) -> bool:
        """Whether the search that a motion belongs to has found its hole."""
        while motion >= 0 and self.plan.manners[motion] == "searching":
            if motion in self.stops:
                return True
            motion -= 1
        return False


def _force(what: str, given: Array) -> Array:
    force = np.asarray(given, dtype=np.float64)
    if force.shape != (3,):
        raise InputError(f"{what} of an executor has shape {force.shape}; give the force alone, (3,) in N.")
    return force


def _speeds(times: Array, path: Array) -> tuple[Array, Array]:
    """m/s and rad/s (K - 1,) between poses (K, 7) at times (K,)."""
    spans, turns = np.diff(times), Rotation.from_quat(path[:, [4, 5, 6, 3]])
    speed = np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1) / spans
    return speed, (turns[:-1].inv() * turns[1:]).magnitude() / spans


def _refuse_speed(plan: Plan, limits: Limits) -> None:
    for name, value in limits._asdict().items():
        number_within(f"the arm's limit of {name} is {{}}", value, above=0.0)
    speeds, turning = _speeds(plan.times, plan.world_from_peg)
    if (fast := turning > limits.turning * (1.0 + ROUNDING)).any():
        k = int(fast.argmax())
        raise InputError(
            f"motion {k} of plan {plan.name!r} turns the peg by {turning[k]:.2g} rad/s, over the arm's limit "
            f"of {limits.turning:g}; give it more time, or another limit."
        )
    for k, (speed, manner) in enumerate(zip(speeds, plan.manners, strict=True)):
        limit = limits.free_speed if manner == "free" else limits.speed
        if speed > limit * (1.0 + ROUNDING):
            raise InputError(
                f"motion {k} of plan {plan.name!r} is {manner} at {1e3 * speed:.0f} mm/s, above the arm's "
                f"limit of {1e3 * limit:.0f}; give it more time, or another limit."
            )

"""What is really the case on a bench whose robot is wrong: where its peg is, and where the part.

There are three poses. The encoders' is where the robot takes a nominally grasped peg to be: the
forward kinematics of the nominal arm at the true arm's joints. The grip's is where that frame truly is, with
the arm's wrong links and what arm and gripper yield to the wrench. The peg's is where the peg truly is: in
the grip by the grasp, and by how far it has slipped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.geometry.parts import Part
from bcppl.models.worlds.bench.errors import BenchErrors, DrawnErrors, drawn_errors
from bcppl.models.worlds.bench.six_joint_arm import (
    NOMINAL,
    SixJointArm,
    chain_compliance,
    displaced,
    matrices,
    nominal_arm,
    pose_of,
)
from bcppl.robot.motion import Probe
from bcppl.robot.plan import Plan

FELT = 3.0  # N: a slip or a slide begins at a sample with a force above it
LASTS = 0.05  # s that it takes
_SIDEWAYS = 0.5  # of the random direction beside the force's, of a slip
_PUSHED = 0.5  # share of a force that is horizontal, above which the part slides
_FRICTION_RADIUS = 0.03  # m: a part turns by its push's moment over the force and the square of this
_CABLE = np.array([0.0, 0.0, 0.05])  # m, in the grip's axes: where the cable pulls that shifts the zero
_PULLED_OVER = 0.05  # m over which its pull changes


@dataclass(frozen=True, eq=False)
class Slide:
    """A motion of the part on the table.

    Attributes:
        shift: (2,) m along the world's x and y.
        turn: rad about the vertical through the centre.
        centre: (3,) m.
    """

    shift: Array
    turn: float
    centre: Array

    def applied(self, world_from_part: Array, share: float = 1.0) -> Array:
        """The pose (7,) after a share of the motion; a share of -1 undoes it."""
        half = 0.5 * share * self.turn
        turn = torch.tensor([0.0, 0.0, 0.0, math.cos(half), 0.0, 0.0, math.sin(half)], dtype=torch.float64)
        moved = np.asarray(world_from_part, dtype=np.float64).copy()
        shift = share * np.array([*self.shift, 0.0])
        # Undone in reverse: about the centre that has moved with the part.
        centre = self.centre - shift if share < 0.0 else self.centre
        moved[:3] -= centre
        moved = poses.compose(turn, torch.from_numpy(moved)).numpy().copy()
        moved[:3] += centre + shift
        return moved


class BenchReality:
    """The truth of one use of a bench: constant errors, and what has slipped so far.

    Attributes:
        drawn: the constant errors.
        world_from_part: (7,) the part's pose before any slide.
        slip: (3,) m in the grip's axes; None before the peg slips. `slip_time` is when (s).
        slide: of the part; None before. `slide_time` is when (s).
    """

    def __init__(self, drawn: DrawnErrors, world_from_part: Array) -> None:
        self.drawn = drawn
        self.world_from_part = np.asarray(world_from_part, dtype=np.float64)
        self.slip: Array | None = None
        self.slide: Slide | None = None
        self.slip_time = self.slide_time = math.inf
        self._slip_from = self._slide_from = math.inf  # s, beginning of the touches at which they happen
        self._arm = SixJointArm(NOMINAL + drawn.arm)

    @classmethod
    def right(cls, world_from_part: Array) -> BenchReality:
        """A bench without these errors."""
        return cls(drawn_errors(0, BenchErrors()), world_from_part)

    def settled(self) -> BenchReality:
        """The same bench after all that slips has slipped, on which nothing slips any more."""
        after = BenchReality(replace(self.drawn, slip=0.0, slide=0.0), self.part_at())
        after.slip, after.slip_time = self.slip, -math.inf
        return after

    # ---- slips

    def begin(self, plan: Plan) -> None:
        """Chooses the touches of a plan at which peg and part slip, if they have not yet."""
        starts = [t for t, manner in zip(plan.times[:-1], plan.manners, strict=True) if manner == "guarded"]
        if starts and self.slip is None and self.drawn.slip > 0.0:
            self._slip_from = float(starts[int(self.drawn.slip_at * len(starts))])
        if starts and self.slide is None and self.drawn.slide > 0.0:
            self._slide_from = float(starts[int(self.drawn.slide_at * len(starts))])

    def touched(self, time: float, world_from_grip: Array, wrench: Array, centre: Array) -> None:
        """Begins a slip or a slide where a wrench (6,) at a sample is a touch's.

        Args:
            time: of the sample, s.
            world_from_grip: (7,).
            wrench: of the environment on the peg, in the grip's frame.
            centre: (3,) of the part, in its frame, m.
        """
        size = float(np.linalg.norm(wrench[:3]))
        if size < FELT:
            return
        if self.slip is None and time >= self._slip_from:
            side = self.drawn.slip_side / np.linalg.norm(self.drawn.slip_side)
            along = wrench[:3] / size + _SIDEWAYS * side
            self.slip = self.drawn.slip * along / np.linalg.norm(along)
            self.slip_time = time
        if self.slide is None and time >= self._slide_from:
            self.slide = self._pushed(world_from_grip, wrench, centre)
            self.slide_time = time if self.slide is not None else math.inf

    def _pushed(self, world_from_grip: Array, wrench: Array, centre: Array) -> Slide | None:
        """How a part slides that is pushed: along the force, turning with its moment (limit surface)."""
        grip = matrices(world_from_grip)
        middle = poses.transform(torch.from_numpy(self.world_from_part), torch.from_numpy(centre)[None])
        about = middle[0].numpy()
        force, torque = -grip[:3, :3] @ wrench[:3], -grip[:3, :3] @ wrench[3:]
        push = float(np.linalg.norm(force[:2]))
        if push < _PUSHED * float(np.linalg.norm(force)):
            return None
        moment = float((torque + np.cross(grip[:3, 3] - about, force))[2])
        turn = self.drawn.slide * moment / (push * _FRICTION_RADIUS**2)
        return Slide(self.drawn.slide * force[:2] / push, turn, about)

    def part_at(self, time: float = math.inf) -> Array:
        """The part's pose (7,) at a time (s); by default after all."""
        if self.slide is None or time <= self.slide_time:
            return self.world_from_part
        return self.slide.applied(self.world_from_part, min(1.0, (time - self.slide_time) / LASTS))

    def grip_from_peg(self, time: float = math.inf) -> Array | None:
        """The peg's pose (7,) in the grip at a time (s), by default after all; None for the nominal one."""
        slipped = self.slip is not None and time > self.slip_time
        if not (slipped or self.drawn.grasp.any()):
            return None
        held = poses.retract(poses.identity(), torch.from_numpy(self.drawn.grasp)).numpy().copy()
        if slipped and self.slip is not None:
            held[:3] += self.slip * min(1.0, (time - self.slip_time) / LASTS)
        return held

    # ---- the arm

    def driven(self, probe: Probe) -> Probe:
        """The command as the true arm carries it out: its encoders are driven to the commanded poses.

        The spring of the chain is in series with the controller's along and about the command's axes; what
        it couples of them is left out of the motion, a twentieth of the deflection, but not of the encoders.
        """
        if self.drawn.arm_is_right:
            return probe
        command = self.grips(probe.command)
        stiffness, damping = np.asarray(probe.stiffness), np.asarray(probe.damping)
        if not self.drawn.arm_is_stiff:
            joints = nominal_arm().inverse(matrices(probe.command[:1]))
            share = 1.0 / (1.0 + np.diag(self._compliance(joints)[0]) * stiffness)
            stiffness, damping = stiffness * share, damping * share**2
        return replace(probe, command=command, stiffness=stiffness, damping=damping)

    def grips(self, encoders: Array, wrench: Array | None = None) -> Array:
        """True poses `world_from_grip` (T, 7), where encoders state poses (T, 7).

        Under the environment's wrench (T, 6) in the grip's frame, or under none: it pushes the grip away.
        """
        if self.drawn.arm_is_right:
            return encoders
        joints = nominal_arm().inverse(matrices(encoders))
        grip = self._arm.forward(joints)
        if wrench is not None and not self.drawn.arm_is_stiff:
            grip = displaced(grip, np.einsum("tij,tj->ti", self._compliance(joints), wrench))
        return pose_of(grip)

    def encoders(self, world_from_grip: Array, wrench: Array) -> Array:
        """What encoders state (T, 7) for true poses (T, 7) of the grip under wrenches (T, 6)."""
        if self.drawn.arm_is_right:
            return world_from_grip
        grip = matrices(world_from_grip)
        joints = self._arm.inverse(grip)
        if not self.drawn.arm_is_stiff:
            for _ in range(2):  # the compliance is that of the joints: a second time is exact to 1 nm
                twist = np.einsum("tij,tj->ti", self._compliance(joints), wrench)
                joints = self._arm.inverse(_before(grip, twist))
        return pose_of(nominal_arm().forward(joints))

    def _compliance(self, joints: Array) -> Array:
        jacobian, _ = self._arm.jacobian(joints)
        return chain_compliance(jacobian, self.drawn.joints, self.drawn.gripper)

    # ---- the wrench sensor

    def felt(self, wrench: Array, world_from_grip: Array, rate: float, earlier: Array | None = None) -> Array:
        """What the sensor reads (T, 6) of true wrenches (T, 6), without bias and noise.

        Args:
            wrench: in the grip's frame, N and N m.
            world_from_grip: (T, 7).
            rate: samples per second.
            earlier: (S, 6) the wrenches of the samples just before.
        """
        drawn, read = self.drawn, wrench
        if drawn.delay > 0.0:
            before = wrench[:0] if earlier is None else earlier
            whole = np.concatenate([before, wrench])
            index = np.arange(len(before), len(whole)) - drawn.delay * rate
            read = np.stack([np.interp(index, np.arange(len(whole)), column) for column in whole.T], axis=1)
        if drawn.gain != 1.0:
            read = drawn.gain * read
        if drawn.zero.any():
            grip = matrices(world_from_grip)
            away = (grip[:, :3, 3] - np.array([0.5, 0.0, 0.23])) @ drawn.zero_along
            pull = np.tanh(away / _PULLED_OVER)[:, None] * np.einsum("tji,j->ti", grip[:, :3, :3], drawn.zero)
            read = read + np.concatenate([pull, np.cross(_CABLE, pull)], axis=1)
        return read

    # ---- what is right relative to the peg

    def peg_at(self, encoders: Array, wrench: Array | None = None, time: float = math.inf) -> Array:
        """True poses `world_from_peg` (T, 7), where encoders state poses (T, 7)."""
        return self.pegs(self.grips(encoders, wrench), self.grip_from_peg(time))

    def pegs(self, world_from_grip: Array, grip_from_peg: Array | None) -> Array:
        """True poses of a peg (T, 7) in grips (T, 7)."""
        if grip_from_peg is None:
            return world_from_grip
        held = poses.compose(torch.from_numpy(world_from_grip), torch.from_numpy(grip_from_peg))
        return np.asarray(held.numpy())

    def apparent(self, world_from_peg: Array) -> Array:
        """See `BenchScene.apparent`."""
        measured = np.asarray(world_from_peg, dtype=np.float64)
        peg_from_part = poses.compose(
            poses.inverse(torch.from_numpy(self.peg_at(measured[None])[0])), torch.from_numpy(self.part_at())
        )
        return np.asarray(poses.compose(torch.from_numpy(measured), peg_from_part).numpy())


def held(peg: Part, grip_from_peg: Array | None) -> Part:
    """The peg as it is in the grip, in the grip's frame."""
    return peg if grip_from_peg is None else peg.moved(grip_from_peg)


def _before(grip: Array, twist: Array) -> Array:
    """The inverse of `displaced`: the transformations (T, 4, 4) that twists (T, 6) move to others."""
    start = displaced(grip, np.concatenate([np.zeros((len(twist), 3)), -twist[:, 3:]], axis=1))
    start[:, :3, 3] -= np.einsum("tij,tj->ti", start[:, :3, :3], twist[:, :3])
    return start

"""Uniform priors over poses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.devices import numbers, on_device_of
from bcppl.distributions.parameters import Range
from bcppl.distributions.poses.base import HELD, PoseDistribution, is_unit
from bcppl.errors import InputError
from bcppl.geometry.parts import FARTHEST
from bcppl.poses import Freedom, quaternions

ANGLE = Range(least=0.0, most=math.pi)
SHARE = Range(least=0.0, below=1.0)
# A guess is a belief, not a fact. So much of each coordinate's mass lies in its tails, which reach
# `FARTHEST` half widths from the centre: measurements that are worth 6 nats more outside move the belief
# there.
TAIL = 0.01


class BoxPose(PoseDistribution):
    """Uniform in a box, times Haar measure restricted to a set of rotations of a normalised `measure`.

    With a `tail`, that share of each coordinate's mass is spread evenly from there to `FARTHEST` half widths,
    and the box is so much narrower that the density within remains that of the uniform.
    """

    def __init__(self, center: Any, translation: Any, rotation: str, measure: float, tail: float) -> None:
        self.tail = SHARE.checked(f"{type(self).__name__} has a tail of mass {{}}", tail)
        what = f"{type(self).__name__} has a half width of {{}} m"
        each = np.broadcast_to(np.asarray(translation, dtype=object), 3)
        widths = [number_within(what, width, least=0.0) for width in each]
        self.widths = torch.tensor(widths, dtype=torch.float64)
        free = "".join(axis for axis, width in zip("xyz", self.widths.tolist(), strict=True) if width > 0)
        super().__init__(poses.as_pose(center, "the centre of a pose prior"), Freedom(free, rotation))
        volume = torch.log(2.0 * self.widths[self.widths > 0])
        self.log_density = -math.log(measure) - float(volume.sum())

    @property
    def steps(self) -> tuple[Tensor, Tensor]:
        """The intervals of each coordinate from the centre over which the density is constant.

        Returns:
            Their limits (K + 1, 3), ascending, metres, and the log of the density there (K,), relative to
            that at the centre.
        """
        if not self.tail:
            return torch.stack([-self.widths, self.widths]), self.widths.new_zeros(1)
        reach = self.widths.new_tensor([-FARTHEST, self.tail - 1.0, 1.0 - self.tail, FARTHEST])
        lower = math.log(self.tail / (FARTHEST - 1.0 + self.tail))
        return reach[:, None] * self.widths, self.widths.new_tensor([lower, 0.0, lower])

    def _translations(self, uniform: Tensor) -> Tensor:
        """The displacements (..., 3) at quantiles (..., 3)."""
        share = 2.0 * uniform - 1.0
        if self.tail:
            beyond = (share.abs() - 1.0 + self.tail) / self.tail
            far = 1.0 - self.tail + beyond * (FARTHEST - 1.0 + self.tail)
            share = torch.where(beyond > 0.0, far.copysign(share), share)
        return self.widths * share

    def _log_density_at(self, shift: Tensor) -> Tensor:
        """The log-density (...,) at displacements (..., 3) from the centre, for a rotation within its set."""
        limits, log_steps = self.steps
        inside = (shift.abs() <= limits[-1] + HELD).all(dim=-1)
        density = shift.new_tensor(self.log_density)
        if self.tail:
            is_far = (shift.abs() > limits[-2] + HELD) & (self.widths > 0.0)
            density = density + log_steps[0] * is_far.sum(dim=-1)
        return torch.where(inside, density, -torch.inf)

    def _moved(self, shape: torch.Size, rotation: Tensor, translation: Tensor) -> Tensor:
        """The centre moved by translations (*shape, 3) and quaternions x y z w (*shape, 4)."""
        center = self.center.expand(*shape, 7)
        quaternion = quaternions.product(poses.quaternion_xyzw(center).contiguous(), rotation)
        quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
        return poses.from_translation_quaternion_xyzw(center[..., :3] + translation, quaternion)


class UniformPose(BoxPose):
    """Uniform in a box times uniform (Haar) within an angle of a given orientation.

    Args:
        center: (7,) the pose in the middle.
        translation: half widths (3,) or one for all, metres, along the axes of the frame the pose maps to;
            0 holds an axis fixed.
        angle: the largest rotation angle away from the centre, radians, at most pi; 0 holds the orientation.
        rotation: "all", or one axis "x", "y", "z" of the frame the pose maps from.
        tail: the share of the mass of each translation that lies in tails up to three half widths away.

    The Haar measure of a ball of rotation angle a is (a - sin a) / pi.
    """

    def __init__(
        self, center: Any, translation: Any, angle: float, rotation: str = "all", *, tail: float = 0.0
    ) -> None:
        self.angle = ANGLE.checked("UniformPose has angle = {} rad", angle)
        if self.angle == 0.0:
            rotation = "none"
        ball = float(_beyond_sine(np.array(self.angle))) / math.pi
        measure = {"none": 1.0, "all": ball}.get(rotation, self.angle / math.pi)
        super().__init__(center, translation, rotation, measure, tail)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (*sample_shape, *batch_shape, 7)."""
        shape = torch.Size(sample_shape) + self.batch_shape
        translation = self._translations(torch.rand(*shape, 3, dtype=torch.float64))
        if self.freedom.rotation == "all":
            direction = torch.randn(*shape, 3, dtype=torch.float64)
            direction = direction / direction.norm(dim=-1, keepdim=True)
            rotation = quaternions.from_rotation_vector(direction * _haar_angle(shape, self.angle)[..., None])
        else:
            turn = torch.zeros(*shape, 6, dtype=torch.float64)
            if self.freedom.rotation != "none":
                axis = self.freedom.axes[-1]
                turn[..., axis] = self.angle * (2.0 * torch.rand(*shape, dtype=torch.float64) - 1.0)
            rotation = quaternions.from_rotation_vector(turn[..., 3:])
        return self._moved(shape, rotation, translation)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (...,) with respect to the base measure; -inf outside the support."""
        tangent = poses.local(self.center, value)
        inside = tangent[..., 3:].norm(dim=-1) <= self.angle + HELD
        inside &= (self.freedom.off_axis(tangent) <= HELD) & is_unit(value)
        return torch.where(inside, self._log_density_at(tangent[..., :3]), -torch.inf)


def _haar_angle(shape: torch.Size, largest: float) -> Tensor:
    """Rotation angles of Haar-distributed rotations within `largest`: density proportional to 1 - cos a."""
    # Inverse of the distribution function a - sin a by a fine table: exact to 1e-9 of the range.
    table = np.linspace(0.0, largest, 20001)
    uniform = torch.rand(*shape, dtype=torch.float64)
    cumulative = _beyond_sine(table)
    angle = np.asarray(np.interp(numbers(uniform) * cumulative[-1], cumulative, table))
    return on_device_of(angle, uniform)


def _beyond_sine(angle: Array) -> Array:
    """By how much angles (...,) exceed their sines, radians: by a series where the difference is rounding."""
    series = angle**3 / 6.0 * (1.0 - angle**2 / 20.0 * (1.0 - angle**2 / 42.0))
    return np.where(angle < 0.01, series, angle - np.sin(angle))


class SwingTwistPose(BoxPose):
    """Uniform in a box times uniform (Haar) over rotations with limited tilt and limited yaw.

    A rotation away from the centre is split into a swing of the part's z axis and a twist about it,
    R = R_center Swing Twist. Tilt is the angle between the z axis and that of the centre, yaw the twist.
    Haar measure is the uniform measure of the z axis on the sphere times that of the twist on the circle,
    so the set has measure (1 - cos tilt) / 2 * yaw / pi.

    Args:
        center: (7,) the pose in the middle.
        translation: half widths (3,) or one for all, metres; 0 holds an axis fixed.
        tilt: the largest tilt, radians; 0 leaves a turn about the part's z axis alone.
        yaw: the largest twist to either side, radians.
        tail: the share of the mass of each translation that lies in tails up to three half widths away.

    Raises:
        InputError: a limit is out of range, or tilt is free while yaw is held (no Haar measure).
    """

    def __init__(self, center: Any, translation: Any, tilt: float, yaw: float, *, tail: float = 0.0) -> None:
        self.tilt = ANGLE.checked("SwingTwistPose has tilt = {} rad", tilt)
        self.yaw = ANGLE.checked("SwingTwistPose has yaw = {} rad", yaw)
        if self.tilt > 0 and self.yaw == 0:
            raise InputError(
                "SwingTwistPose has free tilt and held yaw, which have no Haar measure; "
                "give yaw a small positive limit."
            )
        rotation = "all" if self.tilt > 0 else "z" if self.yaw > 0 else "none"
        # Half of 1 - cos a, which is rounding for a small tilt.
        swing = math.sin(0.5 * self.tilt) ** 2 if self.tilt > 0 else 1.0
        twist = self.yaw / math.pi if self.yaw else 1.0
        super().__init__(center, translation, rotation, swing * twist, tail)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (*sample_shape, *batch_shape, 7)."""
        shape = torch.Size(sample_shape) + self.batch_shape
        uniform = torch.rand(*shape, 6, dtype=torch.float64)
        translation = self._translations(uniform[..., :3])
        cosine = 1.0 - uniform[..., 3] * (1.0 - math.cos(self.tilt))
        heading = 2.0 * math.pi * uniform[..., 4]
        swing = torch.acos(cosine)[..., None] * torch.stack(
            [torch.cos(heading), torch.sin(heading), torch.zeros_like(heading)], dim=-1
        )
        twist = torch.zeros(*shape, 3, dtype=torch.float64)
        twist[..., 2] = self.yaw * (2.0 * uniform[..., 5] - 1.0)
        rotation = quaternions.product(
            quaternions.from_rotation_vector(swing), quaternions.from_rotation_vector(twist)
        )
        return self._moved(shape, rotation, translation)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (...,) with respect to the base measure; -inf outside the support."""
        tilt, yaw = tilt_and_yaw(self.center, value)
        shift = value[..., :3] - self.center[..., :3]
        # The angle of a vanishing tilt is the square root of rounding in the quaternion.
        inside = (tilt <= self.tilt + 1e-7) & (yaw.abs() <= self.yaw + HELD) & is_unit(value)
        return torch.where(inside, self._log_density_at(shift), -torch.inf)


def tilt_and_yaw(center: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Tilt of the z axis (0 to pi) and twist about it (-pi to pi) from `center` to `pose`, (...,) radians."""
    first, second = torch.broadcast_tensors(
        quaternions.conjugate(poses.quaternion_xyzw(center)), poses.quaternion_xyzw(pose)
    )
    x, y, z, w = quaternions.product(first, second).unbind(dim=-1)
    tilt = 2.0 * torch.atan2(torch.hypot(x, y), torch.hypot(z, w))
    return tilt, quaternions.wrapped_angle(2.0 * torch.atan2(z, w))


def prior_from_guess(guess: Any) -> UniformPose | SwingTwistPose:
    """The prior of a recording's guess, with tails: uniform within an angle, or within a tilt and a yaw."""
    if guess.angle is not None:
        return UniformPose(guess.world_from_part, guess.translation, guess.angle, tail=TAIL)
    return SwingTwistPose(guess.world_from_part, guess.translation, guess.tilt, guess.yaw, tail=TAIL)

"""Pose priors and proposals on SE(3), all with respect to one base measure (see `bcppl.poses`).

Every class says with `freedom` which axes are free; the others are held at the values of its centre.
"""

from __future__ import annotations

import math
from typing import Any, Protocol, SupportsFloat

import numpy as np
import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import MultivariateNormal, constraints

from bcppl import poses, quaternions
from bcppl.errors import InputError
from bcppl.poses import FREE, Freedom

# A held axis may stray by rounding over thousands of moves, never by a nanometre.
HELD = 1e-9
# How far the length of a quaternion may lie from 1.
UNIT = 1e-6


class _PoseDistribution(TorchDistribution):
    """A distribution over poses (..., 7), centred at one pose or at one for each particle."""

    arg_constraints: dict[str, Any] = {}
    support = constraints.real_vector

    def __init__(self, center: Tensor, freedom: Freedom, batch_shape: torch.Size | None = None) -> None:
        self.center = center
        self.freedom = freedom
        shape = center.shape[:-1] if batch_shape is None else batch_shape
        super().__init__(torch.Size(shape), torch.Size([7]), validate_args=False)

    def expand(self, batch_shape: Any, _instance: Any = None) -> _PoseDistribution:
        """The same distribution for a batch of draws, one for each particle of a plate."""
        if torch.Size(batch_shape) == self.batch_shape:
            return self
        new = type(self).__new__(type(self))
        new.__dict__.update(self.__dict__)
        new.center = self.center.expand(*batch_shape, 7)
        TorchDistribution.__init__(new, torch.Size(batch_shape), self.event_shape, validate_args=False)
        return new

    def _turned(self, shape: torch.Size, rotation: Tensor, translation: Tensor) -> Tensor:
        """The centre moved by free translations (*shape, 3) and quaternions x y z w (*shape, 4)."""
        center = self.center.expand(*shape, 7)
        quaternion = quaternions.product(poses.quaternion_xyzw(center).contiguous(), rotation)
        quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
        return poses.from_translation_quaternion_xyzw(center[..., :3] + translation, quaternion)


def _is_unit(pose: Tensor) -> Tensor:
    """Whether poses (..., 7) have unit quaternions: any other seven numbers are no pose."""
    return (pose[..., 3:].square().sum(dim=-1) - 1.0).abs() <= 2.0 * UNIT


def _half_widths(translation: Any, freedom_rotation: str) -> tuple[Tensor, Freedom]:
    try:
        widths = torch.as_tensor(translation, dtype=torch.float64).expand(3)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(
            f"a pose prior has half widths {translation!r}; give one number for all axes, or three, metres."
        ) from None
    if not bool(torch.isfinite(widths).all()) or bool((widths < 0).any()):
        raise InputError(
            f"a pose prior has half widths {widths.tolist()} m; "
            "give three numbers, positive or 0 for a held axis."
        )
    free = "".join(axis for axis, width in zip("xyz", widths.tolist(), strict=True) if width > 0)
    return widths, Freedom(free, freedom_rotation)


def _angle(value: float, name: str) -> float:
    if not isinstance(value, SupportsFloat) or not 0.0 <= float(value) <= math.pi:
        raise InputError(f"a pose prior has {name} {value!r}; give an angle in radians from 0 to pi.")
    return float(value)


class UniformPose(_PoseDistribution):
    """Uniform in a box times uniform (Haar) within an angle of a given orientation.

    Args:
        center: (7,) the pose in the middle.
        translation: half widths (3,) or one for all, metres, along the axes of the frame the pose maps to;
            0 holds an axis fixed.
        angle: the largest rotation angle away from the centre, radians, at most pi; 0 holds the orientation.
        rotation: "all", or one axis "x", "y", "z" of the frame the pose maps from.

    The Haar measure of a ball of rotation angle a is (a - sin a) / pi.

    Raises:
        InputError: a width or an angle is out of range.
    """

    def __init__(self, center: Any, translation: Any, angle: float, rotation: str = "all") -> None:
        self.angle = _angle(angle, "angle")
        self.widths, freedom = _half_widths(translation, rotation if self.angle > 0 else "none")
        super().__init__(poses.as_pose(center, "the centre of a pose prior"), freedom)
        volume = {
            "none": 1.0,
            "all": (self.angle - math.sin(self.angle)) / math.pi,
        }.get(freedom.rotation, self.angle / math.pi)
        free = self.widths[self.widths > 0]
        self.log_density = -math.log(volume) - float(torch.log(2.0 * free).sum())

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (*sample_shape, *batch_shape, 7)."""
        shape = torch.Size(sample_shape) + self.batch_shape
        translation = self.widths * (2.0 * torch.rand(*shape, 3, dtype=torch.float64) - 1.0)
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
        return self._turned(shape, rotation, translation)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (...,) with respect to the base measure; -inf outside the support."""
        tangent = poses.local(self.center, value)
        inside = (tangent[..., :3].abs() <= self.widths + HELD).all(dim=-1)
        inside &= tangent[..., 3:].norm(dim=-1) <= self.angle + HELD
        inside &= (self.freedom.off_axis(tangent) <= HELD) & _is_unit(value)
        return torch.where(inside, value.new_tensor(self.log_density), -torch.inf)


def _haar_angle(shape: torch.Size, largest: float) -> Tensor:
    """Rotation angles of Haar-distributed rotations within `largest`: density proportional to 1 - cos a."""
    # Inverse of the distribution function a - sin a by a fine table: exact to 1e-9 of the range.
    table = np.linspace(0.0, largest, 20001)
    uniform = torch.rand(*shape, dtype=torch.float64).numpy()
    cumulative = table - np.sin(table)
    return torch.from_numpy(np.asarray(np.interp(uniform * cumulative[-1], cumulative, table)))


class SwingTwistPose(_PoseDistribution):
    """Uniform in a box times uniform (Haar) over rotations with limited tilt and limited yaw.

    A rotation away from the centre is split into a swing of the part's z axis and a twist about it,
    R = R_center Swing Twist. Tilt is the angle between the z axis and its place at the centre, yaw the twist.
    Haar measure is the uniform measure of the z axis on the sphere times that of the twist on the circle,
    so the set has measure (1 - cos tilt) / 2 * yaw / pi.

    Args:
        center: (7,) the pose in the middle.
        translation: half widths (3,) or one for all, metres; 0 holds an axis fixed.
        tilt: the largest tilt, radians; 0 leaves a turn about the part's z axis alone.
        yaw: the largest twist to either side, radians.

    Raises:
        InputError: a limit is out of range, or tilt is free while yaw is held (no Haar measure).
    """

    def __init__(self, center: Any, translation: Any, tilt: float, yaw: float) -> None:
        self.tilt, self.yaw = _angle(tilt, "tilt"), _angle(yaw, "yaw")
        if self.tilt > 0 and self.yaw == 0:
            raise InputError(
                "a pose prior with free tilt and held yaw has no Haar measure; "
                "give yaw a small positive limit."
            )
        rotation = "all" if self.tilt > 0 else "z" if self.yaw > 0 else "none"
        self.widths, freedom = _half_widths(translation, rotation)
        super().__init__(poses.as_pose(center, "the centre of a pose prior"), freedom)
        volume = (0.5 * (1.0 - math.cos(self.tilt)) if self.tilt > 0 else 1.0) * (
            self.yaw / math.pi if self.yaw else 1.0
        )
        free = self.widths[self.widths > 0]
        self.log_density = -math.log(volume) - float(torch.log(2.0 * free).sum())

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (*sample_shape, *batch_shape, 7)."""
        shape = torch.Size(sample_shape) + self.batch_shape
        uniform = torch.rand(*shape, 6, dtype=torch.float64)
        translation = self.widths * (2.0 * uniform[..., :3] - 1.0)
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
        return self._turned(shape, rotation, translation)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (...,) with respect to the base measure; -inf outside the support."""
        tilt, yaw = tilt_and_yaw(self.center, value)
        shift = value[..., :3] - self.center[..., :3]
        inside = (shift.abs() <= self.widths + HELD).all(dim=-1)
        # The angle of a vanishing tilt is the square root of rounding in the quaternion.
        inside &= (tilt <= self.tilt + 1e-7) & (yaw.abs() <= self.yaw + HELD) & _is_unit(value)
        return torch.where(inside, value.new_tensor(self.log_density), -torch.inf)


def tilt_and_yaw(center: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Tilt of the z axis (0 to pi) and twist about it (-pi to pi) from `center` to `pose`, (...,) radians."""
    first, second = torch.broadcast_tensors(
        quaternions.conjugate(poses.quaternion_xyzw(center)), poses.quaternion_xyzw(pose)
    )
    x, y, z, w = quaternions.product(first, second).unbind(dim=-1)
    tilt = 2.0 * torch.atan2(torch.hypot(x, y), torch.hypot(z, w))
    yaw = torch.remainder(2.0 * torch.atan2(z, w) + math.pi, 2.0 * math.pi) - math.pi
    return tilt, yaw


class NormalPose(_PoseDistribution):
    """Normal in the tangent space at a pose, pushed forward by `poses.retract`, its Jacobian included.

    Args:
        center: (7,) or (N, 7): the pose at which the tangent space is taken.
        covariance: over the free coordinates in the order of `freedom.axes` (d, d) or (N, d, d), in m^2,
            m rad and rad^2; or standard deviations (d,), metres then radians.
        freedom: which axes are free.

    The density is that of the normal over rotation vectors divided by d(Haar)/d(rotation vector)
    (Chirikjian, Stochastic Models, Information Theory, and Lie Groups, vol. 2, 10.6), summed over the
    windings next to the principal one where the spread is wide enough for them to matter.

    Raises:
        InputError: the covariance has the wrong size or is not positive definite, or a centre has no unit
            quaternion.
    """

    def __init__(self, center: Any, covariance: Any, freedom: Freedom = FREE) -> None:
        matrix = torch.as_tensor(covariance, dtype=torch.float64)
        if matrix.ndim == 1:
            if bool((matrix < 0.0).any()):
                raise InputError(
                    f"a normal over poses was given the standard deviations {matrix.tolist()}; "
                    "give none below 0 (metres, radians)."
                )
            matrix = torch.diag(matrix**2)
        if matrix.shape[-2:] != (freedom.dimension, freedom.dimension):
            raise InputError(
                f"a normal over {freedom.dimension} free axes was given a covariance of shape "
                f"{tuple(matrix.shape)}; give one row and column for each free axis."
            )
        scale, failed = torch.linalg.cholesky_ex(matrix)
        if bool(failed.any()) or not bool(torch.isfinite(scale).all()):
            raise InputError(
                "the covariance of a normal over poses is not positive definite; "
                "every free axis needs a spread above 0 (metres, radians)."
            )
        self._normal = MultivariateNormal(
            torch.zeros(freedom.dimension, dtype=torch.float64), scale_tril=scale, validate_args=False
        )
        turns = [k for k, axis in enumerate(freedom.axes) if axis >= 3]
        widest = float(matrix.diagonal(dim1=-2, dim2=-1)[..., turns].max().sqrt()) if turns else 0.0
        # Beyond half a radian the neighbouring windings carry more than 1e-16 of the mass.
        self._windings = (0.0,) if widest < 0.5 else (0.0, -2.0 * math.pi, 2.0 * math.pi)
        middle = torch.as_tensor(center, dtype=torch.float64)
        if bool(((middle[..., 3:].square().sum(dim=-1) - 1.0).abs() > 2e-3).any()):
            raise InputError(
                "a normal over poses was given a centre whose quaternion is not of unit length; "
                "give x y z (m) qw qx qy qz, or mend it with `poses.as_pose`."
            )
        super().__init__(middle, freedom)

    @property
    def covariance(self) -> Tensor:
        """Over the free coordinates, (d, d) or (N, d, d), in m^2, m rad and rad^2."""
        scale = self._normal.scale_tril
        return scale @ scale.transpose(-1, -2)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (*sample_shape, *batch_shape, 7)."""
        shape = torch.Size(sample_shape) + self.batch_shape
        noise = torch.randn(*shape, self.freedom.dimension, 1, dtype=torch.float64)
        tangent = self.freedom.embed((self._normal.scale_tril @ noise)[..., 0])
        return poses.retract(self.center.expand(*shape, 7), tangent)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (...,) with respect to the base measure; -inf where a held axis differs."""
        tangent = poses.local(self.center, value)
        angle = tangent[..., 3:].norm(dim=-1)
        terms = []
        for winding in self._windings:
            wound = tangent
            if winding:
                stretch = 1.0 + winding / angle.clamp_min(1e-12)
                wound = torch.cat([tangent[..., :3], tangent[..., 3:] * stretch[..., None]], dim=-1)
            terms.append(
                self._normal.log_prob(self.freedom.coordinates(wound))
                - self.freedom.log_base_density(angle + winding)
            )
        density = terms[0] if len(terms) == 1 else torch.logsumexp(torch.stack(terms), dim=0)
        possible = (self.freedom.off_axis(tangent) <= HELD) & _is_unit(value)
        return torch.where(possible, density, -torch.inf)


class _Guess(Protocol):
    @property
    def world_from_part(self) -> Any: ...
    @property
    def translation(self) -> Any: ...
    @property
    def tilt(self) -> float: ...
    @property
    def yaw(self) -> float: ...
    @property
    def angle(self) -> float | None: ...


def prior_from_guess(guess: _Guess) -> UniformPose | SwingTwistPose:
    """The prior that a recording's guess states: uniform within an angle, or within a tilt and a yaw."""
    if guess.angle is not None:
        return UniformPose(guess.world_from_part, guess.translation, guess.angle)
    return SwingTwistPose(guess.world_from_part, guess.translation, guess.tilt, guess.yaw)

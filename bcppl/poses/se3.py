"""Poses, their algebra, their tangent space and which axes of them are free: see `bcppl.poses`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.arguments import pose_problem
from bcppl.cached import cached_property
from bcppl.devices import constant, is_on_host, numbers
from bcppl.errors import InputError
from bcppl.poses import kernels, quaternions
from bcppl.poses.kernels import fused

_LOG_8_PI_SQUARED = math.log(8.0 * math.pi**2)


_XYZW = torch.tensor([4, 5, 6, 3])  # of a pose
_WXYZ = torch.tensor([3, 0, 1, 2])  # of a quaternion as scipy orders it


def identity(*batch: int) -> Tensor:
    """The identity pose, shape (*batch, 7)."""
    pose = torch.zeros(*batch, 7, dtype=torch.float64)
    pose[..., 3] = 1.0
    return pose


def as_pose(values: object, name: str = "pose") -> Tensor:
    """A float64 pose tensor from seven numbers (or a batch of them), its quaternion normalised.

    Raises:
        InputError: the last dimension is not 7, a number is not finite, or a quaternion is not a unit one.
    """
    pose = torch.as_tensor(values, dtype=torch.float64)
    # Of many on a GPU only whether all are valid is asked there.
    if (is_on_host(pose) or not bool(_are_valid(pose))) and (
        problem := pose_problem(name, numbers(pose.detach()))
    ):
        raise InputError(problem)
    return torch.cat([pose[..., :3], pose[..., 3:] / pose[..., 3:].norm(dim=-1)[..., None]], dim=-1)


def _are_valid(pose: Tensor) -> Tensor:
    if pose.ndim == 0 or pose.shape[-1] != 7:
        return torch.tensor(False)
    unit = (pose[..., 3:].norm(dim=-1) - 1.0).abs() <= 1e-3
    return unit.all() & torch.isfinite(pose).all()


def quaternion_xyzw(pose: Tensor) -> Tensor:
    """The rotations of poses (..., 7) as unit quaternions in scipy's order, shape (..., 4)."""
    return pose.index_select(-1, constant(_XYZW, pose))


def from_translation_quaternion_xyzw(translation: Tensor, quaternion: Tensor) -> Tensor:
    """Poses (..., 7) from translations (..., 3) and quaternions in order x y z w (..., 4)."""
    if translation.shape[:-1] != quaternion.shape[:-1]:
        batch = torch.broadcast_shapes(translation.shape[:-1], quaternion.shape[:-1])
        translation, quaternion = translation.expand(*batch, 3), quaternion.expand(*batch, 4)
    return torch.cat([translation, quaternion.index_select(-1, constant(_WXYZ, quaternion))], dim=-1)


def from_rotation_matrix(translation: Tensor, rotation: Tensor) -> Tensor:
    """Poses (..., 7) from translations (..., 3) in metres and rotation matrices (..., 3, 3)."""
    return from_translation_quaternion_xyzw(translation, quaternions.from_rotation_matrix(rotation))


def from_rotation_vector(translation: Tensor, vector: Tensor) -> Tensor:
    """Poses (..., 7) from translations (..., 3) in metres and rotation vectors (..., 3) in radians.

    A rotation vector is the axis times the angle, as controllers log the pose of a tool: not Euler angles.
    """
    return from_translation_quaternion_xyzw(translation, quaternions.from_rotation_vector(vector))


def rotation_matrix(pose: Tensor) -> Tensor:
    """The rotations of poses (..., 7) as matrices (..., 3, 3)."""
    if (known := fused(kernels.rotation_matrix, pose, pose, 3, 3)) is not None:
        return known
    return quaternions.rotation_matrix(quaternion_xyzw(pose))


def compose(a_from_b: Tensor, b_from_c: Tensor) -> Tensor:
    """`a_from_c` of two batches of poses (..., 7) that broadcast against each other."""
    if (known := fused(kernels.compose, a_from_b, b_from_c, 7)) is not None:
        return known
    turned = (rotation_matrix(a_from_b) @ b_from_c[..., :3, None])[..., 0]
    return _turned(a_from_b, turned, quaternion_xyzw(b_from_c))


def inverse(a_from_b: Tensor) -> Tensor:
    """`b_from_a` of poses (..., 7)."""
    if (known := fused(kernels.inverse, a_from_b, a_from_b, 7)) is not None:
        return known
    rotation = rotation_matrix(a_from_b)
    translation = -(rotation.transpose(-1, -2) @ a_from_b[..., :3, None])[..., 0]
    return from_translation_quaternion_xyzw(translation, quaternions.conjugate(quaternion_xyzw(a_from_b)))


def transform(a_from_b: Tensor, points: Tensor) -> Tensor:
    """Points of frame b in frame a: poses (..., 7) and points (M, 3) give (..., M, 3), metres."""
    return points @ rotation_matrix(a_from_b).transpose(-1, -2) + a_from_b[..., None, :3]


def retract(pose: Tensor, tangent: Tensor) -> Tensor:
    """The pose (..., 7) reached from a pose (..., 7) by a tangent (..., 6): metres, then radians."""
    if (known := fused(kernels.retract, pose, tangent, 7)) is not None:
        return known
    return _turned(pose, tangent[..., :3], quaternions.from_rotation_vector(tangent[..., 3:]))


def local(pose: Tensor, other: Tensor) -> Tensor:
    """The tangent (..., 6) from `pose` to `other`: the inverse of `retract`, rotation angle at most pi."""
    if (known := fused(kernels.local, pose, other, 6)) is not None:
        return known
    turn = quaternions.relative(quaternion_xyzw(pose), quaternion_xyzw(other))
    return torch.cat([other[..., :3] - pose[..., :3], quaternions.rotation_vector(turn)], dim=-1)


def exp(pose: Tensor, twist: Tensor) -> Tensor:
    """The pose (..., 7) after a constant twist (..., 6) for a unit of time: the exponential map of SE(3).

    The twist is the velocity of the pose's origin at first, m along the outer frame's axes, and the rate of
    turn, rad about the inner frame's. To first order it is as `retract`, but the origin follows a screw: a
    turn about any place, however far away, is a straight line of twists.

    Source: Chirikjian, Stochastic Models, Information Theory, and Lie Groups, vol. 2, 10.1.
    """
    if (known := fused(kernels.exp, pose, twist, 7)) is not None:
        return known
    turn = (rotation_matrix(pose) @ twist[..., 3:, None])[..., 0]
    angle = _clear_of_zero(twist[..., 3:].norm(dim=-1, keepdim=True))
    once, twice = (1.0 - torch.cos(angle)) / angle**2, (angle - torch.sin(angle)) / angle**3
    return retract(pose, torch.cat([_bent(turn, twist[..., :3], once, twice), twist[..., 3:]], dim=-1))


def log(pose: Tensor, other: Tensor) -> Tensor:
    """The twist (..., 6) from `pose` to `other`: the inverse of `exp`, rotation angle at most pi."""
    if (known := fused(kernels.log, pose, other, 6)) is not None:
        return known
    return twist_of(pose, local(pose, other))


def twist_of(pose: Tensor, tangent: Tensor) -> Tensor:
    """The twist (..., 6) that leads from a pose (..., 7) to where a tangent (..., 6) of `retract` does.

    Both turn by the same angle, which may exceed pi.
    """
    turn = (rotation_matrix(pose) @ tangent[..., 3:, None])[..., 0]
    angle = _clear_of_zero(tangent[..., 3:].norm(dim=-1, keepdim=True))
    twice = 1.0 / angle**2 - 0.5 / (angle * torch.tan(0.5 * angle))
    moved = _bent(turn, tangent[..., :3], torch.full_like(angle, -0.5), twice)
    return torch.cat([moved, tangent[..., 3:]], dim=-1)


def _bent(turn: Tensor, shift: Tensor, once: Tensor, twice: Tensor) -> Tensor:
    turn, shift = torch.broadcast_tensors(turn, shift)
    across = torch.linalg.cross(turn, shift, dim=-1)
    return shift + once * across + twice * torch.linalg.cross(turn, across, dim=-1)


def _clear_of_zero(angle: Tensor) -> Tensor:
    """Angles of at least a ten-thousandth: the series that they stand in are the same to rounding there."""
    return angle.clamp_min(kernels.SMALL)


def log_volume_of_twist(angle: Tensor) -> Tensor:
    """Log of d(Lebesgue measure of translations) / d(that of twists), given the angle of turn.

    The determinant of SO(3)'s left Jacobian, 2 (1 - cos a) / a^2: Chirikjian, vol. 2, 10.6.
    """
    return 2.0 * torch.log(torch.sinc(0.5 * angle / math.pi).abs())


def _turned(pose: Tensor, shift: Tensor, turn: Tensor) -> Tensor:
    """A pose (..., 7) moved by (..., 3) in its outer frame and turned by (..., 4) in its inner one."""
    product = quaternions.product(quaternion_xyzw(pose), turn)
    product = product / torch.linalg.vector_norm(product, dim=-1, keepdim=True)
    return from_translation_quaternion_xyzw(pose[..., :3] + shift, product)


def log_haar_density_of_rotation_vector(angle: Tensor) -> Tensor:
    """Log of d(normalised Haar measure on SO(3)) / d(Lebesgue measure of the rotation vector), at an angle.

    The density is (1 - cos a) / (4 pi^2 a^2): Chirikjian, Stochastic Models, Information Theory, and Lie
    Groups, vol. 2, 10.6. Angles may exceed pi (further windings); at 2 pi k, k > 0, it is -inf.
    """
    half = 0.5 * angle
    return 2.0 * torch.log(torch.sinc(half / math.pi).abs()) - _LOG_8_PI_SQUARED


_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Freedom:
    """The free axes of a pose, which determine the base measure of its densities.

    Attributes:
        translation: the free translations among "xyz", in the frame the pose maps to.
        rotation: "all", "none", or the one axis ("x", "y" or "z", of the frame the pose maps from)
            about which the pose may turn. Other combinations have no Haar measure and are refused.

    The measure is Lebesgue on the free translations (metres) times the normalised Haar measure on the free
    rotations: of SO(3) for "all", of the circle for one axis, a unit mass for "none".
    """

    translation: str = "xyz"
    rotation: str = "all"

    def __post_init__(self) -> None:
        if "".join(a for a in "xyz" if a in self.translation) != self.translation:
            raise InputError(f"free translations {self.translation!r} are no part of 'xyz' in that order.")
        if self.rotation not in ("all", "none", "x", "y", "z"):
            raise InputError(
                f"free rotation {self.rotation!r} is refused: "
                "only 'all', 'none' or one axis 'x', 'y', 'z' has a Haar measure."
            )
        if not self.translation and self.rotation == "none":
            raise InputError(
                "a pose with no free axis needs no belief; leave a translation or rotation free."
            )

    @cached_property
    def axes(self) -> tuple[int, ...]:
        """Indices into the tangent (6,) of the free coordinates."""
        turns = {"all": (3, 4, 5), "none": ()}.get(self.rotation)
        if turns is None:
            turns = (3 + _AXES[self.rotation],)
        return (*(_AXES[a] for a in self.translation), *turns)

    @property
    def dimension(self) -> int:
        """The number of free axes."""
        return len(self.axes)

    def embed(self, coordinates: Tensor) -> Tensor:
        """The tangent (..., 6) of free coordinates (..., dimension)."""
        tangent = coordinates.new_zeros(*coordinates.shape[:-1], 6)
        tangent[..., list(self.axes)] = coordinates
        return tangent

    def coordinates(self, tangent: Tensor) -> Tensor:
        """The free coordinates (..., dimension) of a tangent (..., 6)."""
        return tangent[..., list(self.axes)]

    def off_axis(self, tangent: Tensor) -> Tensor:
        """The largest part of tangents (..., 6) along the held axes, shape (...,): zero on the support."""
        held = [k for k in range(6) if k not in self.axes]
        if not held:
            return tangent.new_zeros(tangent.shape[:-1])
        return tangent[..., held].abs().amax(dim=-1)

    def log_base_density(self, angle: Tensor) -> Tensor:
        """Log of d(base measure) / d(Lebesgue measure of the free coordinates), at signed angles (...,)."""
        if self.rotation == "all":
            return log_haar_density_of_rotation_vector(angle)
        if self.rotation == "none":
            return torch.zeros_like(angle)
        return torch.full_like(angle, -math.log(2.0 * math.pi))


FREE = Freedom()


def right_jacobian(turn: Tensor) -> Tensor:
    """The right Jacobian (..., 3, 3) of SO(3) at rotation vectors (..., 3): Exp(w + d) = Exp(w) Exp(J d).

    Chirikjian, Stochastic Models, Information Theory, and Lie Groups, vol. 2, 10.86.
    """
    angle = turn.norm(dim=-1)[..., None, None].clamp(min=1e-6)
    x, y, z = turn.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*turn.shape, 3)
    first, second = (1.0 - angle.cos()) / angle**2, (angle - angle.sin()) / angle**3
    return torch.eye(3, dtype=torch.float64) - first * cross + second * (cross @ cross)

"""Normals over poses, and mixtures of them with one density."""

from __future__ import annotations

import math
from typing import Any

import torch
from pyro.distributions import TorchDistribution
from torch import Tensor
from torch.distributions import constraints

from bcppl import poses
from bcppl.cached import cached_property
from bcppl.distributions.poses.base import HELD, PoseDistribution, is_unit
from bcppl.errors import InputError
from bcppl.poses import FREE, Freedom

_AT_CENTER = 1e-9  # rad: a smaller turn has no axis


class NormalPose(PoseDistribution):
    """Normal in the tangent space at a pose, pushed forward by `poses.retract`, its Jacobian included.

    Args:
        center: (7,) or (N, 7): the pose at which the tangent space is taken.
        covariance: over the free coordinates in the order of `freedom.axes` (d, d) or (N, d, d), in m^2,
            m rad and rad^2; or standard deviations (d,), metres then radians.
        freedom: which axes are free.

    Attributes:
        covariance: over the free coordinates, (d, d) or (N, d, d), in m^2, m rad and rad^2.

    The density is that of the normal over rotation vectors divided by d(Haar)/d(rotation vector)
    (Chirikjian, Stochastic Models, Information Theory, and Lie Groups, vol. 2, 10.6), summed over the
    windings next to the principal one where the spread is so wide that they matter.

    Raises:
        InputError: the covariance has the wrong size or is not positive definite, or a centre has no unit
            quaternion.
    """

    def __init__(self, center: Any, covariance: Any, freedom: Freedom = FREE) -> None:
        matrix = torch.as_tensor(covariance, dtype=torch.float64)
        if matrix.ndim == 1:
            matrix = torch.diag(matrix**2)
        size = freedom.dimension
        if matrix.shape[-2:] != (size, size):
            raise InputError(
                f"NormalPose over {size} free axes has a covariance of shape "
                f"{tuple(matrix.shape)}; give one row and column for each free axis."
            )
        scale, failed = torch.linalg.cholesky_ex(matrix)
        if bool(failed.any()) or not math.isfinite(scale.detach().sum()):
            raise InputError(
                "the covariance of NormalPose is not positive definite; "
                "give every free axis a standard deviation above 0 (metres, radians)."
            )
        self.covariance, self._scale = matrix, scale
        middle = torch.as_tensor(center, dtype=torch.float64)
        if bool(((middle[..., 3:].square().sum(dim=-1) - 1.0).abs() > 2e-3).any()):
            raise InputError(
                "NormalPose has a centre whose quaternion is not of unit length; "
                "give x y z (m) qw qx qy qz, or normalise it with `poses.as_pose`."
            )
        super().__init__(middle, freedom)

    # Most are only drawn from or multiplied by others: what their density takes is made when it is asked for.

    @cached_property
    def _windings(self) -> tuple[float, ...]:
        """By how much the angles of the rotations that are summed over differ, radians."""
        turns = sum(axis >= 3 for axis in self.freedom.axes)
        variances = self._scale.detach()[..., self.freedom.dimension - turns :, :].square().sum(dim=-1)
        # Beyond half a radian the neighbouring windings carry more than 1e-16 of the mass: angles of up to
        # 8.3 deviations count.
        spread = float(variances.max().sqrt()) if turns > 0 else 0.0
        most = max(1, math.ceil((8.3 * spread - math.pi) / (2.0 * math.pi))) if spread >= 0.5 else 0
        return (0.0, *(sign * 2.0 * math.pi * k for k in range(1, most + 1) for sign in (-1.0, 1.0)))

    @cached_property
    def _half_log_determinant(self) -> Tensor:
        return self._scale.diagonal(dim1=-2, dim2=-1).log().sum(dim=-1)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (*sample_shape, *batch_shape, 7)."""
        shape = torch.Size(sample_shape) + self.batch_shape
        noise = torch.randn(*shape, self.freedom.dimension, 1, dtype=torch.float64)
        tangent = self.freedom.embed((self._scale @ noise)[..., 0])
        return self._moved(self.center.expand(*shape, 7), tangent)

    def coordinates(self, value: Tensor) -> Tensor:
        """The free coordinates (..., d) of poses (..., 7) from the centre, which are normal."""
        tangent = poses.local(self.center, value)
        drawn, _ = self._measured(tangent, tangent[..., 3:].norm(dim=-1))
        return self.freedom.coordinates(drawn)

    def _moved(self, center: Tensor, tangent: Tensor) -> Tensor:
        """Poses (..., 7) a tangent (..., 6) away from centres."""
        return poses.retract(center, tangent)

    def _measured(self, tangent: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
        """The tangents (..., 6) as they are drawn, and the log-density of the base measure over these."""
        return tangent, self.freedom.log_base_density(angle)

    def _log_normal(self, coordinates: Tensor) -> Tensor:
        """The log-density (...,) of the free coordinates (..., d)."""
        white = torch.linalg.solve_triangular(self._scale, coordinates[..., None], upper=False)
        size = self.freedom.dimension * math.log(2.0 * math.pi)
        return -0.5 * (size + white[..., 0].square().sum(dim=-1)) - self._half_log_determinant

    def _wound(self, tangent: Tensor, angle: Tensor, winding: float) -> Tensor:
        """Tangents (..., 6), which turn by angles (...,), turned by a winding more about the same axes."""
        stretch = 1.0 + winding / angle.clamp_min(_AT_CENTER)
        turn = tangent[..., 3:] * stretch[..., None]
        # At the centre any free axis is the same.
        axis = torch.zeros_like(turn)
        axis[..., self.freedom.axes[-1] - 3] = winding
        turn = torch.where((angle < _AT_CENTER)[..., None], axis, turn)
        return torch.cat([tangent[..., :3], turn], dim=-1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (...,) with respect to the base measure; -inf where a held axis differs."""
        tangent = poses.local(self.center, value)
        angle = tangent[..., 3:].norm(dim=-1)
        terms = []
        for winding in self._windings:
            wound = self._wound(tangent, angle, winding) if winding else tangent
            drawn, base = self._measured(wound, angle + winding)
            term = self._log_normal(self.freedom.coordinates(drawn)) - base
            if winding and self.freedom.rotation == "all":
                # All turns by 2 pi end at the centre. There the density over Haar measure has a pole, of
                # hardly any mass: the value is that beside it.
                term = torch.where(angle < _AT_CENTER, -torch.inf, term)
            terms.append(term)
        density = terms[0] if len(terms) == 1 else torch.logsumexp(torch.stack(terms), dim=0)
        possible = (self.freedom.off_axis(tangent) <= HELD) & is_unit(value)
        return torch.where(possible, density, -torch.inf)


class NormalTwist(NormalPose):
    """Normal over twists from a pose, pushed forward by `poses.exp`, its Jacobian included; all axes free.

    A part that turns about a place where it was touched moves along a straight line of twists, and along an
    arc in the coordinates of `NormalPose`: what is known of a contact to micrometres and of the turn to ten
    degrees is normal over twists alone (Long, Wolfe, Mashner and Chirikjian, The banana distribution is
    Gaussian, RSS 2012).

    Args:
        center: (7,) or (N, 7).
        covariance: (6, 6) or (N, 6, 6), in m^2, m rad and rad^2; or standard deviations (6,).

    Raises:
        InputError: as `NormalPose`.
    """

    def __init__(self, center: Any, covariance: Any) -> None:
        super().__init__(center, covariance)

    def _moved(self, center: Tensor, tangent: Tensor) -> Tensor:
        return poses.exp(center, tangent)

    def _measured(self, tangent: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
        base = self.freedom.log_base_density(angle) + poses.log_volume_of_twist(angle)
        return poses.twist_of(self.center, tangent), base


class MixturePose(TorchDistribution):
    """A mixture of K normals over poses (`NormalPose`), all with the same free axes.

    Args:
        log_weights: (K,) or (N, K), unnormalised; -inf for a component without weight.
        centers: (K, 7) or (N, K, 7).
        covariance: over the free coordinates, (d, d), (K, d, d) or (N, K, d, d), as `NormalPose` takes it, or
            standard deviations (d,).
        freedom: which axes are free.
        twists: whether the components are `NormalTwist`s, all axes free.
    """

    arg_constraints: dict[str, Any] = {}
    support = constraints.real_vector

    def __init__(
        self,
        log_weights: Tensor,
        centers: Tensor,
        covariance: Tensor,
        freedom: Freedom = FREE,
        *,
        twists: bool = False,
    ) -> None:
        batch = torch.broadcast_shapes(log_weights.shape[:-1], centers.shape[:-2])
        self.log_weights = torch.log_softmax(log_weights.to(torch.float64), dim=-1)
        self.components = (
            NormalTwist(centers, covariance) if twists else NormalPose(centers, covariance, freedom)
        )
        self.freedom = self.components.freedom
        super().__init__(torch.Size(batch), torch.Size([7]), validate_args=False)

    def expand(self, batch_shape: Any, _instance: Any = None) -> MixturePose:
        """The same mixture for a batch of draws, one for each particle of a plate."""
        new = type(self).__new__(type(self))
        new.__dict__.update(self.__dict__)
        new.log_weights = self.log_weights.expand(*batch_shape, -1)
        TorchDistribution.__init__(new, torch.Size(batch_shape), self.event_shape, validate_args=False)
        return new

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (*sample_shape, *batch_shape, 7)."""
        shape = torch.Size(sample_shape) + self.batch_shape
        chances = self.log_weights.exp().expand(*shape, -1)
        drawn = torch.multinomial(chances.reshape(-1, chances.shape[-1]), 1).reshape(*shape, 1, 1)
        each = self.components.expand(torch.Size([*shape, chances.shape[-1]])).sample()
        return each.gather(-2, drawn.expand(*shape, 1, 7))[..., 0, :]

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (...,) with respect to the base measure; -inf where a held axis differs."""
        each = self.components.log_prob(value[..., None, :])
        return torch.logsumexp(self.log_weights + each, dim=-1)

"""Alignment by least squares: the motion of a part that brings points of it onto planes, for N particles.

A point q of the part, in its frame, moves by v + R (w x q) when its pose is moved by the tangent [v, w]
(`bcppl.poses`). Asked to move by a gap along a normal n, it gives the row [n, q x R^T n] of a linear system:
the point to plane distance of Chen and Medioni, Object modelling by registration of multiple range images,
Image and Vision Computing 10, 1992.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import MixturePose
from bcppl.poses import Freedom

# What is proposed around an alignment: normals of so many of the fit's deviations, each with its share.
# Far beyond the fit's the target falls more slowly than a normal does, and a particle that comes from there
# would not be let go, were there no way back.
WIDTHS = (1.0, 3.0, 10.0)
SHARES = (0.8, 0.15, 0.05)


@dataclass(frozen=True, eq=False)
class Equations:
    """The normal equations of N particles.

    Attributes:
        precision: (N, 6, 6) of the tangent: 1 / m^2, 1 / (m rad), 1 / rad^2.
        pull: (N, 6) precision times the tangent that solves them.
    """

    precision: Tensor
    pull: Tensor

    def __add__(self, other: Equations) -> Equations:
        return Equations(self.precision + other.precision, self.pull + other.pull)

    @classmethod
    def of_planes(
        cls, pose: Tensor, particle: Tensor, point: Tensor, normal: Tensor, gap: Tensor, precision: Tensor
    ) -> Equations:
        """The equations of M points that are to move along normals.

        Args:
            pose: (N, 7) world_from_part.
            particle: (M,) int64, whose point it is.
            point: (M, 3) in the part's frame, metres.
            normal: (M, 3) unit normals in the part's frame.
            gap: (M,) how far each is to move along its normal, metres.
            precision: (M,) 1 / m^2.
        """
        upward = (poses.rotation_matrix(pose)[particle] @ normal[:, :, None])[..., 0]
        row = torch.cat([upward, torch.linalg.cross(point, normal)], dim=1)
        weighed = precision[:, None] * row
        zero = row.new_zeros(len(pose), 6, 6)
        return cls(
            zero.index_add(0, particle, weighed[:, :, None] * row[:, None, :]),
            zero[..., 0].index_add(0, particle, gap[:, None] * weighed),
        )


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where an alignment leads, and how sure it is.

    Attributes:
        pose: (N, 7).
        covariance: (N, d, d) over the free axes.
    """

    pose: Tensor
    covariance: Tensor

    def around(self, freedom: Freedom) -> MixturePose:
        """A mixture of normals at the alignment, of its covariance and of several times that."""
        widths = torch.tensor(WIDTHS, dtype=torch.float64)
        return MixturePose(
            torch.tensor(SHARES, dtype=torch.float64).log(),
            self.pose[:, None].expand(-1, len(widths), -1),
            widths[:, None, None] ** 2 * self.covariance[:, None],
            freedom,
        )


def aligned(
    pose: Tensor, equations: Equations, damping: Tensor, freedom: Freedom, information: Tensor | None = None
) -> Alignment:
    """One Gauss-Newton step along the free axes, damped (Levenberg, Quarterly of Applied Math. 2, 1944).

    Args:
        pose: (N, 7) where the equations were taken.
        equations: there.
        damping: (d, d) precision of staying there; keeps the step where the equations say nothing.
        freedom: the free axes.
        information: (N, 6, 6) how sure the likelihood is of the answer, where that is not the equations' own
            precision, as where a power is taken of it.
    """
    free = list(freedom.axes)

    def solved(precision: Tensor) -> Tensor:
        inverse = torch.linalg.inv(precision[:, free][:, :, free] + damping)
        return 0.5 * (inverse + inverse.mT)

    covariance = solved(equations.precision)
    step = (covariance @ equations.pull[:, free, None])[..., 0]
    if information is not None:
        covariance = solved(information)
    return Alignment(poses.retract(pose, freedom.embed(step)), covariance)

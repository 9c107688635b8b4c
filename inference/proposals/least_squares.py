"""Alignment by least squares: the motion of a part that brings points of it onto planes, for N particles.

A point q of the part, in its frame, moves by v + R (w x q) when its pose is moved by the tangent [v, w]
(`bcppl.poses`). A gap along a normal n gives the row [n, q x R^T n] of a linear system: the point to plane
distance of Chen and Medioni, Object modelling by registration of multiple range images, Image and Vision
Computing 10, 1992.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import pyro
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import MixturePose
from bcppl.distributions.support import freedom_of
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.proposals.proposal import Fittable
from bcppl.inference.proposals.spread import spread_of
from bcppl.poses import FREE, Freedom
from bcppl.traces import Trace

# The components of a proposal about an alignment: widths in standard deviations of the fit, and weights. The
# target has heavier tails than the fit, and a particle in them would be stuck without wide components.
WIDTHS = (1.0, 3.0, 10.0)
SHARES = (0.8, 0.15, 0.05)


@dataclass(frozen=True, eq=False)
class Equations:
    """The normal equations of N particles.

    The precision (N, 6, 6) of the tangent is in 1 / m^2, 1 / (m rad) and 1 / rad^2; the pull (N, 6) is that
    times the solution.
    """

    precision: Tensor
    pull: Tensor

    def __add__(self, other: Equations) -> Equations:
        return Equations(self.precision + other.precision, self.pull + other.pull)

    @classmethod
    def of_planes(
        cls, pose: Tensor, particle: Tensor, point: Tensor, normal: Tensor, gap: Tensor, precision: Tensor
    ) -> Equations:
        """The equations of M points with gaps along normals.

        Args:
            pose: (N, 7) world_from_part.
            particle: (M,) int64, the particle of each point.
            point: (M, 3) in the part's frame, metres.
            normal: (M, 3) unit normals in the part's frame.
            gap: (M,) the required displacement along the normal, metres.
            precision: (M,) 1 / m^2.
        """
        upward = (poses.rotation_matrix(pose)[particle] @ normal[:, :, None])[..., 0]
        row = torch.cat([upward, torch.linalg.cross(point, normal)], dim=1)
        weighted = precision[:, None] * row
        zero = row.new_zeros(len(pose), 6, 6)
        return cls(
            zero.index_add(0, particle, weighted[:, :, None] * row[:, None, :]),
            zero[..., 0].index_add(0, particle, gap[:, None] * weighted),
        )


@dataclass(frozen=True, eq=False)
class Alignment:
    """The solution of an alignment: poses (N, 7), and covariances (N, d, d) over the free axes."""

    pose: Tensor
    covariance: Tensor

    def proposal(self, freedom: Freedom) -> MixturePose:
        """A mixture of normals at the solution, of its covariance and multiples."""
        widths = torch.tensor(WIDTHS, dtype=torch.float64)
        return MixturePose(
            torch.tensor(SHARES, dtype=torch.float64).log(),
            self.pose[:, None].expand(-1, len(widths), -1),
            widths[:, None, None] ** 2 * self.covariance[:, None],
            freedom,
        )


def alignment_proposal(
    address: str, reach: float, align: Callable[[Trace, Tensor, Freedom], Alignment]
) -> Fittable:
    """A proposal about the alignment of each particle.

    `align(trace, damping (d, d), free axes)` gives it, damped by a normal prior at the old pose, with the
    particles' covariance times `reach` squared.
    """

    def fit(population: Population) -> Callable[[Trace], None]:
        damping = torch.linalg.inv(reach**2 * spread_of(address)(population))

        def towards_alignment(trace: Trace) -> None:
            freedom = freedom_of(trace.distributions[address]) or FREE
            pyro.sample(address, align(trace, damping, freedom).proposal(freedom))

        return towards_alignment

    return Fittable(fit)


def matching(trace: Trace, name: str, patterns: Sequence[str]) -> list[str]:
    """The addresses of a trace that match one of several patterns; `name` is of the alignment."""
    matched = [a for a in trace.addresses if any(fnmatchcase(a, pattern) for pattern in patterns)]
    if not matched:
        raise InputError(
            f"{name} is given the sites {', '.join(patterns)}, which match no address; "
            f"the program visits {', '.join(trace.addresses)}."
        )
    return matched


def check_pose(name: str, address: str, site: str, same: bool) -> None:
    """Refuse a site that depends on another pose than that at `address`; `name` is of the alignment."""
    if not same:
        raise InputError(
            f"{name} moves {address!r}, but the site {site!r} depends on another pose; "
            "give that part's sites as `sites`."
        )


def aligned(
    pose: Tensor, equations: Equations, damping: Tensor, freedom: Freedom, information: Tensor | None = None
) -> Alignment:
    """One Gauss-Newton step along the free axes, damped (Levenberg, Quarterly of Applied Math. 2, 1944).

    Args:
        pose: (N, 7) at which the equations are linearised.
        equations: at those poses.
        damping: (d, d) precision of a normal prior there, which makes the step unique.
        freedom: the free axes.
        information: (N, 6, 6) of the likelihood about the solution, where it is not the equations' precision.
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

"""Unbounded coordinates of a latent value: a pose's tangent space, or the real line for any other support.

A value whose support is bounded (positive numbers, an interval, a simplex) is transformed to an unbounded one
by torch's bijection for its support, and densities include its Jacobian. An angle, whose density is periodic
(von Mises), is one of the interval from -pi to pi, and a step does not cross its ends. A place is a value in
the form that `normal` and `mixture` take as a centre: a pose (..., 7), or a vector (..., d).
"""

from __future__ import annotations

import math
from typing import Any

import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import biject_to, constraints
from torch.distributions.transforms import IndependentTransform, Transform, identity_transform

from bcppl import poses
from bcppl.arguments import latent_address
from bcppl.beliefs import Belief
from bcppl.distributions.poses import MixturePose, NormalPose
from bcppl.distributions.support import Support, refuse_several_poses
from bcppl.distributions.vectors import NormalMixture, NormalStep
from bcppl.errors import InputError
from bcppl.poses import Freedom
from bcppl.traces import Trace


class PoseCoordinates:
    """A pose's free axes, in its tangent space: metres, then radians."""

    def __init__(self, freedom: Freedom) -> None:
        self.freedom = freedom
        self.dimension = freedom.dimension

    def of(self, trace: Trace) -> PoseCoordinates:
        """The same for the particles of another trace: all have the same free axes."""
        return self

    def places(self, values: Tensor) -> Tensor:
        """The poses themselves."""
        return values

    def steps(self, start: Tensor, end: Tensor) -> Tensor:
        """The free coordinates (..., d) of the tangents from pose to pose."""
        return self.freedom.coordinates(poses.local(start, end))

    def stepped(self, start: Tensor, step: Tensor) -> Tensor:
        """The poses after tangents (..., d)."""
        return poses.retract(start, self.freedom.embed(step))

    def still(self, places: Tensor) -> Tensor:
        """The axes (d,) along which no two places differ, bool."""
        same = (places == places[0]).all(dim=0)
        return self.freedom.coordinates(torch.cat([same[:3], same[3:].all().expand(3)]))

    def rounding(self, places: Tensor) -> Tensor:
        """Standard deviations (d,) below which differences of places are rounding, metres and radians."""
        return torch.full((self.dimension,), 1e-6, dtype=torch.float64)

    def mean(self, places: Tensor, weights: Tensor) -> Tensor:
        """The weighted mean pose along the free axes; the held ones are those of the first place."""
        mean = Belief(places, weights.log(), self.freedom).mean
        return self.stepped(places[0], self.steps(places[0], mean))

    def normal(self, center: Tensor, covariance: Tensor, size: Tensor) -> Any:
        """The `NormalPose` at N places, its covariance (d, d) times `size` (N,) squared."""
        return NormalPose(center, size[:, None, None] ** 2 * covariance, self.freedom)

    def mixture(self, log_weights: Tensor, centers: Tensor, covariance: Tensor) -> Any:
        """The `MixturePose` with log weights (K,) or (N, K), at places (K, ...) or (N, K, ...).

        The covariances are (d, d), (K, d, d) or (N, K, d, d).
        """
        return MixturePose(log_weights, centers, covariance, self.freedom)


class VectorCoordinates:
    """Any other continuous value, flattened, in the unbounded coordinates of its distribution's support."""

    def __init__(self, address: str, transform: Unflattened) -> None:
        self.address = address
        self.transform = transform
        self.dimension = transform.dimension

    def of(self, trace: Trace) -> Coordinates:
        """The same for other particles; a support may depend on their other values."""
        if self.transform.unbounded:
            return VectorCoordinates(self.address, self.transform.of(trace[self.address]))
        return coordinates_of(trace, self.address)

    def places(self, values: Tensor) -> Tensor:
        """The values' unbounded coordinates (N, d)."""
        return self.transform.inv(values)

    def steps(self, start: Tensor, end: Tensor) -> Tensor:
        """Differences."""
        return end - start

    def stepped(self, start: Tensor, step: Tensor) -> Tensor:
        """Sums."""
        return start + step

    def still(self, places: Tensor) -> Tensor:
        """The axes (d,) along which no two places differ, bool."""
        same = places[0] == places[-1]  # where the first and the last differ, no others need be compared
        return (places == places[0]).all(dim=0) if bool(same.any()) else same

    def rounding(self, places: Tensor) -> Tensor:
        """Standard deviations (d,) below which differences of places are rounding."""
        return (1e-12 * places.abs().amax(dim=0)).clamp_min(1e-150)

    def mean(self, places: Tensor, weights: Tensor) -> Tensor:
        """The weighted mean."""
        return weights @ places

    def normal(self, center: Tensor, covariance: Tensor, size: Tensor) -> Any:
        """A multivariate normal, transformed to the support."""
        return self._on_support(NormalStep(center, torch.linalg.cholesky(covariance), size))

    def mixture(self, log_weights: Tensor, centers: Tensor, covariance: Tensor) -> Any:
        """A mixture of multivariate normals, transformed to the support; covariances (d, d) or (K, d, d)."""
        factors = torch.linalg.cholesky(covariance)
        return self._on_support(NormalMixture(self.transform.particles, log_weights, centers, factors))

    def _on_support(self, base: Any) -> Any:
        if self.transform.trivial:
            return base
        return OnSupport(base, [self.transform], validate_args=False)


class OnSupport(dist.TransformedDistribution):
    """A distribution over unbounded coordinates, transformed to the support of a site.

    Where a step leaves the range of the value's type (a log of -100 is 0 in single precision, one of 800
    infinite in double), the value has no coordinates, and its density is zero: no proposal leads back.
    """

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) of the values (N, *plates, *event); -inf where they have no coordinates."""
        (transform,) = self.transforms
        place = transform.inv(value)
        density = self.base_dist.log_prob(place) - transform.log_abs_det_jacobian(place, value)
        return torch.where(torch.isfinite(place).all(dim=-1), density, -torch.inf)


class Unflattened(Transform):
    """From unbounded coordinates (N, d) in float64 to the values (N, *plates, *event) of a site."""

    bijective = True
    domain = constraints.real_vector

    def __init__(self, support: Support, values: Tensor) -> None:
        super().__init__(cache_size=0)
        self.to_support = biject_to(support.constraint)
        self.plates = support.plates
        self.unbounded = _is_identity(self.to_support)
        self._set(values)

    def of(self, values: Tensor) -> Unflattened:
        """The same for other particles, if their support is the same."""
        other = Unflattened.__new__(Unflattened)
        other.__dict__.update(self.__dict__)
        other._inv = None  # torch caches a transform's inverse, which would be that of the old one
        other._set(values)
        return other

    def _set(self, values: Tensor) -> None:
        self.particles, self.event, self.dtype = len(values), values.shape[1:], values.dtype
        self.codomain = constraints.independent(constraints.real, len(self.event))
        self.free_event = self._free(values).shape[1 + self.plates :]
        self.dimension = math.prod(self.event[: self.plates]) * math.prod(self.free_event)
        self.trivial = self.unbounded and len(self.event) == 1 and self.dtype == torch.float64

    def _free(self, values: Tensor) -> Tensor:
        inside = values.to(torch.float64).movedim(0, self.plates)
        return self.to_support.inv(inside).movedim(self.plates, 0)

    def _inside(self, x: Tensor) -> Tensor:
        free = x.reshape(self.particles, *self.event[: self.plates], *self.free_event)
        return free.movedim(0, self.plates)

    def _call(self, x: Tensor) -> Tensor:
        return self.to_support(self._inside(x)).movedim(self.plates, 0).to(self.dtype)

    def _inverse(self, y: Tensor) -> Tensor:
        return self._free(y).reshape(self.particles, -1)

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        """Log-determinant (N,) over all entries."""
        inside = self._inside(x)
        each = self.to_support.log_abs_det_jacobian(inside, y.to(torch.float64).movedim(0, self.plates))
        return each.movedim(self.plates, 0).reshape(self.particles, -1).sum(dim=1)

    def forward_shape(self, shape: tuple[int, ...]) -> torch.Size:
        """From (N, d) to (N, *plates, *event)."""
        return torch.Size([*shape[:-1], *self.event])

    def inverse_shape(self, shape: tuple[int, ...]) -> torch.Size:
        """From (N, *plates, *event) to (N, d)."""
        return torch.Size([*shape[: len(shape) - len(self.event)], self.dimension])


Coordinates = PoseCoordinates | VectorCoordinates


def _is_identity(transform: Transform) -> bool:
    while isinstance(transform, IndependentTransform):
        transform = transform.base_transform
    return transform == identity_transform


def coordinates_of(trace: Trace, address: str) -> Coordinates:
    """The coordinates of a latent address of a trace; InputError where it has none."""
    latent_address("a proposal moves {}", address, trace.choices)
    support, value = trace.support(address), trace[address]
    if support.freedom is not None:
        refuse_several_poses(address, value, support.freedom)
        return PoseCoordinates(support.freedom)
    if support.constraint.is_discrete or not value.is_floating_point():
        raise InputError(f"address {address!r} is discrete and has no coordinates; use prior({address!r}).")
    try:
        return VectorCoordinates(address, Unflattened(support, value))
    except NotImplementedError as error:
        raise InputError(
            f"the support of address {address!r}, {support.constraint}, has no unbounded coordinates; "
            f"use prior({address!r}) or a proposal of your own."
        ) from error


def continuous_addresses(trace: Trace) -> list[str]:
    """The latent addresses of a trace that have coordinates."""
    movable = []
    for address in trace.choices:
        try:
            coordinates_of(trace, address)
        except InputError:
            continue
        movable.append(address)
    return movable

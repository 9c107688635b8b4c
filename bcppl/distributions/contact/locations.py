"""Likelihoods of contact locations: the Chamfer surrogate, and a normalised one in time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.contact.track import TrackDistribution, log_gaussian
from bcppl.distributions.parameters import COUNT, NONNEGATIVE, POSITIVE, PROBABILITY, within


def chamfer(a: Tensor, b: Tensor, one_empty: float) -> Tensor:
    """D_ch (...,) of sets of points (..., S, 3) and (..., T, 3), square metres; rows of NaN are no points.

    The mean over a of the squared distance to the nearest point of b, plus the same from b to a
    (Fan, Su and Guibas 2017, equation 6, with means). Both sets empty: 0. One empty: `one_empty`.
    """
    a, b = _dense(a.to(torch.float64)), _dense(b.to(torch.float64))
    in_a, in_b = torch.isfinite(a).all(dim=-1), torch.isfinite(b).all(dim=-1)
    count_a, count_b = in_a.sum(dim=-1), in_b.sum(dim=-1)
    # The mode that multiplies matrices is off by up to 1e-8 m, which is a lot for points that are the same.
    exactly = "donot_use_mm_for_euclid_dist"
    squared = torch.cdist(torch.nan_to_num(a), torch.nan_to_num(b), compute_mode=exactly).square()
    squared = torch.where(in_a[..., :, None] & in_b[..., None, :], squared, math.inf)

    def mean_to_nearest(dim: int, inside: Tensor, count: Tensor) -> Tensor:
        nearest = squared.amin(dim=dim) if squared.shape[dim] else squared.new_full(inside.shape, math.inf)
        return torch.where(inside, nearest, 0.0).sum(dim=-1) / count.clamp(min=1)

    distance = mean_to_nearest(-1, in_a, count_a) + mean_to_nearest(-2, in_b, count_b)
    distance = torch.where((count_a == 0) != (count_b == 0), one_empty, distance)
    return torch.where((count_a == 0) & (count_b == 0), 0.0, distance)


def _dense(points: Tensor) -> Tensor:
    """The points (..., K, 3) without those rows of (..., S, 3) that are NaN in every set."""
    inside = torch.isfinite(points).all(dim=-1)
    inside = inside.reshape(inside.shape[:-1].numel(), inside.shape[-1]).any(dim=0)
    return points if bool(inside.all()) else points[..., inside, :]


@dataclass(eq=False, repr=False)
class ChamferContacts(TrackDistribution):
    """Contact locations at the stamps `first` to `last` of a probe: log p = -D_ch / (2 scale^2).

    A surrogate, not a density: its normaliser changes with the pose (for two points at a scale of 1 mm by a
    factor of 1.6), so evidence that contains it is a surrogate's, and `scale` and `one_empty` are settings,
    never latent. For one point on each side D_ch = 2 d^2, a standard deviation of scale / sqrt(2). Its
    sharpness grows with the number of windows, not with the number of stamps in one: the model fixes them.

    The event is (last - first, 3): locations in the peg's frame, a row of NaN where there is no contact.

    Args:
        track, first, last: as for `TrackDistribution`.
        scale: sigma, metres.
        one_empty: D_ch where one set is empty and the other is not, square metres; for example 2 (3 scale)^2.
        deviation: of `sample` alone: the standard deviation of a location along each axis, metres.
        missed: of `sample` alone: the probability that a contact is missed.
    """

    entries = 3

    scale: float = field(metadata=POSITIVE)
    one_empty: float = field(metadata=POSITIVE)
    deviation: float = field(default=0.0005, metadata=NONNEGATIVE)
    missed: float = field(default=0.02, metadata=within(least=0.0, most=1.0))

    @property
    def log_prob_bound(self) -> float:
        """0: the distance of two sets is at least 0."""
        return 0.0

    def _log_prob(self, value: Tensor) -> Tensor:
        contacts, _ = self.track.window(self.first, self.last)
        return -chamfer(contacts, value, self.one_empty) / (2.0 * self.scale**2)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Simulated locations (N, T, 3) with noise, some missed: a model of its own, not `log_prob`'s."""
        contacts, _ = self.track.window(self.first, self.last)
        noisy = contacts + self.deviation * torch.randn(contacts.shape, dtype=torch.float64)
        gone = torch.rand(contacts.shape[:-1], dtype=torch.float64) < self.missed
        return torch.where(gone[..., None], math.nan, noisy)


@dataclass(eq=False, repr=False)
class ContactsInTime(TrackDistribution):
    """A contact location or none at every `every`-th stamp of `first` to `last` of a probe: normalised.

    Where the simulated peg touches, the contact is missed with probability `missed`; else its location is
    Gaussian about the simulated one, or, with probability `outlier`, an outlier. Where it does not touch, an
    outlier is detected with probability `false_alarm`. Outliers are Gaussian about the origin of the peg's
    frame with the standard deviation `reach` along each axis. The density is with respect to counting measure
    on "none" plus Lebesgue measure on locations (cubic metres), at each stamp that enters it.

    A line of action is off by the torque's noise over the force (Bicchi, Salisbury and Brock 1993), which
    `torque_noise` adds to the scale, with the simulated force.

    The event is (last - first, 3): locations in the peg's frame, a row of NaN where there is no contact.

    Args:
        track, first, last: as for `TrackDistribution`.
        scale: standard deviation of a location along each axis, metres.
        missed: probability that a contact is not detected.
        false_alarm: probability that one is detected where there is none.
        outlier: probability that a contact is detected at a wrong place.
        reach: metres.
        torque_noise: standard deviation of the measured torque about each axis, N m.
        every: as for `TrackDistribution`.
    """

    broadcasts = True
    entries = 3

    scale: float = field(metadata=POSITIVE)
    missed: float = field(default=0.02, metadata=PROBABILITY)
    false_alarm: float = field(default=0.02, metadata=PROBABILITY)
    outlier: float = field(default=0.05, metadata=PROBABILITY)
    reach: float = field(default=0.05, metadata=POSITIVE)
    torque_noise: float = field(default=0.0, metadata=NONNEGATIVE)
    every: int = field(default=10, metadata=COUNT)

    @property
    def _scale(self) -> Tensor:
        """The standard deviations of locations, (N, T) or (), m."""
        own = torch.tensor(self.scale, dtype=torch.float64)
        if self.torque_noise == 0.0:
            return own
        force = self.track.wrench(self.first, self.last)[..., :3].norm(dim=-1)
        # Without a force there is no contact, and the scale does not count.
        return torch.hypot(own, self.torque_noise / torch.where(force > 0.0, force, math.inf))

    def _log_prob(self, value: Tensor) -> Tensor:
        contacts = self.track.window(self.first, self.last)[0][:, self.thinned]
        scale = self._scale if self.torque_noise == 0.0 else self._scale[:, self.thinned]
        touching, detected = torch.isfinite(contacts).all(dim=-1), torch.isfinite(value).all(dim=-1)
        value = torch.nan_to_num(value)
        anywhere = log_gaussian(value.square().sum(dim=-1), self.reach)
        near = log_gaussian((value - torch.nan_to_num(contacts)).square().sum(dim=-1), scale)
        here = torch.logaddexp(near + math.log1p(-self.outlier), anywhere + math.log(self.outlier))
        of_touch = torch.where(detected, here + math.log1p(-self.missed), math.log(self.missed))
        of_none = torch.where(detected, anywhere + math.log(self.false_alarm), math.log1p(-self.false_alarm))
        return torch.where(touching, of_touch, of_none).sum(dim=-1)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Locations (N, T, 3), NaN where none is detected; all stamps are drawn, independently."""
        contacts, _ = self.track.window(self.first, self.last)
        shape = contacts.shape[:-1]

        def happens(probability: float) -> Tensor:
            return torch.rand(shape, dtype=torch.float64) < probability

        touching = torch.isfinite(contacts).all(dim=-1)
        detected = torch.where(touching, ~happens(self.missed), happens(self.false_alarm))
        astray = (~touching | happens(self.outlier))[..., None]
        noise = torch.randn(*shape, 3, dtype=torch.float64)
        location = torch.where(astray, self.reach * noise, contacts + self._scale[..., None] * noise)
        return torch.where(detected[..., None], location, math.nan)

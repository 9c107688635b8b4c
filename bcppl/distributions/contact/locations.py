"""A normalised likelihood of contact locations in time."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.contact.track import Track, TrackDistribution, log_gaussian
from bcppl.distributions.parameters import POSITIVE, PROBABILITY


class ContactsInTime(TrackDistribution):
    """A contact location or none at every `every`-th stamp of `first` to `last` of a probe: normalised.

    Where the simulated peg touches, the contact is missed with probability `missed`; else its location is
    Gaussian about the simulated one, or, with probability `outlier`, an outlier. Where it does not touch, an
    outlier is detected with probability `false_alarm`. Outliers are Gaussian about the origin of the peg's
    frame with the standard deviation `reach` along each axis. The density is with respect to counting measure
    on "none" plus Lebesgue measure on locations (cubic metres), at each stamp that enters it.

    The event is (last - first, 3): locations in the peg's frame, a row of NaN where there is no contact.

    Args:
        track: the simulated probe.
        first: the first stamp.
        last: the stamp after the last.
        scale: standard deviation of a location along each axis, metres.
        missed: probability that a contact is not detected.
        false_alarm: probability that one is detected where there is none.
        outlier: probability that a contact is detected at a wrong place.
        reach: metres.
        every: the stamps whose number is a multiple of this enter the density, since errors are correlated
            in time.
    """

    broadcasts = True
    parameters = TrackDistribution.parameters | {
        "scale": POSITIVE,
        "missed": PROBABILITY,
        "false_alarm": PROBABILITY,
        "outlier": PROBABILITY,
        "reach": POSITIVE,
    }

    def __init__(
        self,
        track: Track,
        first: int,
        last: int,
        scale: float,
        missed: float = 0.02,
        false_alarm: float = 0.02,
        outlier: float = 0.05,
        reach: float = 0.05,
        every: int = 10,
    ) -> None:
        self.scale, self.missed, self.false_alarm, self.outlier = scale, missed, false_alarm, outlier
        self.reach, self.every = reach, every
        super().__init__(track, first, last, 3)

    def _log_prob(self, value: Tensor) -> Tensor:
        contacts = self.track.window(self.first, self.last)[0][:, self.thinned]
        touching, detected = torch.isfinite(contacts).all(dim=-1), torch.isfinite(value).all(dim=-1)
        value = torch.nan_to_num(value)
        anywhere = log_gaussian(value.square().sum(dim=-1), self.reach)
        near = log_gaussian((value - torch.nan_to_num(contacts)).square().sum(dim=-1), self.scale)
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
        location = torch.where(astray, self.reach * noise, contacts + self.scale * noise)
        return torch.where(detected[..., None], location, math.nan)

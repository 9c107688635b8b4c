"""The base of the likelihoods of a probe: a simulated track, and the stamps of one window."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.parameters import check_parameters, within
from bcppl.errors import InputError

S = TypeVar("S", float, Tensor)

WIDER = 10.0  # a contaminated normal's wide scale over its narrow one


class Track(Protocol):
    """One probe simulated for N particles, as `bcppl.contact.probe_rollout.ProbeRollout` is."""

    @property
    def diverged(self) -> Tensor:
        """(N,) particles whose simulation failed, up to the stamp that it has reached."""

    def __len__(self) -> int: ...

    def window(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Contacts (N, T, 3) in the peg's frame, NaN where none, and peg poses (N, T, 7), of some stamps."""

    def contact_normals(self, first: int, last: int) -> Tensor:
        """Unit normals (N, T, 3) of contact in the world, into the peg, NaN where there is none."""

    def wrench(self, first: int, last: int) -> Tensor:
        """Force (N) and torque (N m) on the peg (N, T, 6), in its frame about its origin, of some stamps."""


@dataclass(eq=False, repr=False)
class TrackDistribution(LazyDistribution):
    """A measurement at the stamps `first` to `last` of a probe, given its simulation for each particle.

    The event is (last - first, entries). Particles whose simulation diverged have log p = -inf.

    Args:
        track: the simulated probe.
        first, last: the first stamp, and the one after the last.

    Attributes:
        entries: the number of entries measured at a stamp.
        every: the stamps whose number is a multiple of this enter the density, since errors are correlated
            in time.
    """

    cost = 2
    entries = 0
    every = 1

    track: Track
    first: int = field(metadata=within(least=0, whole=True))
    last: int = field(metadata=within(least=0, whole=True))

    def __post_init__(self) -> None:
        check_parameters(self)
        if self.first >= self.last:
            raise InputError(
                f"{type(self).__name__} has first = {self.first} and last = {self.last}; "
                "give first before last."
            )
        super().__init__(len(self.track), (self.last - self.first, self.entries))

    @property
    def thinned(self) -> slice:
        """Which of the window's stamps enter the density."""
        return slice(-self.first % self.every, None, self.every)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of measurements (T, entries), or of one for each particle (N, T, entries)."""
        log_prob = self._log_prob(value.to(torch.float64)[..., self.thinned, :])
        return torch.where(self.track.diverged, -math.inf, log_prob)

    def _log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of the rows that enter the density, for simulations that did not diverge."""
        raise NotImplementedError


def log_gaussian(squared: Tensor, scale: float | Tensor) -> Tensor:
    """Log-density of an isotropic Gaussian in three dimensions at a squared distance."""
    width = torch.as_tensor(scale, dtype=torch.float64)
    return -0.5 * squared / width**2 - 3.0 * width.log() - 1.5 * math.log(2.0 * math.pi)


def contaminated(log_density: Callable[[S], Tensor], scale: S, outlier: float) -> Tensor:
    """Log-density of a mixture of a narrow scale and, with weight `outlier`, of one ten times as wide.

    The contaminated normal of Tukey, A survey of sampling from contaminated distributions, 1960.
    """
    narrow = log_density(scale) + math.log1p(-outlier)
    return torch.logaddexp(narrow, log_density(WIDER * scale) + math.log(outlier))

"""Likelihoods of where a finger first touches, and of its free motion up to there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.special import log_ndtr, ndtr

from bcppl.distributions.checks import Check
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.touch.outliers import touch_check
from bcppl.distributions.touch.path import Path
from bcppl.distributions.touch.placed import (
    LATENT_POSITIVE,
    OUTLIER,
    Distance,
    Placed,
    Scale,
    distance_along,
    distance_at,
)

# Farther than this (m) from the path is off it: paths are thinned and interpolated, to some micrometres.
OFF_PATH = 1e-3


def _lowest(distance: Distance | Placed, pose: Tensor, path: Path, travelled: Tensor) -> Tensor:
    """The least signed distance (N,) of the path's points before a distance travelled; inf for none.

    The distance travelled is () for all poses or (N,), one for each.
    """
    before = path.travelled < travelled[..., None]
    return torch.where(before, distance_along(distance, pose, path.points), torch.inf).amin(dim=-1)


def _travelled(path: Path, place: Tensor) -> Tensor:
    """The distance travelled, () or (N,), to a place of contact (3,) or (N, 3); inf for NaN."""
    touched = ~torch.isnan(place).any(dim=-1)
    inner = path.locate(torch.where(touched[..., None], place, path.points[0])).travelled
    return torch.where(touched, inner, torch.inf)


@dataclass(eq=False, repr=False)
class OnsetLocation(LazyDistribution):
    """The location on its path at which a finger first detects contact: (3,) in the world, NaN for never.

    Contact is detected once the signed distance of the tip falls below a threshold -offset + spread * e, e
    standard normal: a first passage. With probability `outlier` its location is uniform on the path. So the
    density at distance s along the path, whose signed distance is d(s), is

        (1 - outlier) N(d(s); -offset, spread) |d'(s)| [d(s) is the least so far] + outlier / length.

    The base measure is Lebesgue measure of the distance travelled (metres) on the inner path, plus a unit
    mass at its start (contact at once) and a unit mass at "never" (NaN); the total is one whatever the path.
    That the tip moved freely before the onset is part of the density. A location more than 1 mm off the path
    has probability zero.

    Args:
        distance: the signed distance to the part.
        pose: (N, 7) world_from_part.
        path: the tip's path in the world; also the points where d is evaluated.
        offset: metres; positive where the tip lies inside the part at onset, on average.
        spread: standard deviation of the threshold, metres.
        outlier: probability of an onset that is independent of the part.
    """

    distance: Distance | Placed
    pose: Tensor
    path: Path
    offset: Scale
    spread: Scale = field(metadata=LATENT_POSITIVE)
    outlier: float = field(metadata=OUTLIER)

    def __post_init__(self) -> None:
        super().__init__(len(self.pose), (3,))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) of one location (3,), or of one for each particle (N, 3)."""
        return self.log_density(value, self.offset, self.spread)

    def log_density(self, value: Tensor, offset: Scale, width: Scale) -> Tensor:
        """The same with an offset and a spread of the threshold, of which there may be several (S, N)."""
        touched, travelled, off, here, lowest, approach = self._passage(value)
        inlier, spread = math.log1p(-self.outlier), torch.as_tensor(width, dtype=torch.float64)
        score = (here + offset) / spread
        passage = -0.5 * score**2 - torch.log(spread) - 0.5 * math.log(2.0 * math.pi)
        passage = passage + torch.log(approach.clamp(min=0.0))
        passage = inlier + torch.where(here < lowest, passage, -torch.inf)
        stray = torch.tensor(self.outlier / self.path.length, dtype=torch.float64).log()
        density = torch.logaddexp(passage, stray)
        density = torch.where(travelled == 0.0, inlier + log_ndtr(-score), density)
        density = torch.where(off <= OFF_PATH, density, -torch.inf)
        return torch.where(touched, density, inlier + log_ndtr((lowest + offset) / spread))

    def tail(self, value: Tensor) -> Tensor:
        """The probability (N,), given no outlier, of an onset no likelier than this one, (3,) or (N, 3).

        Of a threshold farther from its mean; 0 for an onset that only an outlier explains.
        """
        return self.tail_of(value, self.offset, self.spread)

    def tail_of(self, value: Tensor, offset: Scale, width: Scale) -> Tensor:
        """The same with an offset and a spread of the threshold, of which there may be several (S, N)."""
        touched, travelled, _, here, lowest, approach = self._passage(value)
        score = (here + offset) / width
        passage = torch.where((here < lowest) & (approach > 0.0), 2.0 * ndtr(-score.abs()), 0.0)
        at_once = (2.0 * ndtr(-score)).clamp(max=1.0)
        never = (2.0 * ndtr((lowest + offset) / width)).clamp(max=1.0)
        return torch.where(touched, torch.where(travelled == 0.0, at_once, passage), never)

    def _passage(self, value: Tensor) -> tuple[Tensor, ...]:
        """Whether there is contact, its distance along and off the path, d there, the least so far, -d'."""
        # A location that all particles share keeps its shape, and is evaluated once.
        travelled = _travelled(self.path, value)
        touched = torch.isfinite(travelled)
        place = value if bool(touched.all()) else torch.where(touched[..., None], value, self.path.points[0])
        located = self.path.locate(place)
        here, normal = distance_at(self.distance, self.pose, place)
        lowest = _lowest(self.distance, self.pose, self.path, travelled)
        return touched, travelled, located.off, here, lowest, -(normal * located.direction).sum(dim=-1)

    def predictive_check(self, value: Tensor, replicas: Callable[[], Any]) -> Check:
        """The check of an observed onset against the threshold's normal and the share of outliers."""
        return touch_check(self.tail(value), self.outlier)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Locations of first contact (N, 3), interpolated between the path's points; NaN for never."""
        return self._sample(self.offset, self.spread)

    def _sample(self, offset: Scale, spread: Scale) -> Tensor:
        particles, path = len(self.pose), self.path
        threshold = -offset + spread * torch.randn(particles, dtype=torch.float64)
        distances = distance_along(self.distance, self.pose, path.points)
        below = distances <= threshold[:, None]
        first = below.to(torch.uint8).argmax(dim=-1, keepdim=True)
        after = distances.gather(-1, first)[:, 0]
        before = distances.gather(-1, (first - 1).clamp(min=0))[:, 0]
        share = torch.where(first[:, 0] > 0, (before - threshold) / (before - after), 1.0)
        start = path.travelled[(first[:, 0] - 1).clamp(min=0)]
        travelled = start + share * (path.travelled[first[:, 0]] - start)
        place = torch.where(below.any(dim=-1, keepdim=True), path.at(travelled), torch.nan)
        stray = torch.rand(particles, dtype=torch.float64) < self.outlier
        anywhere = path.at(path.length * torch.rand(particles, dtype=torch.float64))
        return torch.where(stray[:, None], anywhere, place)


@dataclass(eq=False, repr=False)
class FreePath(LazyDistribution):
    """Whether the finger moved freely up to the onset: 1 if it did, 0 if not.

    It did with probability Phi((d + tolerance) / spread), d the least signed distance of the path's points
    before the onset: a second, independent measurement beside `OnsetLocation`, whose density contains already
    that no contact was detected before. The base measure counts {0, 1}.

    Args:
        distance: the signed distance to the part.
        pose: (N, 7) world_from_part.
        path: the tip's path in the world.
        onset: (3,) or (N, 3) the place of contact; NaN for never: the whole path was free.
        tolerance: metres inside the part at which one path in two counts as free.
        spread: metres.
    """

    distance: Distance | Placed
    pose: Tensor
    path: Path
    onset: Tensor
    tolerance: Scale
    spread: Scale = field(metadata=LATENT_POSITIVE)

    def __post_init__(self) -> None:
        self.onset = self.onset.expand(len(self.pose), 3)
        super().__init__(len(self.pose), ())

    def _score(self) -> Tensor:
        travelled = _travelled(self.path, self.onset)
        return (_lowest(self.distance, self.pose, self.path, travelled) + self.tolerance) / self.spread

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of 1 (free) or 0, one () for all particles or one for each (N,)."""
        score = self._score()
        return torch.where(value.expand(len(self.pose)) > 0.5, log_ndtr(score), log_ndtr(-score))

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """1 or 0 for each particle, (N,)."""
        free = torch.rand(len(self.pose), dtype=torch.float64) < torch.special.ndtr(self._score())
        return free.to(torch.float64)

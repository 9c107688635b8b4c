"""A path in space, measured by the distance travelled along it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.errors import InputError

_THINNED = 5e-5  # m by which a thinned path is off the one that was measured, at most


class Located(NamedTuple):
    """The points of a path nearest to places (..., 3); metres."""

    travelled: Tensor  # (...,) distance along the path to the point
    direction: Tensor  # (..., 3) unit direction of travel there
    off: Tensor  # (...,) distance from the place to the point


class Path:
    """A polyline through points (R, 3) in the world, in order of time; metres.

    Attributes:
        points: (R, 3); points that repeat the one before are left out.
        travelled: (R,) distance along the path to each point, increasing from 0.

    Raises:
        InputError: fewer than two different points, or one that is not finite.
    """

    __caches__ = ("_last",)

    def __init__(self, points: Tensor) -> None:
        if not bool(torch.isfinite(points).all()):
            raise InputError("a finger's path has a point that is not finite; leave those rows out.")
        moved = torch.ones(len(points), dtype=torch.bool)
        moved[1:] = (points[1:] != points[:-1]).any(dim=-1)
        self.points = points[moved]
        if len(self.points) < 2:
            raise InputError("a finger's path has no length; give at least two different points.")
        self._steps = self.points.diff(dim=0)
        self._lengths = self._steps.norm(dim=-1)
        self.travelled = torch.cat([points.new_zeros(1), self._lengths.cumsum(0)])
        self._last: tuple[Tensor, Located] | None = None

    @property
    def length(self) -> float:
        """The length of the path, metres."""
        return float(self.travelled[-1])

    def thinned(self, spacing: float) -> Path:
        """The path through one of its points in every `spacing` metres travelled, and its last point."""
        spacing = number_within("a path is to be thinned to a spacing of {} m", spacing, above=0.0)
        stretch = torch.floor(self.travelled / spacing)
        kept = torch.ones(len(self.points), dtype=torch.bool)
        kept[1:-1] = stretch[1:-1] != stretch[:-2]
        return Path(self.points[kept])

    def locate(self, places: Tensor) -> Located:
        """The point of the path nearest to each of places (..., 3), the first of those that are as near."""
        if places.ndim > 1:
            return self._located(places)
        # Every site of every run of the program locates the same observed place.
        if self._last is None or not torch.equal(self._last[0], places):
            self._last = places.clone(), self._located(places)
        return self._last[1]

    def _located(self, places: Tensor) -> Located:
        from_start = places[..., None, :] - self.points[:-1]
        along = ((from_start * self._steps).sum(-1) / self._lengths**2).clamp(0.0, 1.0)
        off = (from_start - along[..., None] * self._steps).norm(dim=-1)
        # Of places that are as near, the first: a finger may come back the way that it has gone.
        ahead = torch.nn.functional.pad(off[..., 1:], (0, 1), value=torch.inf)
        near = (off <= off.amin(dim=-1, keepdim=True) + _THINNED) & (off <= ahead)
        nearest = near.to(torch.uint8).argmax(dim=-1)
        share = along.gather(-1, nearest[..., None])[..., 0]
        return Located(
            self.travelled[nearest] + share * self._lengths[nearest],
            self._steps[nearest] / self._lengths[nearest][..., None],
            off.gather(-1, nearest[..., None])[..., 0],
        )

    def at(self, travelled: Tensor) -> Tensor:
        """The points (..., 3) at distances (...,) along the path, metres; its ends beyond them."""
        inside = travelled.clamp(0.0, self.length)
        k = (torch.searchsorted(self.travelled, inside.contiguous(), right=True) - 1).clamp(
            0, len(self._lengths) - 1
        )
        share = (inside - self.travelled[k]) / self._lengths[k]
        return self.points[k] + share[..., None] * self._steps[k]

    def heading(self, travelled: Tensor, reach: float) -> Tensor:
        """Unit directions (..., 3) of travel about distances (...,) along the path: a chord of 2 `reach`."""
        chord = self.at(travelled + reach) - self.at(travelled - reach)
        return chord / chord.norm(dim=-1, keepdim=True)

"""A normal over poses truncated to a box of translations."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.special import log_ndtr, ndtr, ndtri

from bcppl import poses
from bcppl.distributions.poses.base import PoseDistribution
from bcppl.distributions.poses.normal import NormalPose

_LEAST = 1e-300
_FARTHEST = 30.0  # standard deviations: beyond, the remaining mass of a tail is rounding


class BoxedNormal(PoseDistribution):
    """A normal over poses (`NormalPose`, all axes free), its translation drawn within a box, axis by axis.

    Each coordinate is drawn from its conditional given those before, truncated to the box: the simulator of
    Geweke, Hajivassiliou and Keane (Geweke, Efficient simulation from the multivariate normal and Student-t
    distributions subject to linear constraints, 1991). Its density is that of the normal over the product of
    the probabilities of those intervals, and known exactly. It approximates the normal conditioned on the
    box, and is a proposal for it.

    Args:
        center: (N, 7).
        covariance: (N, 6, 6) or (6, 6).
        low: (3,) the box's least corner, in the world, metres.
        high: (3,) its largest.
    """

    def __init__(self, center: Tensor, covariance: Tensor, low: Tensor, high: Tensor) -> None:
        self.low, self.high, self.normal = low, high, NormalPose(center, covariance)
        super().__init__(center, self.normal.freedom)

    @property
    def covariance(self) -> Tensor:
        """Covariance of the normal before truncation, (N, 6, 6) or (6, 6)."""
        return self.normal.covariance

    def expand(self, batch_shape: Any, _instance: Any = None) -> BoxedNormal:
        """The same distribution for a batch of draws, one for each particle of a plate."""
        if torch.Size(batch_shape) == self.batch_shape:
            return self
        covariance = self.covariance.expand(*batch_shape, 6, 6)
        return BoxedNormal(self.center.expand(*batch_shape, 7), covariance, self.low, self.high)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (N, 7); only the empty sample_shape is supported."""
        scale = torch.linalg.cholesky(self.covariance).expand(*self.batch_shape, 6, 6)
        score = torch.randn(*self.batch_shape, 6, dtype=torch.float64)
        uniform = torch.rand(*self.batch_shape, 3, dtype=torch.float64)
        for axis in range(3):
            first, last, flip = self._interval(scale, score, axis)
            share = ndtr(first) + uniform[..., axis] * (ndtr(last) - ndtr(first))
            drawn = ndtri(share.clamp(min=_LEAST)).clamp(first, last)
            score[..., axis] = torch.where(flip, -drawn, drawn)
        return poses.retract(self.center, (scale @ score[..., None])[..., 0])

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) with respect to Lebesgue times Haar; -inf outside the box."""
        scale = torch.linalg.cholesky(self.covariance).expand(*value.shape[:-1], 6, 6)
        tangent = poses.local(self.center, value)
        score = torch.linalg.solve_triangular(scale, tangent[..., None], upper=False)[..., 0]
        density = self.normal.log_prob(value)
        for axis in range(3):
            first, last, _ = self._interval(scale, score, axis)
            upper, lower = log_ndtr(last), log_ndtr(first)
            density = density - (upper + torch.log1p(-torch.exp(lower - upper)))
        inside = (value[..., :3] >= self.low) & (value[..., :3] <= self.high)
        return torch.where(inside.all(dim=-1), density, -torch.inf)

    def _interval(self, scale: Tensor, score: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor]:
        """The standardised interval of an axis within the box, given the axes before it.

        Returns:
            Its lower and upper end (N,), and whether they are mirrored, as in a right tail: there the
            distribution function would round to 1.
        """
        middle = self.center[..., axis] + (scale[..., axis, :axis] * score[..., :axis]).sum(dim=-1)
        first = (self.low[axis] - middle) / scale[..., axis, axis]
        last = (self.high[axis] - middle) / scale[..., axis, axis]
        flip = first > 0.0
        first, last = torch.where(flip, -last, first), torch.where(flip, -first, last)
        return first.clamp(min=-_FARTHEST), torch.maximum(last, first.clamp(min=-_FARTHEST) + 1e-9), flip

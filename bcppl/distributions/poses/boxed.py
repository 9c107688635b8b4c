"""A normal over poses truncated to a box of translations, or times a density with steps."""

from __future__ import annotations

from typing import Any

import torch
from scipy.special import ndtri_exp
from torch import Tensor
from torch.special import log_ndtr

from bcppl import poses
from bcppl.devices import numbers, on_device_of
from bcppl.distributions.poses.base import PoseDistribution
from bcppl.distributions.poses.normal import NormalPose


class BoxedNormal(PoseDistribution):
    """A normal over poses (`NormalPose`, all axes free), its translation drawn within a box, axis by axis.

    Each coordinate is drawn from its conditional given those before, truncated to the box: the simulator of
    Geweke, Hajivassiliou and Keane (Geweke, Efficient simulation from the multivariate normal and Student-t
    distributions subject to linear constraints, 1991). Its density is that of the normal over the product of
    the probabilities of those intervals, and known exactly. It approximates the normal conditioned on the
    box, and is a proposal for it. Likewise the product of the normal with a density that is constant over
    several intervals of each coordinate, such as a box with tails.

    Args:
        center: (N, 7).
        covariance: (N, 6, 6) or (6, 6).
        limits: (K + 1, 3) the ends of each coordinate's K intervals, ascending, in the world, metres.
        log_steps: (K,) the log-density of each interval, but for a constant; by default all are the same.
    """

    def __init__(
        self, center: Tensor, covariance: Tensor, limits: Tensor, log_steps: Tensor | None = None
    ) -> None:
        self.limits, self.normal = limits, NormalPose(center, covariance)
        self.log_steps = limits.new_zeros(len(limits) - 1) if log_steps is None else log_steps
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
        return BoxedNormal(self.center.expand(*batch_shape, 7), covariance, self.limits, self.log_steps)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Poses (N, 7); only the empty sample_shape is supported."""
        scale = torch.linalg.cholesky(self.covariance).expand(*self.batch_shape, 6, 6)
        score = torch.randn(*self.batch_shape, 6, dtype=torch.float64)
        uniform = torch.rand(*self.batch_shape, 3, dtype=torch.float64)
        for axis in range(3):
            first, last, flip, log_mass = self._intervals(scale, score, axis)
            mass = log_mass.softmax(dim=-1)
            before = mass.cumsum(dim=-1) - mass
            here = uniform[..., axis, None]
            own = (before <= here).sum(dim=-1, keepdim=True) - 1
            within = ((here - before.gather(-1, own)) / mass.gather(-1, own)).clamp(0.0, 1.0)
            first, last, flip = (each.gather(-1, own) for each in (first, last, flip))
            # The quantile is counted from the left end, which is the last where the interval is mirrored. Its
            # distribution function is 0 by rounding beyond eight standard deviations, its logarithm is not.
            below, beyond = log_ndtr(first) + torch.log1p(-within), log_ndtr(last) + within.log()
            quantile = ndtri_exp(numbers(torch.logaddexp(below, beyond).detach()))
            drawn = on_device_of(quantile, first).clamp(first, last)
            score[..., axis] = torch.where(flip, -drawn, drawn)[..., 0]
        pose = poses.retract(self.center, (scale @ score[..., None])[..., 0])
        # At an end of the box the sum of centre and deviation may round to outside.
        pose[..., :3] = pose[..., :3].clamp(self.limits[0], self.limits[-1])
        return pose

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) with respect to Lebesgue times Haar; -inf outside the box."""
        scale = torch.linalg.cholesky(self.covariance).expand(*value.shape[:-1], 6, 6)
        tangent = poses.local(self.center, value)
        score = torch.linalg.solve_triangular(scale, tangent[..., None], upper=False)[..., 0]
        density = self.normal.log_prob(value)
        for axis in range(3):
            density = density - self._intervals(scale, score, axis)[3].logsumexp(dim=-1)
        place = (value[..., None, :3] > self.limits[1:-1]).sum(dim=-2)
        density = density + self.log_steps[place].sum(dim=-1)
        inside = (value[..., :3] >= self.limits[0]) & (value[..., :3] <= self.limits[-1])
        return torch.where(inside.all(dim=-1), density, -torch.inf)

    def _intervals(self, scale: Tensor, score: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The standardised intervals of an axis, given the axes before it.

        Returns:
            Their lower and upper ends (N, K), whether they are mirrored, as in a right tail, where the
            distribution function would round to 1, and the log of each one's mass times its density.
        """
        middle = self.center[..., axis] + (scale[..., axis, :axis] * score[..., :axis]).sum(dim=-1)
        ends = (self.limits[:, axis] - middle[..., None]) / scale[..., axis, axis, None]
        first, last = ends[..., :-1], ends[..., 1:]
        flip = first > 0.0
        first, last = torch.where(flip, -last, first), torch.where(flip, -first, last)
        return first, last, flip, log_mass(first, last) + self.log_steps


def log_mass(first: Tensor, last: Tensor) -> Tensor:
    """The log-probability that a standard normal lies in an interval, which is not far in the right tail."""
    upper, lower = log_ndtr(last), log_ndtr(first)
    return upper + torch.log1p(-torch.exp(lower - upper))

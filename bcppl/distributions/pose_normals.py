"""Normals over poses as proposals need them: widened, multiplied, kept within a prior, as wide as one."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.boxed import BoxedNormal
from bcppl.distributions.mixture import MixturePose
from bcppl.distributions.poses import NormalPose

# How proposals are widened, in deviations, and how often.
WIDTHS = torch.tensor([1.1, 3.0], dtype=torch.float64)
SHARES = torch.tensor([0.85, 0.15], dtype=torch.float64)


class Modes(NamedTuple):
    """A mixture of M normals: centres (..., M, 7), covariances (..., M, 6, 6), log-weights (..., M)."""

    centers: Tensor
    covariances: Tensor
    log_weights: Tensor

    def own(self, pose: Tensor) -> Tensor:
        """Of which of M normals poses (N, 7) most likely are: (N,) int64."""
        if len(self.centers) == 1:
            return torch.zeros(len(pose), dtype=torch.int64)
        said = NormalPose(self.centers, self.covariances).log_prob(pose[:, None])
        return (self.log_weights + said).argmax(dim=1)


def widened(center: Tensor, covariance: Tensor) -> MixturePose:
    """A normal with centres (N, 7) and covariances (N, 6, 6), and a share of it wider."""
    alone = torch.zeros(1, dtype=torch.float64)
    return widened_modes(Modes(center[..., None, :], covariance[..., None, :, :], alone))


def widened_modes(modes: Modes) -> MixturePose:
    """A mixture of M normals for each of N, (N, M, 7) and so on, and a share of each wider."""
    centers, wide = modes.centers, WIDTHS[:, None, None] ** 2 * modes.covariances[..., None, :, :]
    log_weights = modes.log_weights.log_softmax(dim=-1)[..., None] + SHARES.log()
    return MixturePose(
        log_weights.flatten(-2),
        centers[..., None, :].expand(*centers.shape[:-1], len(WIDTHS), 7).flatten(-3, -2),
        wide.flatten(-4, -3),
    )


def matched(modes: MixturePose) -> NormalPose:
    """The normal with the mean and the covariance of what `widened_modes` gives, but for the wider shares."""
    every = len(WIDTHS)
    chances = modes.log_weights[..., ::every].softmax(dim=-1)
    centers = modes.components.center[..., ::every, :]
    covariances = modes.components.covariance[..., ::every, :, :]
    away = poses.local(centers[..., :1, :], centers)
    mean = (chances[..., None] * away).sum(dim=-2)
    off = away - mean[..., None, :]
    covariance = covariances + off[..., :, None] * off[..., None, :]
    return NormalPose(
        poses.retract(centers[..., 0, :], mean), (chances[..., None, None] * covariance).sum(dim=-3)
    )


def within(prior: Any, normal: NormalPose) -> NormalPose | BoxedNormal:
    """A normal (N,) cut off where a prior's box ends: near its border few draws would lie within."""
    if not bool((prior.widths > 0.0).all()):
        return normal
    low, high = prior.center[:3] - prior.widths, prior.center[:3] + prior.widths
    return BoxedNormal(normal.center, normal.covariance, low, high)


def product(first: NormalPose, second: NormalPose) -> NormalPose:
    """The normal that is like the product of two."""
    own, other = torch.linalg.inv(first.covariance), torch.linalg.inv(second.covariance)
    covariance = torch.linalg.inv(own + other)
    away = poses.local(first.center, second.center)
    center = poses.retract(first.center, (covariance @ other @ away[..., None])[..., 0])
    return NormalPose(center, 0.5 * (covariance + covariance.transpose(-1, -2)))


def transport(first: Tensor, second: Tensor) -> Tensor:
    """The symmetric matrix (d, d) that carries a normal with one covariance to another by the shortest ways.

    Points (..., d) about the mean are multiplied by it. Gaussian optimal transport: Olkin and Pukelsheim, The
    distance between two random vectors with given dispersion matrices, Linear Algebra and its Applications
    48, 1982.
    """
    root = _root(first)
    back = torch.linalg.inv(root)
    return back @ _root(root @ second @ root) @ back


def _root(matrix: Tensor) -> Tensor:
    """The symmetric root of a symmetric positive matrix."""
    values, vectors = torch.linalg.eigh(0.5 * (matrix + matrix.T))
    return vectors @ torch.diag(values.clamp(min=0.0).sqrt()) @ vectors.T


def normal_like(prior: Any) -> NormalPose:
    """A normal with about the spread of a prior that is uniform within limits."""
    angle = getattr(prior, "angle", None)
    turns = [angle] * 3 if angle is not None else [prior.tilt, prior.tilt, prior.yaw]
    widths = torch.cat([torch.as_tensor(prior.widths), torch.tensor(turns, dtype=torch.float64)])
    return NormalPose(prior.center, 0.6 * widths.clamp(min=1e-4))


def allowed(prior: Any, there: Tensor) -> Tensor:
    """Whether a prior allows poses (M, 7), or would if its limits were a third wider."""
    inwards = poses.retract(prior.center, 0.75 * poses.local(prior.center, there))
    return prior.log_prob(inwards) > -torch.inf

"""What the hypotheses of a probe's episodes say of the errors that all touches share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from bcppl.distributions.episodes.filter.branches import OF_CONTACT, Branches
from bcppl.distributions.episodes.linear_errors import LinearErrors


def drawn(branches: Branches, draws: int) -> Tensor:
    """Parameters (N, draws, M) that all touches share from their posterior, the same at each call."""
    generator = torch.Generator().manual_seed(0)
    weights = torch.from_numpy(branches.weights)
    which = torch.multinomial(weights, draws, replacement=True, generator=generator)
    particle = torch.arange(len(weights))[:, None]
    shared = slice(0, -OF_CONTACT)
    mean = torch.from_numpy(branches.mean[..., shared])[particle, which]
    covariance = torch.from_numpy(branches.covariance[..., shared, shared])[particle, which]
    variances, axes = torch.linalg.eigh(covariance)
    standard = torch.randn(*mean.shape, 1, generator=generator, dtype=torch.float64)
    # The symmetric root: that of the axes alone would depend on their signs, which are those of rounding.
    root = (axes * variances.clamp(min=0.0).sqrt()[..., None, :]) @ axes.transpose(-1, -2)
    return mean + (root @ standard)[..., 0]


def moments(branches: Branches) -> tuple[Tensor, Tensor]:
    """Mean (N, M) and covariance (N, M, M) of the parameters that all touches share."""
    shared = slice(0, -OF_CONTACT)
    weights, means = torch.from_numpy(branches.weights)[:, None], torch.from_numpy(branches.mean[..., shared])
    covariances = torch.from_numpy(branches.covariance[..., shared, shared])
    mean = weights @ means  # (N, 1, M)
    away = weights.transpose(1, 2).sqrt() * (means - mean)
    within = (weights @ covariances.flatten(2)).view_as(covariances[:, 0])
    return mean[:, 0], within + away.transpose(1, 2) @ away


def probable_jumps(
    branches: Branches, bench: LinearErrors, times: Sequence[float]
) -> list[tuple[str, float, Tensor]]:
    """The jumps that any hypothesis holds, by name and time, in their order, with their probabilities (N,).

    Args:
        branches: after E episodes.
        bench: whose jumps they are.
        times: (E,) of the episodes' first rows, s.
    """
    weights, held = branches.weights[..., None], []
    for number, jump in enumerate(bench.jumps):
        among = [number in change.jumps for change in bench.changes]
        jumped = np.array(among)[branches.event // 2]
        probability = torch.from_numpy((weights * jumped).sum(axis=1))
        each = probability.any(dim=0).nonzero()[:, 0].tolist()
        held += [(jump.name, times[k], probability[:, k]) for k in each]
    return sorted(held, key=lambda jump: jump[1])

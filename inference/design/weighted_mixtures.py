"""Gaussian mixtures fitted to the same points under many sets of weights, and their entropies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.beliefs import effective_sample_size
from bcppl.beliefs.entropy import cholesky
from bcppl.errors import InputError

# Of an even share of the weight: lighter particles link no modes and are left out. Together they have less
# than a thousandth of the weight.
NEGLIGIBLE = 1e-3


@dataclass(frozen=True, eq=False)
class WeightedMixtures:
    """Distinct points, and which of them are neighbours."""

    coordinates: Tensor  # (K, d) of each point about the mean of its mode in the belief
    log_base: Tensor  # (K,) log-density of the base measure there
    floor: Tensor  # (d, d) the covariance of a mode that consists of a single particle
    linked: Tensor | None  # (K, K) float32, 1 where two points are neighbours; None where all are

    @classmethod
    def fit(
        cls,
        address: str,
        coordinates: Tensor,
        log_base: Tensor,
        weights: Tensor,
        label: Tensor,
        linked: Tensor | None,
    ) -> WeightedMixtures:
        """Of points whose belief has weights (K,) and modes that are labelled (K,) from 0."""
        dimension = coordinates.shape[1]
        modes = int(label.max()) + 1
        mass = torch.zeros(modes, dtype=torch.float64).index_add_(0, label, weights)
        mean = torch.zeros(modes, dimension, dtype=torch.float64)
        mean = mean.index_add_(0, label, weights[:, None] * coordinates) / mass[:, None]
        coordinates = coordinates - mean[label]
        within = (weights[:, None] * coordinates).T @ coordinates
        cholesky_factor(address, within)
        floor = within * effective_sample_size(weights.log()) ** (-2.0 / dimension)
        if linked is None or bool(linked.all()):
            return cls(coordinates, log_base, floor, None)
        return cls(coordinates, log_base, floor, linked.to(torch.float32))

    def entropy(self, weights: Tensor) -> Tensor:
        """Entropies (M,) in nats with respect to the base measure, under weights (M, K).

        The entropy of the masses plus the mean entropy of the Gaussians (Huber et al., On entropy
        approximation for Gaussian mixture random vectors, MFI 2008, eq. 8): exact where they do not overlap.
        """
        count, dimension = self.coordinates.shape
        kept = torch.where(weights > NEGLIGIBLE / count, weights, 0.0)
        kept = kept / kept.sum(dim=1, keepdim=True)
        rows, each = self._modes(kept)
        mass = each.sum(dim=1)
        share = each / mass[:, None]
        mean = share @ self.coordinates
        squares = (self.coordinates[:, :, None] * self.coordinates[:, None, :]).reshape(count, -1)
        covariance = (share @ squares).reshape(-1, dimension, dimension)
        covariance = covariance - mean[:, :, None] * mean[:, None, :]
        alone = share.square().sum(dim=1)  # 1 / effective sample size
        # Axes are metres and radians: scaled, the determinant is of numbers about 1.
        scale = self.floor.diagonal().sqrt()
        scaled = (covariance + alone[:, None, None] * self.floor) / torch.outer(scale, scale)
        determinant = torch.linalg.slogdet(scaled).logabsdet + 2.0 * scale.log().sum()
        gaussian = 0.5 * (dimension * math.log(2.0 * math.pi * math.e) + determinant) + share @ self.log_base
        terms = mass * gaussian + torch.special.entr(mass)
        return torch.zeros(len(weights), dtype=torch.float64).index_add_(0, rows, terms)

    def _modes(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Weights (Q, K) within each mode of every row of weights (M, K), and the row (Q,) of each mode."""
        if self.linked is None:
            return torch.arange(len(weights)), weights
        rows, modes = [], []
        remaining = weights > 0
        # The heaviest remaining point, and all points that chains of links lead to, are a mode of their row.
        while bool((unfinished := remaining.any(dim=1)).any()):
            row = unfinished.nonzero().flatten()
            among, own = remaining[row], weights[row]
            start = torch.where(among, own, -1.0).argmax(dim=1, keepdim=True)
            mode = self._connected(torch.zeros_like(among).scatter_(1, start, True), among)
            rows.append(row)
            modes.append(torch.where(mode, own, 0.0))
            remaining[row] = among & ~mode
        return torch.cat(rows), torch.cat(modes)

    def _connected(self, start: Tensor, among: Tensor) -> Tensor:
        """The points (M, K) that links through `among` (M, K) connect to those in `start` (M, K)."""
        assert self.linked is not None
        reached, count = start, -1
        while count != (count := int(reached.sum())):
            reached = reached | (among & (reached.to(torch.float32) @ self.linked > 0.0))
        return reached


def cholesky_factor(address: str, covariance: Tensor) -> Tensor:
    """The lower Cholesky factor of a covariance (d, d) of particles; InputError where it is singular."""
    if (factor := cholesky(covariance)) is not None:
        return factor
    raise InputError(
        f"the particles at {address!r} do not span its {len(covariance)} free axes within their modes, so "
        "they have no density; use more particles, move them apart (rejuvenation), or use weight_entropy()."
    )

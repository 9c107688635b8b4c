"""Gaussian mixtures fitted to many reweighings of the same points, and their entropies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.beliefs import effective_sample_size
from bcppl.errors import InputError

# Of an even share of the weight: particles below it link no modes and are left out. Together they have less
# than a thousandth.
NEGLIGIBLE = 1e-3


@dataclass(frozen=True, eq=False)
class Mixtures:
    """Distinct points and what links them.

    Attributes:
        coordinates: (K, d) of each point about the mean of its mode in the belief.
        log_base: (K,) log of the base measure's density there.
        floor: (d, d) the covariance that a single particle stands for.
        linked: (K, K) float32, 1 where two points are neighbours; None where all are.
    """

    coordinates: Tensor
    log_base: Tensor
    floor: Tensor
    linked: Tensor | None

    @classmethod
    def fitted(
        cls,
        address: str,
        coordinates: Tensor,
        log_base: Tensor,
        weights: Tensor,
        label: Tensor,
        linked: Tensor | None,
    ) -> Mixtures:
        """The mixtures of points whose belief has weights (K,), and whose modes are labelled (K,) from 0.

        Raises:
            InputError: the points do not span the axes within the modes.
        """
        dimension = coordinates.shape[1]
        modes = int(label.max()) + 1
        mass = torch.zeros(modes, dtype=torch.float64).index_add_(0, label, weights)
        mean = torch.zeros(modes, dimension, dtype=torch.float64)
        mean = mean.index_add_(0, label, weights[:, None] * coordinates) / mass[:, None]
        coordinates = coordinates - mean[label]
        within = (weights[:, None] * coordinates).T @ coordinates
        spanning_factor(address, within)
        floor = within * effective_sample_size(weights.log()) ** (-2.0 / dimension)
        if linked is None or bool(linked.all()):
            return cls(coordinates, log_base, floor, None)
        return cls(coordinates, log_base, floor, linked.to(torch.float32))

    def entropy(self, weights: Tensor) -> Tensor:
        """Entropies (M,) in nats against the base measure, under weights (M, K).

        The entropy of the masses plus the mean entropy of the Gaussians (Huber et al., On entropy
        approximation for Gaussian mixture random vectors, MFI 2008, eq. 8): exact where they do not overlap.
        """
        count, dimension = self.coordinates.shape
        kept = torch.where(weights > NEGLIGIBLE / count, weights, 0.0)
        kept = kept / kept.sum(dim=1, keepdim=True)
        rows, each = self._parted(kept)
        mass = each.sum(dim=1)
        share = each / mass[:, None]
        mean = share @ self.coordinates
        squares = (self.coordinates[:, :, None] * self.coordinates[:, None, :]).reshape(count, -1)
        covariance = (share @ squares).reshape(-1, dimension, dimension)
        covariance = covariance - mean[:, :, None] * mean[:, None, :]
        alone = share.square().sum(dim=1)  # 1 / effective sample size
        # Scaled to numbers about 1: axes are metres and radians.
        scale = self.floor.diagonal().sqrt()
        scaled = (covariance + alone[:, None, None] * self.floor) / torch.outer(scale, scale)
        determinant = torch.linalg.slogdet(scaled).logabsdet + 2.0 * scale.log().sum()
        gaussian = 0.5 * (dimension * math.log(2.0 * math.pi * math.e) + determinant) + share @ self.log_base
        parts = mass * gaussian + torch.special.entr(mass)
        return torch.zeros(len(weights), dtype=torch.float64).index_add_(0, rows, parts)

    def _parted(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Weights (Q, K) of the modes of every row of weights (M, K), and which row each is of (Q,)."""
        if self.linked is None:
            return torch.arange(len(weights)), weights
        rows, parts = [], []
        left = weights > 0
        # The heaviest point that is left, and all that chains of links lead to, are a mode of their row.
        while bool((unfinished := left.any(dim=1)).any()):
            row = unfinished.nonzero().flatten()
            among, own = left[row], weights[row]
            start = torch.where(among, own, -1.0).argmax(dim=1, keepdim=True)
            mode = self._reached(torch.zeros_like(among).scatter_(1, start, True), among)
            rows.append(row)
            parts.append(torch.where(mode, own, 0.0))
            left[row] = among & ~mode
        return torch.cat(rows), torch.cat(parts)

    def _reached(self, start: Tensor, among: Tensor) -> Tensor:
        """The points (M, K) that links lead to from those where `start` (M, K) is true, through `among`."""
        assert self.linked is not None
        reached, count = start, -1
        while count != (count := int(reached.sum())):
            reached = reached | (among & (reached.to(torch.float32) @ self.linked > 0.0))
        return reached


def spanning_factor(address: str, covariance: Tensor) -> Tensor:
    """The lower factor of a covariance (d, d).

    Raises:
        InputError: it is singular.
    """
    scale = covariance.diagonal().clamp_min(0.0).sqrt()
    # A picometre is rounding.
    if bool((scale > 1e-12).all()):
        correlation = covariance / torch.outer(scale, scale)
        if float(torch.linalg.eigvalsh(correlation)[0]) > 1e-10:
            return scale[:, None] * torch.linalg.cholesky(correlation)
    raise InputError(
        f"the particles at {address!r} do not span its {len(covariance)} free axes within their modes, so "
        "they have no density; use more particles, move them apart (rejuvenation), or use weight_entropy()."
    )

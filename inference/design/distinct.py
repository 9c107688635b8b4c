"""Particles whose copies are merged, and the modes that they form."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from bcppl.arguments import number_within
from bcppl.beliefs.modes import cluster, nearest
from bcppl.beliefs.weights import distinct_poses
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.summaries import COLLAPSED, is_pose, values_at

# The gap between modes is at least so many times the median distance of particles to their nearest neighbour.
SPARSE = 3.0


@dataclass(frozen=True, eq=False)
class DistinctParticles:
    """The distinct values at an address, of the particles with weight."""

    values: Tensor  # (K, 7) poses, or (K, d) values of another site
    weights: Tensor  # (K,) normalised; those of copies are summed
    particles: Tensor  # (P,) int64 the particles with weight
    index: Tensor  # (P,) int64 the distinct value that each of them has
    is_pose: bool  # whether the values are poses

    @classmethod
    def of(cls, population: Population, address: str) -> DistinctParticles:
        """Those of a population; InputError where all particles with weight have the same value."""
        weights = torch.softmax(population.log_weights, 0)
        particles = (weights > 0).nonzero().flatten()
        values, pose = values_at(population, address)[particles], is_pose(population, address)
        if pose:
            values, index = distinct_poses(values)
        else:
            rows = values.to(torch.float64).reshape(len(values), -1)
            values, index = torch.unique(rows, dim=0, return_inverse=True)
        if len(values) < 2:
            raise InputError(f"the belief over {address!r} {COLLAPSED}")
        total = torch.zeros(len(values), dtype=torch.float64).index_add_(0, index, weights[particles])
        return cls(values, total, particles, index, pose)

    def __len__(self) -> int:
        return len(self.values)

    def merge(self, weights: Tensor) -> Tensor:
        """Weights (M, K) of the distinct values, given weights (M, N) of the population's particles."""
        total = torch.zeros(len(weights), len(self), dtype=torch.float64)
        return total.index_add_(1, self.index, weights.index_select(1, self.particles))


def separate_modes(
    distinct: Tensor, translation: float, rotation: float, symmetries: Tensor | None = None
) -> tuple[Tensor, tuple[float, float]]:
    """The mode (K,) int64 of each of distinct poses (K, 7), and the gap between modes (m, rad) in use."""
    number_within("modes are to be separated by {} m", translation, above=0.0)
    number_within("modes are to be separated by {} rad", rotation, above=0.0)
    # A wide belief with few particles has no neighbours within the gap, and that makes no modes of them.
    sparse = SPARSE * float(nearest(distinct, translation, rotation, symmetries).median())
    gap = (max(1.0, sparse) * translation, max(1.0, sparse) * rotation)
    return cluster(distinct, *gap, symmetries), gap

"""Modes: clusters of the particles of a multimodal belief."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.errors import InputError

# Pairs of particles are one matrix: this many take 0.8 GB.
MOST = 10_000
EXACT = "donot_use_mm_for_euclid_dist"


def cluster(
    world_from_part: Tensor, translation: float, rotation: float, symmetries: Tensor | None = None
) -> Tensor:
    """The cluster of each pose, int64 (N,) from 0, by single linkage.

    Two poses are linked where (metres apart / translation)^2 + (angle between / rotation)^2 <= 1, and are in
    one cluster where a chain of links joins them (Gower and Ross, Minimum spanning trees and single linkage
    cluster analysis, Applied Statistics 18, 1969). Memory grows with N^2.

    Args:
        world_from_part: (N, 7).
        translation: the gap between clusters, metres.
        rotation: the gap between clusters, radians.
        symmetries: (K, 7) `part_from_part`, a group that leaves the part invariant: poses that differ by one
            are equivalent. None: the identity alone.

    Raises:
        InputError: a scale is not positive, or there are too many poses.
    """
    linked = links(world_from_part, translation, rotation, symmetries)
    _, label = connected_components(linked.numpy(), directed=False)
    return torch.from_numpy(np.asarray(label, dtype=np.int64))


def links(
    world_from_part: Tensor, translation: float, rotation: float, symmetries: Tensor | None = None
) -> Tensor:
    """The pairs of poses that `cluster` links, bool (N, N), with its arguments and errors."""
    translation = number_within("modes are to be {} m apart", translation, above=0.0)
    rotation = number_within("modes are to be {} rad apart", rotation, above=0.0)
    if len(world_from_part) > MOST:
        raise InputError(
            f"modes are given {len(world_from_part)} distinct particles; resample to {MOST} or fewer."
        )
    linked = torch.zeros(len(world_from_part), len(world_from_part), dtype=torch.bool)
    for copy in _copies(world_from_part, symmetries).unbind(dim=1):
        linked |= _separation(world_from_part, copy, translation, rotation) <= 1.0
    return linked


def nearest(
    world_from_part: Tensor, translation: float, rotation: float, symmetries: Tensor | None = None
) -> Tensor:
    """The distance (N,) of each pose from the nearest other one, in units of the gap between clusters."""
    squared = torch.full((len(world_from_part),), torch.inf, dtype=torch.float64)
    for copy in _copies(world_from_part, symmetries).unbind(dim=1):
        apart = _separation(world_from_part, copy, translation, rotation)
        squared = torch.minimum(squared, apart.fill_diagonal_(torch.inf).amin(dim=1))
    return squared.sqrt()


def gathered(
    world_from_part: Tensor, reference: Tensor, translation: float, rotation: float, symmetries: Tensor
) -> Tensor:
    """Each pose (N, 7) replaced by its symmetric copy nearest to a reference (7,)."""
    copies = _copies(world_from_part, symmetries)
    apart = _separation(reference[None], copies.reshape(-1, 7), translation, rotation)
    nearest = apart.reshape(copies.shape[:2]).argmin(dim=1)
    return copies[torch.arange(len(copies)), nearest]


def _copies(world_from_part: Tensor, symmetries: Tensor | None) -> Tensor:
    """The poses (N, 7) and their equivalents under the symmetries (K, 7), (N, 1 + K, 7)."""
    if symmetries is None:
        return world_from_part[:, None]
    others = poses.compose(world_from_part[:, None], poses.as_pose(symmetries, "a symmetry"))
    return torch.cat([world_from_part[:, None], others], dim=1)


def _separation(first: Tensor, second: Tensor, translation: float, rotation: float) -> Tensor:
    """Squared scaled distances (N, M) between poses (N, 7) and (M, 7)."""
    # The chord between quaternions, to the nearer of q and -q: the arc cosine loses small angles to rounding.
    chord = torch.minimum(
        *(torch.cdist(first[:, 3:], sign * second[:, 3:], compute_mode=EXACT) for sign in (1, -1))
    )
    angle = 4.0 * torch.asin((0.5 * chord).clamp_max(math.sqrt(0.5)))
    apart = torch.cdist(first[:, :3], second[:, :3], compute_mode=EXACT)
    return (apart / translation) ** 2 + (angle / rotation) ** 2

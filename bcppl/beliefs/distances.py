"""ADD and ADD-S: mean distances of a part's points at a pose from those at the true pose."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from bcppl import poses


def average_distance(
    world_from_part: Tensor, points: np.ndarray | Tensor, truth: np.ndarray | Tensor
) -> Tensor:
    """ADD (...) of poses (..., 7) against a true pose (7,) over model points (M, 3), metres."""
    points, truth = torch.as_tensor(points, dtype=torch.float64), poses.as_pose(truth, "the true pose")
    there = poses.transform(truth, points)
    return (poses.transform(world_from_part, points) - there).norm(dim=-1).mean(dim=-1)


def average_nearest_distance(
    world_from_part: Tensor, points: np.ndarray | Tensor, truth: np.ndarray | Tensor
) -> Tensor:
    """ADD-S (...) of poses (..., 7): as ADD, but from each true point to the nearest at the pose, metres.

    Source: Hinterstoisser et al., ACCV 2012, eq. 4, for symmetric parts.
    """
    points, truth = torch.as_tensor(points, dtype=torch.float64), poses.as_pose(truth, "the true pose")
    there = poses.transform(truth, points).numpy()
    moved = poses.transform(world_from_part.reshape(-1, 7), points).numpy()
    each = [float(np.mean(cKDTree(particle).query(there)[0])) for particle in moved]
    return torch.tensor(each, dtype=torch.float64).reshape(world_from_part.shape[:-1])

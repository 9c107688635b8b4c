"""Beliefs: weighted particles read as a posterior over a part's pose."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses
from bcppl.errors import InferenceError
from bcppl.poses import FREE, Freedom


def normalised(log_weights: Tensor) -> Tensor:
    """Weights (N,) that sum to 1, from log weights (N,).

    Raises:
        InferenceError: no particle has any weight.
    """
    if bool((torch.isnan(log_weights) | (log_weights == torch.inf)).any()):
        raise InferenceError("a particle's weight is not a number; a kernel or a resampler gave NaN or +inf.")
    if not bool((log_weights > -torch.inf).any()):
        raise InferenceError(
            "no particle has any weight left: every particle says that what was measured cannot be; "
            "widen the prior, use more particles, or check the recording with `bcppl check`."
        )
    return torch.softmax(log_weights, dim=0)


def effective_sample_size(log_weights: Tensor) -> float:
    """1 / sum of squared normalised weights (Kong, Liu and Wong, JASA 89, 1994)."""
    return float(1.0 / (normalised(log_weights) ** 2).sum())


@dataclass(frozen=True, eq=False)
class Belief:
    """Weighted particles over the pose of a part.

    Attributes:
        world_from_part: (N, 7) poses.
        log_weights: (N,) unnormalised.
        freedom: which axes of the pose are free.
    """

    world_from_part: Tensor
    log_weights: Tensor
    freedom: Freedom = FREE

    def __len__(self) -> int:
        return len(self.log_weights)

    @cached_property
    def weights(self) -> Tensor:
        """Normalised weights (N,)."""
        return normalised(self.log_weights)

    @property
    def effective_sample_size(self) -> float:
        """1 / sum of squared weights."""
        return effective_sample_size(self.log_weights)

    @cached_property
    def distinct(self) -> int:
        """How many particles with weight differ from one another."""
        carrying = self.world_from_part[self.weights > 0]
        return len(torch.unique(carrying, dim=0))

    @cached_property
    def mean(self) -> Tensor:
        """The posterior mean (7,): weighted mean translation, chordal mean rotation.

        The rotation minimises the weighted sum of squared chordal distances (Markley et al., Averaging
        quaternions, JGCD 30, 2007, eq. 12).
        """
        weights = self.weights.numpy()
        rotation = Rotation.from_quat(poses.quaternion_xyzw(self.world_from_part).numpy()).mean(weights)
        return poses.from_translation_quaternion_xyzw(
            self.weights @ self.world_from_part[:, :3], torch.from_numpy(np.asarray(rotation.as_quat()))
        )

    @cached_property
    def covariance(self) -> Tensor:
        """Weighted covariance (6, 6) in the tangent space at the mean: m^2, m rad, rad^2 (`bcppl.poses`)."""
        tangent = poses.local(self.mean, self.world_from_part)
        tangent = tangent - self.weights @ tangent
        return (self.weights[:, None] * tangent).T @ tangent

    @property
    def spread(self) -> Tensor:
        """Standard deviations (6,): metres along the world's axes, radians about the part's."""
        return self.covariance.diagonal().clamp_min(0.0).sqrt()

    def add(self, points: np.ndarray | Tensor, truth: np.ndarray | Tensor) -> Tensor:
        """ADD (N,) of every particle, metres: the mean distance of points from where the true pose puts them.

        Args:
            points: (M, 3) on the part's surface, in its frame.
            truth: (7,) true `world_from_part`.

        Source: Hinterstoisser et al., Model based training, detection and pose estimation, ACCV 2012, eq. 3.
        """
        return average_distance(self.world_from_part, points, truth)

    def weighted_add(self, points: np.ndarray | Tensor, truth: np.ndarray | Tensor) -> float:
        """ADD averaged over the particles by weight, metres."""
        return float(self.weights @ self.add(points, truth))


def average_distance(
    world_from_part: Tensor, points: np.ndarray | Tensor, truth: np.ndarray | Tensor
) -> Tensor:
    """ADD (...) of poses (..., 7) against a true pose (7,) over model points (M, 3), metres."""
    points, truth = torch.as_tensor(points), torch.as_tensor(truth, dtype=torch.float64)
    there = poses.transform(truth, points)
    return (poses.transform(world_from_part, points) - there).norm(dim=-1).mean(dim=-1)


def average_nearest_distance(
    world_from_part: Tensor, points: np.ndarray | Tensor, truth: np.ndarray | Tensor
) -> Tensor:
    """ADD-S (...) of poses (..., 7): as ADD, but to the nearest true point instead of the same one, metres.

    Source: Hinterstoisser et al., ACCV 2012, eq. 4, for parts that look the same from several sides.
    """
    points, truth = torch.as_tensor(points), torch.as_tensor(truth, dtype=torch.float64)
    there = poses.transform(truth, points).numpy()
    moved = poses.transform(world_from_part.reshape(-1, 7), points).numpy()
    each = [float(np.mean(cKDTree(particle).query(there)[0])) for particle in moved]
    return torch.tensor(each, dtype=torch.float64).reshape(world_from_part.shape[:-1])

"""A belief: weighted poses, their moments and quantiles, and their modes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses
from bcppl.arguments import whole_number
from bcppl.beliefs import entropy, modes
from bcppl.beliefs.distances import average_distance
from bcppl.beliefs.regions import Measure, Region, pose_deviation, region
from bcppl.beliefs.weights import (
    distinct_poses,
    effective_sample_size,
    merged,
    normalised,
    weighted_quantiles,
)
from bcppl.cached import cached_property
from bcppl.devices import is_on_host, on_device_of
from bcppl.errors import InputError
from bcppl.poses import FREE, Freedom, as_pose


class ApparentPose(Protocol):
    """Where a part is as seen from a held peg, given its pose in the world."""

    def __call__(self, world_from_peg: Tensor, draws: int) -> Tensor:
        """Poses (N, draws, 7) that a part has in the world of a robot that takes its peg to be there.

        They are `world_from_peg` times the true `peg_from_part`, for N particles, the errors between a peg's
        measured pose (7,) and its true one drawn from their posterior.
        """


@runtime_checkable
class SeesPart(Protocol):
    """A site that observes how a held peg meets a part at poses (N, 7)."""

    pose: Tensor

    @property
    def is_displaced(self) -> bool:
        """Whether the peg may be elsewhere than it is measured."""

    def apparent_poses(self, value: Tensor, world_from_peg: Tensor, draws: int) -> Tensor:
        """As `ApparentPose`, given the value that was observed."""

    def shared_posterior(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (N, M) and covariance (N, M, M) of the errors that all touches share, given the value."""


@dataclass(frozen=True, eq=False, repr=False)
class Belief:
    """Weighted particles over the pose of a part.

    Attributes:
        world_from_part: (N, 7) poses, float64 (made so, if they are of another type).
        log_weights: (N,) unnormalised, float64 (likewise).
        freedom: the free axes of the pose.
        apparent: of these particles; None where the peg's measured pose is its true one.

    Raises:
        InputError: the poses are not (N, 7) or not finite, or the weights not (N,).
    """

    world_from_part: Tensor
    log_weights: Tensor
    freedom: Freedom = FREE
    apparent: ApparentPose | None = None

    def __post_init__(self) -> None:
        for name in ("world_from_part", "log_weights"):
            values: object = getattr(self, name)
            if not isinstance(values, Tensor):
                raise InputError(
                    f"a belief is given {name} as a {type(values).__name__}; give a tensor, with "
                    "torch.as_tensor."
                )
            object.__setattr__(self, name, values.to(torch.float64))
        given, weights = tuple(self.world_from_part.shape), tuple(self.log_weights.shape)
        if given != (len(self.world_from_part), 7) or weights != given[:1]:
            raise InputError(
                f"a belief is given poses of shape {given} and log weights of shape {weights}; give (N, 7), "
                "each [x y z qw qx qy qz], and (N,)."
            )
        if len(wrong := (~torch.isfinite(self.world_from_part)).nonzero()):
            raise InputError(f"pose {int(wrong[0, 0])} of a belief is not finite; give numbers, in metres.")
        as_pose(self.world_from_part, "a pose of a belief")

    def __len__(self) -> int:
        return len(self.log_weights)

    def relative(self, world_from_peg: Tensor | np.ndarray, draws: int = 8) -> Belief:
        """The belief about where the part is as seen from the held peg, N times `draws` particles.

        A peg that is off in the hand, and an arm that is off in the world, move all touches alike: the part's
        pose in the world is unsure by as much, and its pose relative to the peg is not. A robot that takes
        its peg to be where it measures it, and the part to be where this belief says, brings the two to where
        they truly are relative to each other. It is the belief itself where the peg's pose has no error.

        Args:
            world_from_peg: (7,) the measured pose at which it is to hold, without a force.
            draws: of the errors, for each particle.

        Raises:
            InputError: the pose is none, or the number of draws is not positive.
        """
        at = as_pose(world_from_peg, "the peg's pose, at which a relative belief is asked for,")
        count = whole_number("a relative belief is asked for with {} draws", draws)
        if self.apparent is None:
            return self
        world_from_part = self.apparent(at, count)
        log_weights = (self.log_weights[:, None] - math.log(count)).expand(-1, count)
        return Belief(world_from_part.reshape(-1, 7), log_weights.reshape(-1), self.freedom)

    def __repr__(self) -> str:
        return f"Belief({len(self)} poses, {self.freedom})"

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
        """The number of distinct particles with weight."""
        # Rows take ten times as long to sort as one number, which tells all apart unless some are copies.
        along = self.world_from_part[self.weights > 0.0, 0]
        return len(along) if len(along.unique()) == len(along) else len(self.merged)

    @cached_property
    def mean(self) -> Tensor:
        """The posterior mean (7,): weighted mean translation, chordal mean rotation.

        The rotation minimises the weighted sum of squared chordal distances (Markley et al., Averaging
        quaternions, JGCD 30, 2007, eq. 12).
        """
        if not is_on_host(self.weights):
            return self._mean_there
        weights = self.weights.numpy()
        rotation = Rotation.from_quat(poses.quaternion_xyzw(self.world_from_part).numpy()).mean(weights)
        return poses.from_translation_quaternion_xyzw(
            self.weights @ self.world_from_part[:, :3], torch.from_numpy(np.asarray(rotation.as_quat()))
        )

    @property
    def _mean_there(self) -> Tensor:
        """The mean on a GPU: the quaternion is the leading eigenvector of their weighted products."""
        turn = self.world_from_part[:, 3:]
        _, axes = torch.linalg.eigh((turn.T @ (self.weights[:, None] * turn)).cpu())
        return torch.cat([self.weights @ self.world_from_part[:, :3], on_device_of(axes[:, -1], turn)])

    @cached_property
    def tangent(self) -> Tensor:
        """The particles in the tangent space at the mean (N, 6), metres and radians; 0 along held axes."""
        free = self.freedom.coordinates(poses.local(self.mean, self.world_from_part))
        return self.freedom.embed(free)

    @cached_property
    def covariance(self) -> Tensor:
        """Weighted covariance (6, 6) in the tangent space at the mean: m^2, m rad, rad^2 (`bcppl.poses`)."""
        centred = self.tangent - self.weights @ self.tangent
        return (self.weights[:, None] * centred).T @ centred

    @property
    def spread(self) -> Tensor:
        """Standard deviations (6,): metres along the world's axes, radians about the part's."""
        return self.covariance.diagonal().clamp_min(0.0).sqrt()

    def quantiles(self, probabilities: object) -> Tensor:
        """Weighted quantiles of each tangent coordinate at the mean, metres and radians; 0 along held axes.

        They are (Q, 6) for several probabilities in [0, 1], (6,) for one. See `weighted_quantiles`.
        """
        return weighted_quantiles(self.tangent, self.weights, probabilities)

    @cached_property
    def merged(self) -> Belief:
        """The same belief with the copies of a pose merged into one particle, their weights added."""
        world_from_part, weights = merged(self.world_from_part, self.weights)
        if self.apparent is None:
            return Belief(world_from_part, weights.log(), self.freedom)
        alive = (self.weights > 0.0).nonzero()[:, 0]
        _, which = distinct_poses(self.world_from_part[alive])
        first = torch.full((len(weights),), len(self)).scatter_reduce(0, which, alive, "amin")
        return self._of(first, world_from_part, weights.log())

    def moved(self, world_from_part: Tensor) -> Belief:
        """The belief with its particles at other poses (N, 7); as seen from a held peg they move alike."""
        return self._of(torch.arange(len(self)), world_from_part, self.log_weights)

    def _of(self, particles: Tensor, world_from_part: Tensor, log_weights: Tensor) -> Belief:
        """Some particles (K,) at other poses (K, 7), which they also have as seen from a held peg."""
        whole, old = self.apparent, self.world_from_part[particles]
        if whole is None:
            return Belief(world_from_part, log_weights, self.freedom)
        motion = poses.compose(poses.inverse(old), world_from_part)[:, None]

        def apparent(world_from_peg: Tensor, draws: int) -> Tensor:
            seen = whole(world_from_peg, draws)[particles]
            return poses.compose(seen, motion.expand_as(seen))

        return Belief(world_from_part, log_weights, self.freedom, apparent)

    def credible_region(self, mass: float, measure: Measure = pose_deviation) -> Region:
        """The region about the mean that contains the truth with probability `mass`, in (0, 1).

        The distance from the mean, `measure`, is one of the functions of `bcppl.beliefs.regions`.

        Raises:
            InputError: the mass is not in (0, 1), or every axis of the measure is held.
        """
        return region(self.merged, mass, measure)

    def modes(
        self, translation: float = 0.01, rotation: float = 0.2, symmetries: Tensor | None = None
    ) -> list[Mode]:
        """The clusters of the particles, the heaviest first.

        They are those of `bcppl.beliefs.modes.cluster`, which raises errors of its own. Poses that differ by
        one of the `symmetries` are equivalent, and a mode gathers them about its heaviest particle.

        Args:
            translation: the gap between clusters, metres.
            rotation: the gap between clusters, radians.
            symmetries: (K, 7) `part_from_part`, a group that leaves the part invariant.
        """
        whole = self.merged
        label = modes.cluster(whole.world_from_part, translation, rotation, symmetries)
        clusters = []
        for which in range(int(label.max()) + 1):
            within = label == which
            particles = within.nonzero()[:, 0]
            poses_within, weights = whole.world_from_part[within], whole.weights[within]
            if symmetries is not None:
                poses_within = modes.gathered(
                    poses_within, poses_within[weights.argmax()], translation, rotation, symmetries
                )
            belief = whole._of(particles, poses_within, weights.log())
            clusters.append(Mode(float(weights.sum()), belief))
        return sorted(clusters, key=lambda mode: -mode.mass)

    @property
    def weight_entropy(self) -> float:
        """Entropy of the weights of the distinct particles, nats: at most the log of their number."""
        return entropy.weight_entropy(self.merged.weights)

    @property
    def gaussian_entropy(self) -> float:
        """Entropy in nats, against the base measure, of the Gaussian at the mean (`bcppl.beliefs.entropy`).

        It overestimates the entropy of several modes: use `entropy_of_modes`.
        """
        return entropy.gaussian_entropy(self)

    def nearest_neighbour_entropy(self, neighbours: int = 3) -> float:
        """The estimate of the entropy in nats, against the base measure, from the particles' neighbours.

        See `bcppl.beliefs.entropy`. It assumes no shape, but needs many particles.
        """
        return entropy.nearest_neighbour_entropy(self, neighbours)

    def add(self, points: np.ndarray | Tensor, truth: np.ndarray | Tensor) -> Tensor:
        """ADD (N,) of every particle, metres: the mean distance of model points from their true positions.

        Points (M, 3) lie on the part's surface, in its frame; the true pose (7,) is `world_from_part`
        (Hinterstoisser et al., Model based training, detection and pose estimation, ACCV 2012, eq. 3).
        """
        return average_distance(self.world_from_part, points, truth)

    def weighted_add(self, points: np.ndarray | Tensor, truth: np.ndarray | Tensor) -> float:
        """ADD averaged over the particles by weight, metres."""
        return float(self.weights @ self.add(points, truth))


@dataclass(frozen=True, eq=False)
class Mode:
    """A cluster of particles, copies merged, and its share of the weight."""

    mass: float
    belief: Belief

    @property
    def mean(self) -> Tensor:
        """The mean pose (7,), `world_from_part`."""
        return self.belief.mean

    @property
    def spread(self) -> Tensor:
        """Standard deviations (6,), metres and radians."""
        return self.belief.spread


def entropy_of_modes(modes: Sequence[Mode]) -> float:
    """Entropy in nats, against the base measure, of a mixture with a Gaussian for each mode.

    The entropy of the masses plus the mean entropy of the Gaussians: exact where they do not overlap, an
    upper bound where they do (Huber et al., On entropy approximation for Gaussian mixture random vectors,
    MFI 2008, eq. 8). -inf where the particles of a mode do not span the free axes.
    """
    masses = torch.tensor([mode.mass for mode in modes], dtype=torch.float64)
    within = sum(mode.mass * mode.belief.gaussian_entropy for mode in modes)
    return entropy.weight_entropy(masses) + within

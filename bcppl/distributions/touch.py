"""What a finger feels when it is moved along a known path: where it first touches, and how it is pushed.

The distributions take the signed distance to the part (`bcppl.geometry.distance.SignedDistance`, or any
callable that maps points (..., 3) in the part's frame to something with `distance` and `normal`) as an
argument, or a `Placed` that answers for a whole program at once. Scales are floats, or tensors (N,) where
they are latent.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.special import log_ndtr

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.path import Path

Distance = Callable[[Tensor], Any]
Scale = float | Tensor

# Farther than this (m) from the path is off it: paths are thinned and interpolated, to some micrometres.
OFF_PATH = 1e-3
# A normal with less than this in the world's xy plane has no direction there.
UPRIGHT = 1e-6


def _refuse_impossible(where: str, outlier: float | None, **scales: Scale) -> None:
    """Refuse scales that are no scales. A latent one, (N,), may leave its support: then it is impossible."""
    for name, scale in scales.items():
        if not (isinstance(scale, Tensor) and scale.ndim > 0):
            number_within(f"{where} has the {name} {{}}", scale, above=0.0)
    if outlier is not None:
        number_within(f"{where} has the outlier probability {{}}", outlier, least=0.0, below=1.0)


class Placed:
    """A part at poses (N, 7): where places in the world lie to its surface, those expected in one call.

    A program that knows which places its sites will ask for says so with `expect`. The first question then
    answers all of them: ten pushes' paths take one call of the simulator, not twenty.

    Args:
        distance: the signed distance to the part.
        pose: (N, 7) world_from_part.
    """

    __caches__ = ("_expected", "_known")

    def __init__(self, distance: Distance, pose: Tensor) -> None:
        self.distance, self.pose = distance, pose
        self._expected: list[Tensor] = []
        self._known: dict[tuple[int, torch.Size], tuple[Tensor, tuple[Tensor, Tensor]]] = {}

    def expect(self, places: Tensor) -> None:
        """Places (M, 3) in the world that will be asked for, at the same memory."""
        self._expected.append(places)

    def near(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distances (N, M) and outward normals (N, M, 3), in the world's axes, at places (M, 3)."""
        key = places.data_ptr(), places.shape
        if key not in self._known:
            asked = {(one.data_ptr(), one.shape): one for one in [*self._expected, places]}
            self._expected = []
            for (which, one), answer in zip(asked.items(), self._evaluated([*asked.values()]), strict=True):
                self._known[which] = one, answer  # kept, so that its memory stays its own
        return self._known[key][1]

    def _evaluated(self, places: list[Tensor]) -> list[tuple[Tensor, Tensor]]:
        turn = poses.rotation_matrix(self.pose)
        near = self.distance((torch.cat(places) - self.pose[:, None, :3]) @ turn)
        sizes = [len(one) for one in places]
        normal = near.normal @ turn.transpose(-1, -2)
        return list(zip(near.distance.split(sizes, dim=1), normal.split(sizes, dim=1), strict=True))


def _at(distance: Distance | Placed, pose: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """Signed distance (N,) and outward normal (N, 3) in world axes at one place (3,), or (N, 3) of each."""
    if isinstance(distance, Placed):
        if places.ndim == 1:
            here, normal = distance.near(places[None])
            return here[:, 0], normal[:, 0]
        distance = distance.distance
    places = places.expand(len(pose), 3)
    near = distance(poses.transform(poses.inverse(pose), places[:, None])[:, 0])
    return near.distance, (poses.rotation_matrix(pose) @ near.normal[..., None])[..., 0]


def _everywhere(distance: Distance | Placed, pose: Tensor, path: Path) -> Tensor:
    """Signed distances (N, R) of all points of a path."""
    if isinstance(distance, Placed):
        return distance.near(path.points)[0]
    near: Tensor = distance(poses.transform(poses.inverse(pose), path.points)).distance
    return near


def _lowest(distance: Distance | Placed, pose: Tensor, path: Path, travelled: Tensor) -> Tensor:
    """The least signed distance (N,) of the path's points before a distance travelled; inf for none.

    The distance travelled is () for all poses or (N,), one for each.
    """
    before = path.travelled < travelled[..., None]
    return torch.where(before, _everywhere(distance, pose, path), torch.inf).amin(dim=-1)


def _travelled(path: Path, place: Tensor) -> Tensor:
    """The distance travelled, () or (N,), until contact was felt at a place (3,) or (N, 3); inf for NaN."""
    felt = ~torch.isnan(place).any(dim=-1)
    return torch.where(
        felt, path.locate(torch.where(felt[..., None], place, path.points[0])).travelled, torch.inf
    )


class OnsetLocation(LazyDistribution):
    """Where on its path a finger is when contact is first felt: (3,) in the world, or NaN for never.

    Contact is felt as soon as the signed distance of the tip falls below a threshold -offset + spread * e,
    e standard normal: a first passage. With probability `outlier` it is felt anywhere on the path, evenly.
    So the density at distance s along the path, whose signed distance is d(s), is

        (1 - outlier) N(d(s); -offset, spread) |d'(s)| [d(s) is the least so far] + outlier / length.

    The base measure is Lebesgue measure of the distance travelled (metres) on the inner path, plus a unit
    mass at its start (felt at once) and a unit mass at "never" (NaN); the total is one whatever the path.
    That the tip moved freely before the onset is part of the density. A location more than 1 mm off the path
    has probability zero.

    Args:
        distance: the signed distance to the part.
        pose: (N, 7) world_from_part.
        path: the tip's path in the world; also the points where d is evaluated.
        offset: metres; positive where the tip lies inside the part at onset, on average.
        spread: standard deviation of the threshold, metres.
        outlier: probability of an onset that has nothing to do with the part.

    Raises:
        InputError: the spread is not positive, or the outlier no probability below 1.
    """

    def __init__(
        self,
        distance: Distance | Placed,
        pose: Tensor,
        path: Path,
        offset: Scale,
        spread: Scale,
        outlier: float,
    ) -> None:
        _refuse_impossible("an onset's location", outlier, spread=spread)
        self.distance, self.pose, self.path = distance, pose, path
        self.offset, self.spread, self.outlier = offset, spread, outlier
        super().__init__(len(pose), (3,))

    def threshold(self) -> tuple[Scale, Scale]:
        """Offset and spread of the threshold, metres."""
        return self.offset, self.spread

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) of one location (3,), or of one for each particle (N, 3)."""
        # What is the same for all particles is computed once: arguments keep the shape they have.
        offset, width = self.threshold()
        travelled = _travelled(self.path, value)
        felt = torch.isfinite(travelled)
        place = value if bool(felt.all()) else torch.where(felt[..., None], value, self.path.points[0])
        located = self.path.locate(place)
        here, normal = _at(self.distance, self.pose, place)
        lowest = _lowest(self.distance, self.pose, self.path, travelled)

        inlier, spread = math.log1p(-self.outlier), torch.as_tensor(width, dtype=torch.float64)
        approach = -(normal * located.direction).sum(dim=-1)
        score = (here + offset) / spread
        passage = -0.5 * score**2 - torch.log(spread) - 0.5 * math.log(2.0 * math.pi)
        passage = passage + torch.log(approach.clamp(min=0.0))
        passage = inlier + torch.where(here < lowest, passage, -torch.inf)
        stray = torch.tensor(self.outlier / self.path.length, dtype=torch.float64).log()
        density = torch.logaddexp(passage, stray)
        density = torch.where(travelled == 0.0, inlier + log_ndtr(-score), density)
        density = torch.where(located.off <= OFF_PATH, density, -torch.inf)
        return torch.where(felt, density, inlier + log_ndtr((lowest + offset) / spread))

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Where contact is first felt, (N, 3): interpolated between the path's points; NaN for never."""
        particles, path = len(self.pose), self.path
        offset, spread = self.threshold()
        threshold = -offset + spread * torch.randn(particles, dtype=torch.float64)
        distances = _everywhere(self.distance, self.pose, path)
        below = distances <= threshold[:, None]
        first = below.to(torch.uint8).argmax(dim=-1, keepdim=True)
        after = distances.gather(-1, first)[:, 0]
        before = distances.gather(-1, (first - 1).clamp(min=0))[:, 0]
        share = torch.where(first[:, 0] > 0, (before - threshold) / (before - after), 1.0)
        start = path.travelled[(first[:, 0] - 1).clamp(min=0)]
        travelled = start + share * (path.travelled[first[:, 0]] - start)
        place = torch.where(below.any(dim=-1, keepdim=True), path.at(travelled), torch.nan)
        stray = torch.rand(particles, dtype=torch.float64) < self.outlier
        anywhere = path.at(path.length * torch.rand(particles, dtype=torch.float64))
        return torch.where(stray[:, None], anywhere, place)


class ForceDirection(LazyDistribution):
    """The direction, in the world's xy plane, of the force that a moving finger exerts on the part.

    An angle in radians from the world's x axis. Friction turns the force from the inward normal towards the
    finger's motion, up to the friction cone's half angle a = atan(friction), where the finger slides. With m
    the angle from the inward normal to the motion, the force stands at a tanh(m / a) from the inward normal:
    the motion's own direction while the finger sticks, the cone's edge while it slides, and (measured) a
    smooth passage between them. About that it is normal (wrapped) with `spread`; with probability `outlier`
    it is uniform. The base measure is Lebesgue on the circle, radians.

    Where the surface faces straight up or down the angle is uniform. Where nothing was felt (tip NaN) the
    direction is NaN with probability one.

    Args:
        distance: the signed distance to the part.
        pose: (N, 7) world_from_part.
        tip: (3,) or (N, 3) where the finger touches, in the world: the normal is taken there; NaN for never.
        motion: (3,) or (N, 3) the finger's direction of travel there, in the world.
        friction: coefficient of friction.
        spread: radians.
        outlier: probability of a direction that has nothing to do with the part.

    Raises:
        InputError: the friction or the spread is not positive, or the outlier no probability below 1.
    """

    def __init__(
        self,
        distance: Distance | Placed,
        pose: Tensor,
        tip: Tensor,
        motion: Tensor,
        friction: Scale,
        spread: Scale,
        outlier: float,
    ) -> None:
        _refuse_impossible("a force's direction", outlier, friction=friction, spread=spread)
        self.distance, self.pose = distance, pose
        self.tip, self.motion = tip.expand(len(pose), 3), motion.expand(len(pose), 3)
        self.friction, self.spread, self.outlier = friction, spread, outlier
        super().__init__(len(pose), ())

    def _expected(self) -> tuple[Tensor, Tensor, Tensor]:
        """The expected angle (N,), where it has a direction (N,), and where anything was felt (N,)."""
        felt = ~torch.isnan(self.tip).any(dim=-1)
        # All particles' tips are one where the tip was seen: then it may be asked for only once.
        tip = self.tip[0] if self.tip.stride(0) == 0 else self.tip
        if not bool(felt.all()):
            tip = torch.where(felt[:, None], self.tip, self.pose[:, :3])
        _, normal = _at(self.distance, self.pose, tip)
        inward = torch.atan2(-normal[:, 1], -normal[:, 0])
        cone = torch.atan(torch.as_tensor(self.friction, dtype=torch.float64))
        turn = _wrapped(torch.atan2(self.motion[:, 1], self.motion[:, 0]) - inward)
        return inward + cone * torch.tanh(turn / cone), normal[:, :2].norm(dim=-1) > UPRIGHT, felt

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) of one angle (), or of one for each particle (N,); radians."""
        expected, sided, felt = self._expected()
        value = value.expand(len(self.pose))
        spread = torch.as_tensor(self.spread, dtype=torch.float64)
        windings = 2.0 * math.pi * torch.arange(-1, 2, dtype=torch.float64)
        error = (_wrapped(value - expected)[:, None] + windings) / spread[..., None]
        near = torch.logsumexp(-0.5 * error**2, dim=-1) - torch.log(spread) - 0.5 * math.log(2.0 * math.pi)
        even = torch.full_like(expected, -math.log(2.0 * math.pi))
        stray = torch.tensor(self.outlier, dtype=torch.float64).log()
        density = torch.logaddexp(math.log1p(-self.outlier) + torch.where(sided, near, even), stray + even)
        told = ~torch.isnan(value)
        return torch.where(felt, torch.where(told, density, -torch.inf), torch.where(told, -torch.inf, 0.0))

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """An angle for each particle (N,), radians in (-pi, pi]; NaN where nothing was felt."""
        expected, sided, felt = self._expected()
        angle = expected + self.spread * torch.randn(len(self.pose), dtype=torch.float64)
        even = 2.0 * math.pi * torch.rand(len(self.pose), dtype=torch.float64)
        stray = torch.rand(len(self.pose), dtype=torch.float64) < self.outlier
        return torch.where(felt, _wrapped(torch.where(stray | ~sided, even, angle)), torch.nan)


class FreePath(LazyDistribution):
    """Whether nothing was felt on the way to the onset: 1 for nothing, 0 for something.

    The tip moved freely with probability Phi((d + tolerance) / spread), d the least signed distance of
    the path's points before the onset: an independent second look beside `OnsetLocation`, which already
    holds that nothing was felt before. The base measure counts {0, 1}.

    Args:
        distance: the signed distance to the part.
        pose: (N, 7) world_from_part.
        path: the tip's path in the world.
        onset: (3,) or (N, 3) where contact was felt; NaN for never: the whole path was free.
        tolerance: metres inside the part at which one free path in two is felt.
        spread: metres.

    Raises:
        InputError: the spread is not positive.
    """

    def __init__(
        self,
        distance: Distance | Placed,
        pose: Tensor,
        path: Path,
        onset: Tensor,
        tolerance: Scale,
        spread: Scale,
    ) -> None:
        _refuse_impossible("a free path", None, spread=spread)
        self.distance, self.pose, self.path = distance, pose, path
        self.onset, self.tolerance, self.spread = onset.expand(len(pose), 3), tolerance, spread
        super().__init__(len(pose), ())

    def _score(self) -> Tensor:
        travelled = _travelled(self.path, self.onset)
        return (_lowest(self.distance, self.pose, self.path, travelled) + self.tolerance) / self.spread

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability (N,) of 1 (nothing felt) or 0, one () for all particles or one for each (N,)."""
        score = self._score()
        return torch.where(value.expand(len(self.pose)) > 0.5, log_ndtr(score), log_ndtr(-score))

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """1 or 0 for each particle, (N,)."""
        free = torch.rand(len(self.pose), dtype=torch.float64) < torch.special.ndtr(self._score())
        return free.to(torch.float64)


def _wrapped(angle: Tensor) -> Tensor:
    """Angles in [-pi, pi), radians."""
    return torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi

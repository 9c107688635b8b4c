"""A laser at the wrist: the distance along its beam to the part, or its range where the beam misses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Normal

from bcppl.arrays import Array
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.manifold import Quadratic
from bcppl.errors import InputError
from bcppl.geometry.camera import looking_at
from bcppl.geometry.parts import Part
from bcppl.poses import as_pose, compose, inverse, rotation_matrix
from bcppl.sensors import Measurement, Recording, checks, register
from bcppl.sensors.layout import POSE_UNITS, TEXT, Layout, number, numbers
from bcppl.sensors.protocol import FAINT, Indexed, Placement, PlannedAsIs
from bcppl.sensors.scene import LinearisedSite

NOISE, OUTLIER = 0.0003, 0.01  # standard deviation (m) of a distance, and the probability of any in the range


@dataclass(frozen=True, eq=False)
class Beam:
    """Action and candidate: a laser of a range (m) shines along the z axis of its frame, (7,)."""

    name: str
    near: float
    far: float
    world_from_laser: Array


@dataclass(frozen=True, eq=False)
class Distance:
    """Observation: metres along the beam."""

    metres: float


class BeamDistance(LazyDistribution):
    """The distance along a beam to a part at poses (N, 7): normal, with a share of outliers."""

    cost = 1

    def __init__(self, part: Part, pose: Tensor, beam: Beam, blur: float = 0.0) -> None:
        self.part, self.pose, self.beam, self.noise = part, pose, beam, math.hypot(NOISE, blur)
        super().__init__(len(pose), ())

    def cast(self) -> tuple[Tensor, Tensor]:
        """Distances (N,), and their gradients (N, 6) in the tangent space at the poses, 0 for a miss."""
        ray = compose(inverse(self.pose), as_pose(self.beam.world_from_laser))
        start, along = ray[:, :3].numpy(), rotation_matrix(ray)[:, :, 2].numpy()
        met, rows, faces = self.part.mesh.ray.intersects_location(start, along, multiple_hits=False)
        distance = torch.full((len(start),), self.beam.far, dtype=torch.float64)
        away = np.linalg.norm(met - start[rows], axis=1)
        within = away < self.beam.far  # what is farther is not met
        met, rows, faces = met[within], rows[within], faces[within]
        distance[rows] = torch.from_numpy(away[within])
        normal = self.part.mesh.face_normals[faces]
        normal = torch.from_numpy(normal / (normal * along[rows]).sum(axis=1, keepdims=True))
        turned = torch.linalg.cross(torch.from_numpy(np.asarray(met)), normal)
        shifted = (rotation_matrix(self.pose[rows]) @ normal[..., None])[..., 0]
        gradient = torch.zeros(len(start), 6, dtype=torch.float64)
        gradient[rows] = torch.cat([shifted, turned], dim=1)
        return distance, gradient

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density (N,) of one distance, or of one for each particle."""
        normal = Normal(self.cast()[0], self.noise).log_prob(value) + math.log1p(-OUTLIER)
        return torch.logaddexp(normal, torch.full_like(normal, math.log(OUTLIER / self.beam.far)))

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """One distance for each particle, (N,), none an outlier."""
        return Normal(self.cast()[0], self.noise).sample()

    def quadratic(self, value: Tensor) -> Quadratic:
        """Quadratic approximation; what is many standard deviations off has little weight."""
        distance, rows = self.cast()
        error = (distance - value) / self.noise
        weight = (1.0 / (1.0 + error**2 / 16.0) / self.noise)[:, None]
        information = (weight / self.noise)[..., None] * rows[:, :, None] * rows[:, None]
        return Quadratic(weight * error[:, None] * rows, information)


def _stated_beam(**fields: Any) -> Beam:
    """A beam that somebody wrote down, which is refused where it is none."""
    beam = Beam(**fields)
    for problem in _problems(f"laser {beam.name!r}", beam):
        raise InputError(problem)
    return beam


def _problems(what: str, beam: Beam) -> Iterator[str]:
    yield from checks.pose(f"{what}: its world_from_laser", beam.world_from_laser)
    if not 0 <= beam.near < beam.far < math.inf:
        yield (
            f"{what} reaches from {beam.near:g} to {beam.far:g} m; give a finite range, near below far, in "
            "metres."
        )


class WristLaser(PlannedAsIs):
    """Distances along beams."""

    kind = candidate_kind = "laser"
    names = ("laser distance", "laser distances")
    contact = False
    action = Layout(
        Beam,
        {"name": TEXT, "near": number("m"), "far": number("m"), "world_from_laser": numbers(POSE_UNITS)},
    )
    candidate = replace(action, make=_stated_beam)
    observation = Layout(Distance, {"metres": number("m")})
    caption = "the beam as far as it reaches"

    def prepare(self, recording: Recording) -> LinearisedSite:
        """The likelihood of distances."""
        site = partial(BeamDistance, recording.part)
        return LinearisedSite("laser", site, lambda distance: torch.tensor(distance.metres).double())

    def problems(self, measurements: Indexed, recording: Recording) -> Iterator[tuple[int, str]]:
        """Problems of beams and distances."""
        for k, (beam, metres) in ((k, (m.action, m.observation.metres)) for k, m in measurements):
            wrong = list(_problems(f"measurement {k}: laser {beam.name!r}", beam))
            yield from ((k, problem) for problem in wrong)
            if not wrong and not beam.near <= metres <= beam.far:
                yield k, f"measurement {k}: a distance of {metres:.4g} m is out of range; leave it out."

    def describe(self, measurements: Sequence[Measurement], recording: Recording) -> list[tuple[str, str]]:
        """The range of each laser."""
        return [(f"laser {b.name}", f"{b.near:g} to {b.far:g} m") for b in (m.action for m in measurements)]

    def blank(self, candidate: Beam) -> Distance:
        """A distance that is not measured yet."""
        return Distance(math.nan)

    def placement(self, candidate: Beam) -> Placement:
        """The laser's pose."""
        return Placement(candidate.world_from_laser, None)

    def around(self, mean: Array, part: Part, like: Beam | None, count: int, seed: int) -> Iterator[Beam]:
        """Beams from 20 cm onto places of the surface at the mean that face up."""
        points, faces = part.mesh.sample(8 * count, return_index=True, seed=seed)
        turn, up = rotation_matrix(torch.as_tensor(mean)).numpy(), part.mesh.face_normals[faces]
        for point, normal in zip(points @ turn.T + mean[:3], up @ turn.T, strict=True):
            if normal[2] > 0.1:
                pose = looking_at(point + 0.2 * normal, point, np.eye(3)[np.abs(normal).argmin()])
                yield Beam("laser #", 0.05, 0.5, pose)

    def draw(
        self, axes: Any, candidate: Beam, mean: Array, peg: Part | None, *, faint: bool = False
    ) -> Array:
        """Draw the beam from its nearest to its farthest distance."""
        along = rotation_matrix(as_pose(candidate.world_from_laser)).numpy()[:, 2]
        reach = np.array([candidate.near, candidate.far])[:, None]
        line = 1000.0 * (candidate.world_from_laser[:3] + reach * along)
        axes.plot(*line.T, **(FAINT if faint else {"color": "red", "label": "beam"}))
        return np.asarray(line)


register(WristLaser())

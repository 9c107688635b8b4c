"""A kind of measurement that is not shipped: a laser at the wrist measures the distance along its beam."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyro
import torch
from pyro.distributions import Normal
from torch import Tensor

from bcppl.geometry.parts import Part
from bcppl.poses import as_pose, compose, inverse, rotation_matrix
from bcppl.sensors import Measurement, Recording, checks, register
from bcppl.sensors.layout import POSE_UNITS, TEXT, Layout, number, numbers, shared
from bcppl.sensors.protocol import FAINT, Indexed, Placement
from bcppl.sensors.scene import Numbered

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Laser:
    """A laser and its range in metres."""

    name: str
    near: float
    far: float


@dataclass(frozen=True, eq=False)
class Beam:
    """Action: a laser shines along the z axis of its frame, (7,)."""

    laser: Laser
    world_from_laser: Array


@dataclass(frozen=True, eq=False)
class Distance:
    """Observation: metres along the beam."""

    metres: float


@dataclass(frozen=True, eq=False)
class Aim:
    """Candidate: a beam, and its laser's name and range."""

    name: str
    near: float
    far: float
    world_from_laser: Array


class BeamLikelihood:
    """Distances to the part's surface at `laser_*`, with normal noise; a beam that misses reads its range."""

    efforts: Mapping[str, Any] = {}

    def __init__(self, recording: Recording) -> None:
        self.mesh = recording.part.mesh

    def observe(self, number: int, action: Beam, world_from_part: Tensor) -> None:
        """Sample `laser_*`."""
        part_from_laser = compose(inverse(world_from_part), as_pose(action.world_from_laser))
        start, along = part_from_laser[:, :3].numpy(), rotation_matrix(part_from_laser)[:, :, 2].numpy()
        met, rows, _ = self.mesh.ray.intersects_location(start, along, multiple_hits=False)
        distance = torch.full((len(start),), action.laser.far, dtype=torch.float64)
        distance[rows] = torch.from_numpy(np.linalg.norm(met - start[rows], axis=1))
        pyro.sample(f"laser_{number}", Normal(distance, 0.001))

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """The distances, by address."""
        return {f"laser_{n}": torch.tensor(m.observation.metres).double() for n, m in measurements}


RANGE = {"near": number("m"), "far": number("m")}
LASER = Layout(Laser, RANGE)


class WristLaser:
    """Distances along beams."""

    kind = "laser"
    names = ("laser distance", "laser distances")
    contact = False
    action = Layout(Beam, {"laser": shared("lasers", LASER), "world_from_laser": numbers(POSE_UNITS)})
    observation = Layout(Distance, {"metres": number("m")})
    prepare = BeamLikelihood  # for models that state no likelihood of their own

    candidate_kind = "beam"
    candidate = Layout(Aim, {"name": TEXT, **RANGE, "world_from_laser": numbers(POSE_UNITS)})
    needs_peg = False
    caption = "the beam as far as it reaches"

    def problems(self, measurements: Indexed, recording: Recording) -> Iterator[tuple[int, str]]:
        """Problems of lasers, beams and distances."""
        lasers: dict[str, Laser] = {}
        for index, measurement in measurements:
            where, beam, metres = f"measurement {index}", measurement.action, measurement.observation.metres
            found = list(checks.named_alike(where, "laser", beam.laser, lasers))
            found += checks.pose(f"{where}'s world_from_laser", beam.world_from_laser)
            if not beam.laser.near <= metres <= beam.laser.far:
                found.append(f"{where}: a distance of {metres:.4g} m is out of range; leave it out.")
            yield from ((index, problem) for problem in found)

    def describe(self, measurements: Sequence[Measurement], recording: Recording) -> list[tuple[str, str]]:
        """The range of each laser."""
        lasers = {m.action.laser.name: m.action.laser for m in measurements}.values()
        return [(f"laser {each.name}", f"{each.near:g} to {each.far:g} m") for each in lasers]

    def placement(self, candidate: Aim) -> Placement:
        """The laser's pose."""
        return Placement(candidate.world_from_laser, None)

    def action_of(self, candidate: Aim) -> Beam:
        """The beam."""
        return Beam(Laser(candidate.name, candidate.near, candidate.far), candidate.world_from_laser)

    def name_of(self, candidate_or_action: Aim | Beam) -> str:
        """The laser's name."""
        return str(getattr(candidate_or_action, "laser", candidate_or_action).name)

    def renamed(self, candidate: Aim, name: str) -> Aim:
        """The same beam under another name."""
        return replace(candidate, name=name)

    def duration(self, candidate: Aim) -> float:
        """Seconds to move there and settle."""
        return 1.5

    def blank(self, candidate: Aim) -> Distance:
        """No distance."""
        return Distance(np.nan)

    def draw(self, axes: Any, candidate: Aim, mean: Array, peg: Part | None, *, faint: bool = False) -> Array:
        """Draw the beam from its nearest to its farthest distance."""
        along = rotation_matrix(as_pose(candidate.world_from_laser)).numpy()[:, 2]
        reach = np.array([candidate.near, candidate.far])[:, None]
        line = 1000.0 * (candidate.world_from_laser[:3] + reach * along)
        axes.plot(*line.T, **(FAINT if faint else {"color": "red", "label": "beam"}))
        return np.asarray(line)


register(WristLaser())

"""Pushes drawn from the two real logs, and what explains them: bcppl, and least squares.

The part stands at a known pose within 20 mm and 20 degrees of the guess. What is known of the finger is
learnt on one log, and the pushes are another log's.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import torch
from report import DATA
from scipy.optimize import least_squares
from torch import Tensor

from bcppl import poses
from bcppl.beliefs import Belief, average_distance
from bcppl.beliefs.regions import Measure, average_point_distance, rotation_angle, translation_deviation
from bcppl.contact.touch import Touch
from bcppl.geometry.distance import SignedDistance
from bcppl.inference import infer
from bcppl.inference.filters.smc import Step
from bcppl.models.point_probe import estimate_settings, model
from bcppl.recordings.importers.point_probe import command
from bcppl.sensors import Push, Recording
from bcppl.sensors.likelihoods.point_finger import FingerSettings, contact_of, registration_pose

LOGS = DATA / "point_probe_pushes"
OTHER = {"10_90": "10_130", "10_130": "10_90"}  # where the finger is learnt for the pushes of a log
SESSIONS = {**OTHER, "wood_30_63": "10_130"}  # and for those on another table
PARTICLES = 75
PUSHES = 50  # of each log
SOFT = 1e-3  # m: where the loss of least squares turns from squares to distances


class Errors(NamedTuple):
    """How far a pose is from the truth: mm in the plane, degrees, mm over the part's points."""

    position: float
    yaw: float
    add: float


def pushes(log: str, count: int, seed: int) -> Recording:
    """Pushes drawn from a log, the part at a pose within 20 mm and 20 degrees of the guess."""
    return command(sorted(LOGS.glob(f"{log}_*")), pushes=count, seed=seed)


@cache
def learnt(log: str, calibrated: bool = True) -> FingerSettings:
    """Settings from all pushes of a log; without calibration the recorded tip is taken as the finger."""
    recording = pushes(log, PUSHES, 0)
    return (
        estimate_settings(recording) if calibrated else estimate_settings(recording, finger=(0.0, 0.0, 0.0))
    )


def errors(world_from_part: Tensor, recording: Recording) -> Errors:
    """Of one pose (7,)."""
    truth = torch.as_tensor(recording.truth)
    off = poses.local(truth, world_from_part)
    add = average_distance(world_from_part, recording.part.surface_points(), truth)
    return Errors(1e3 * float(off[:2].norm()), math.degrees(abs(float(off[5]))), 1e3 * float(add))


def explained(recording: Recording, seed: int, settings: dict[str, Any]) -> Iterator[tuple[Step, float]]:
    """The steps of a run with given settings of the model, and the seconds from its beginning to each."""
    begun, idle = time.perf_counter(), 0.0
    scene = model.prepare(recording, **settings)
    for step in infer(model, recording, particles=PARTICLES, seed=seed, scene=scene):
        now = time.perf_counter()
        yield step, now - begun - idle
        idle += time.perf_counter() - now  # what is done with a step in between is not the run's


def contacts(recording: Recording, settings: FingerSettings) -> Tensor:
    """Where the finger was, by its calibration, when contact was first felt (K, 3), in the world."""
    places = []
    for k, one in enumerate(recording.measurements):
        assert isinstance(one.action, Push) and isinstance(one.observation, Touch)
        places.append(contact_of(one.action, one.observation, settings, f"push {k}").onset)
    return torch.stack(places)


def fitted(recording: Recording, settings: FingerSettings, registered: bool) -> Tensor:
    """The pose (7,) of robust least squares on the contacts' depths, started at the truth.

    The residual is the depth of a contact less the offset of the settings; beyond a millimetre it counts by
    its size and no more by its square. With `registered` the settings' registration is made use of too.
    """
    truth, distance = torch.as_tensor(recording.truth), SignedDistance(recording.part)
    places = contacts(recording, settings)

    def pose(planar: np.ndarray) -> Tensor:
        tangent = torch.zeros(6, dtype=torch.float64)
        tangent[[0, 1, 5]] = torch.from_numpy(planar)
        return poses.retract(truth, tangent)

    def residual(planar: np.ndarray) -> np.ndarray:
        near = distance(poses.transform(poses.inverse(pose(planar)), places))
        return ((near.distance + settings.offset) / SOFT).numpy()

    found = least_squares(residual, np.zeros(3), loss="soft_l1", x_scale=[1e-3, 1e-3, 1e-2])
    return tracked(pose(found.x), recording, settings) if registered else pose(found.x)


def tracked(world_from_touched: Tensor, recording: Recording, settings: FingerSettings) -> Tensor:
    """The pose (7,) of the frame that the truth is stated in, of a part that was touched at a pose (7,)."""
    middle = torch.tensor(recording.part.mesh.centroid, dtype=torch.float64)
    registration = registration_pose(settings.registration, middle)
    return poses.compose(world_from_touched, poses.inverse(registration))


class Held(NamedTuple):
    """Whether a region of a belief holds the truth."""

    region: str
    mass: float
    holds: bool


def held(belief: Belief, recording: Recording, masses: Sequence[float] = (0.5, 0.9)) -> list[Held]:
    """For regions of the translation, the yaw and the ADD from the mean pose."""
    measures: dict[str, Measure] = {
        "translation": translation_deviation,
        "yaw": rotation_angle,
        "ADD": average_point_distance(recording.part.surface_points()),
    }
    return [
        Held(name, mass, bool(belief.credible_region(mass, measure).contains(recording.truth)))
        for name, measure in measures.items()
        for mass in masses
    ]


def groups(log: str, count: int, seed: int) -> list[Recording]:
    """All pushes of a log, put by chance into disjoint groups of `count`, the part at one pose for all."""
    whole = pushes(log, PUSHES, seed)
    return [
        replace(whole, measurements=whole.measurements[first : first + count])
        for first in range(0, PUSHES - count + 1, count)
    ]


def coverage(asked: tuple[str, int, int]) -> list[list[Held]]:
    """What the regions of each disjoint group of a log hold: (log, pushes in a group, seed)."""
    log, count, seed = asked
    found = []
    for k, recording in enumerate(groups(log, count, seed)):
        *_, (step, _) = explained(recording, 1000 * seed + k, asdict(learnt(OTHER[log])))
        found.append(held(step.belief, recording))
    return found

"""Likelihood of a point finger's pushes: onset of contact, direction of the force, and the free path."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pyro
import torch
from torch import Tensor

from bcppl.cached import cached_property
from bcppl.contact.touch import Touch
from bcppl.distributions.parameters import COUNT, NONNEGATIVE, POSITIVE, RARE, check_parameters, within
from bcppl.distributions.touch import ForceDirection, FreePath, Path, Placed, SharedError, SharedOnset
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.distance import SignedDistance
from bcppl.poses import compose, transform
from bcppl.sensors.measurements import Recording
from bcppl.sensors.push import Push
from bcppl.sensors.scene import Numbered
from bcppl.traces.carried import once

THREE = within(count=3)


@dataclass(frozen=True)
class FingerSettings:
    """Calibration and noise of a point finger; the defaults are learnt from log 10_130 of MLab_EXP.

    Attributes:
        finger: where the finger really touches, in the recorded tip's frame, metres: its calibration error.
        registration: where the part that is touched stands in the frame whose pose is asked for (a tracker's,
            say): x and y, metres, and yaw, radians, about the part's middle.
        drift: how far the registration of another session lies from that: standard deviations, metres along
            either axis and radians. All pushes of one recording share it; (0, 0) for none.
        offset, spread: how far inside the part that place lies at onset, mean and standard deviation, metres.
        varying: standard deviation of the natural logarithm of the factor by which another session scatters
            more, and its registration lies farther off.
        outlier: probability of an onset that has nothing to do with the part.
        friction: coefficient between finger and part.
        direction_spread, direction_outlier: scale, radians; probability of a direction unrelated to the part.
        tolerance, free_spread: depth at which one free path in two would be felt, and its spread, metres.
        spacing: the path's points are this far apart, metres.
        threshold: contact begins where the tared force exceeds it, N.
        tare: rows at a push's start that are free of contact.
        averaged: rows from the onset over which the force's direction is averaged.
        use_direction, use_free_path: whether the sites `direction_*` and `free_*` are there.
    """

    finger: tuple[float, float, float] = field(default=(-0.000704, -0.000821, 0.0), metadata=THREE)
    registration: tuple[float, float, float] = field(default=(-0.000106, -0.000056, 0.001991), metadata=THREE)
    drift: tuple[float, float] = field(default=(0.000147, 0.003448), metadata=within(least=0.0, count=2))
    offset: float = field(default=-0.000013, metadata=within())
    spread: float = field(default=0.000403, metadata=POSITIVE)
    varying: float = field(default=0.35, metadata=NONNEGATIVE)
    outlier: float = field(default=0.01, metadata=RARE)
    friction: float = field(default=0.413, metadata=POSITIVE)
    direction_spread: float = field(default=0.0341, metadata=POSITIVE)
    direction_outlier: float = field(default=0.01, metadata=RARE)
    tolerance: float = field(default=0.000794, metadata=NONNEGATIVE)
    free_spread: float = field(default=0.000403, metadata=POSITIVE)
    spacing: float = field(default=0.0005, metadata=POSITIVE)
    threshold: float = field(default=0.6, metadata=POSITIVE)
    tare: int = field(default=10, metadata=COUNT)
    averaged: int = field(default=5, metadata=COUNT)
    use_direction: bool = True
    use_free_path: bool = False

    def __post_init__(self) -> None:
        check_parameters(self)


class _Touched(NamedTuple):
    """What all pushes of one run share: the part as it stands, and the error that they have in common."""

    pose: Tensor
    distance: Placed
    shared: SharedError


class PointFinger:
    """Pushes of a point finger, each with sites `onset_*`, and as options `direction_*` and `free_*`.

    Args:
        recording: its part.
        settings: of the finger.

    Raises:
        InputError: the part's mesh is open.
    """

    def __init__(self, recording: Recording, settings: FingerSettings) -> None:
        self.part, self.settings = recording.part, settings
        self.distance = SignedDistance(recording.part)
        # What a push's path and its measured onset determine is the same in every run of the program.
        self.path = lru_cache(maxsize=1024)(self._path)
        self._heading_at = lru_cache(maxsize=1024)(self._heading)

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """The cost of simulators: there are none."""
        return {}

    @cached_property
    def middle(self) -> Tensor:
        """The part's centroid (3,), in its frame."""
        return torch.tensor(self.part.mesh.centroid, dtype=torch.float64)

    @cached_property
    def part_from_touched(self) -> Tensor:
        """The registration as a pose (7,)."""
        return registration_pose(self.settings.registration, self.middle)

    def _path(self, push: Push) -> Path:
        """The path in the world of the place where the finger touches, thinned."""
        return Path(finger_points(push, self.settings)).thinned(self.settings.spacing)

    def heading(self, push: Push, onset: Tensor) -> Tensor:
        """The unit direction (3,) or (N, 3) of the finger's motion about an onset (3,) or (N, 3)."""
        if onset.ndim > 1:
            return self._direction(push, onset)
        return self._heading_at(push, tuple(onset.tolist()))

    def _heading(self, push: Push, onset: tuple[float, ...]) -> Tensor:
        return self._direction(push, torch.tensor(onset, dtype=torch.float64))

    def _direction(self, push: Push, onset: Tensor) -> Tensor:
        path = self.path(push)
        return path.heading(path.locate(torch.nan_to_num(onset)).travelled, 2.0 * self.settings.spacing)

    def _touched(self, world_from_part: Tensor) -> _Touched:
        settings, pose = self.settings, compose(world_from_part, self.part_from_touched)
        distance = Placed(self.distance, pose)
        scatter = settings.offset, settings.spread, settings.outlier, settings.varying
        return _Touched(pose, distance, SharedError(distance, self.middle, *settings.drift, *scatter))

    def observe(self, number: int, action: Push, world_from_part: Tensor) -> None:
        """Sample `onset_*`, and as the settings ask `direction_*` and `free_*`."""
        settings, path = self.settings, self.path(action)
        touched = once("point finger", lambda: self._touched(world_from_part))
        distance, shared = touched.distance, touched.shared
        distance.expect(path.points)
        shared.add(path)
        onset = pyro.sample(f"onset_{number}", SharedOnset(shared))
        shared.condition_on(onset)
        if onset.ndim == 1 and not bool(onset.isnan().any()):
            distance.expect(onset[None])
        if settings.use_direction:
            noise = settings.friction, settings.direction_spread, settings.direction_outlier
            heading = self.heading(action, onset)
            direction = ForceDirection(distance, touched.pose, onset, heading, *noise)
            pyro.sample(f"direction_{number}", direction)
        if settings.use_free_path:
            free = FreePath(distance, touched.pose, path, onset, settings.tolerance, settings.free_spread)
            pyro.sample(f"free_{number}", free)

    def observed(self, measurements: Sequence[Numbered]) -> Mapping[str, Tensor]:
        """Onsets, directions of force and free paths, by address.

        Raises:
            InputError: a wrench cannot be read (see `contact_of`).
        """
        values: dict[str, Tensor] = {}
        for number, each in measurements:
            contact = contact_of(each.action, each.observation, self.settings, f"push {number}")
            values[f"onset_{number}"] = contact.onset
            if self.settings.use_direction:
                values[f"direction_{number}"] = contact.direction
            if self.settings.use_free_path:
                values[f"free_{number}"] = torch.tensor(1.0, dtype=torch.float64)
        return values


def registration_pose(registration: Sequence[float], middle: Tensor) -> Tensor:
    """The pose (7,) of a shift in the plane and a turn about a vertical axis through a part's middle."""
    x, y, yaw = registration
    turn = torch.tensor([0.0, 0.0, 0.0, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)], dtype=torch.float64)
    turn[:3] = middle - transform(turn, middle[None])[0] + torch.tensor([x, y, 0.0], dtype=torch.float64)
    return turn


def finger_points(push: Push, settings: FingerSettings) -> Tensor:
    """Where the finger's touching place was, in the world, at the push's times: (R, 3), metres."""
    finger = torch.tensor([settings.finger], dtype=torch.float64)
    return transform(torch.from_numpy(push.world_from_tip), finger)[:, 0]


@dataclass(frozen=True)
class Contact:
    """A push's contact: its onset (3,) in the world, the angle of the force on the part; NaN if none."""

    onset: Tensor
    direction: Tensor


def contact_of(push: Push, touch: Touch, settings: FingerSettings, name: str = "a push") -> Contact:
    """The onset and the direction of force of a push, from its raw wrench.

    Raises:
        InputError: the wrench has too few rows to tare, is not finite, or starts after or outlasts the path.
    """
    if len(touch.times) <= settings.tare:
        rows = f"{len(touch.times)} rows of force, too few to tare by the first {settings.tare}"
        raise InputError(f"{name} has {rows}; record longer.")
    if not np.isfinite(touch.wrench[:, :3]).all():
        raise InputError(f"{name} has a force that is not finite; leave that row out.")
    force = touch.wrench[:, :2] - touch.wrench[: settings.tare, :2].mean(axis=0)
    above = np.flatnonzero(np.hypot(force[:, 0], force[:, 1]) > settings.threshold)
    nothing = torch.tensor(math.nan, dtype=torch.float64)
    if not above.size:
        return Contact(nothing.expand(3), nothing)
    row = int(above[0])
    time = touch.times[row]
    if not push.times[0] <= time <= push.times[-1]:
        raise InputError(
            f"{name} felt contact at {time:.3f} s, outside its path's times {push.times[0]:.3f} to "
            f"{push.times[-1]:.3f} s; record both on one clock."
        )
    points = finger_points(push, settings).numpy()
    onset = np.array([np.interp(time, push.times, points[:, axis]) for axis in range(3)])
    # The wrench is on the finger: the part feels the opposite.
    on_part = -force[row : row + settings.averaged].mean(axis=0)
    direction = math.atan2(on_part[1], on_part[0])
    return Contact(torch.from_numpy(onset), torch.tensor(direction, dtype=torch.float64))

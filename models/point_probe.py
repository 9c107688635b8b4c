"""A part is touched by a point finger that is moved towards it until a force is felt.

Each push tells where on the finger's path contact was first felt, how the finger pushed the part, and (as an
option) that nothing was felt before. The settings come from `learn`, on pushes at a known pose.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyro
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from bcppl.distributions.path import Path
from bcppl.distributions.poses import prior_from_guess
from bcppl.distributions.touch import ForceDirection, FreePath, OnsetLocation, Placed
from bcppl.errors import InputError
from bcppl.parts import Part
from bcppl.poses import inverse, rotation_matrix, transform
from bcppl.recordings.measurements import Measurement, Push, Recording, Touch
from bcppl.simulators.distance import SignedDistance
from bcppl.traces.model import Model


@dataclass(frozen=True)
class Settings:
    """What is known of the finger and of touching; the defaults are learnt from log 10_130 of MLab_EXP.

    Attributes:
        finger: where the finger really touches, in the recorded tip's frame, metres: its calibration error.
        offset, spread: how far inside the part that place lies at onset, mean and standard deviation, metres.
        outlier: probability of an onset that has nothing to do with the part.
        friction: coefficient between finger and part.
        direction_spread, direction_outlier: radians; probability of a direction unrelated to the part.
        tolerance, free_spread: depth at which one free path in two would be felt, and its spread, metres.
        spacing: the path's points are this far apart, metres.
        threshold: contact begins where the tared force exceeds it, N.
        tare: rows at a push's start that are free of contact.
        averaged: rows from the onset over which the force's direction is averaged.
        use_direction, use_free_path: whether the sites `direction_*` and `free_*` are there.
    """

    finger: tuple[float, float, float] = (-0.000848, -0.000855, 0.0)
    offset: float = -0.000011
    spread: float = 0.000403
    outlier: float = 0.01
    friction: float = 0.413
    direction_spread: float = 0.0422
    direction_outlier: float = 0.01
    tolerance: float = 0.000811
    free_spread: float = 0.000403
    spacing: float = 0.0005
    threshold: float = 0.6
    tare: int = 10
    averaged: int = 5
    use_direction: bool = True
    use_free_path: bool = False


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over a run.

    Attributes:
        part: the part that is touched.
        prior: the prior of its pose.
        distance: the signed distance to it.
        settings: what is known of the finger and of touching.
    """

    part: Part
    prior: Any
    distance: SignedDistance
    settings: Settings
    paths: dict[Push, Path] = field(default_factory=dict, repr=False)
    motions: dict[Push, tuple[Tensor, Tensor]] = field(default_factory=dict, repr=False)

    def path(self, push: Push) -> Path:
        """The path in the world of the place where the finger touches, thinned."""
        if push not in self.paths:
            self.paths[push] = Path(finger_points(push, self.settings)).thinned(self.settings.spacing)
        return self.paths[push]

    def motion(self, push: Push, onset: Tensor) -> Tensor:
        """The unit direction (3,) or (N, 3) of the finger's travel about an onset (3,) or (N, 3)."""
        path, reach = self.path(push), 2.0 * self.settings.spacing
        if onset.ndim > 1:
            return path.heading(path.locate(torch.nan_to_num(onset)).travelled, reach)
        # What was seen is the same in every run of the program.
        if push not in self.motions or not torch.equal(self.motions[push][0], onset):
            heading = path.heading(path.locate(torch.nan_to_num(onset)).travelled, reach)
            self.motions[push] = onset.clone(), heading
        return self.motions[push][1]


def finger_points(push: Push, settings: Settings) -> Tensor:
    """Where the finger's touching place was, in the world, at the push's times: (R, 3), metres."""
    finger = torch.tensor([settings.finger], dtype=torch.float64)
    return transform(torch.from_numpy(push.world_from_tip), finger)[:, 0]


def point_probe(scene: Scene, actions: Sequence[Push]) -> None:
    """The program: the part's pose, then for every push where it is felt, which way, and that it was free."""
    settings = scene.settings
    part = pyro.sample("part", scene.prior)
    distance = Placed(scene.distance, part)
    for k, push in enumerate(actions):
        path = scene.path(push)
        distance.expect(path.points)
        onset = pyro.sample(
            f"onset_{k}",
            OnsetLocation(distance, part, path, settings.offset, settings.spread, settings.outlier),
        )
        if onset.ndim == 1 and not bool(onset.isnan().any()):
            distance.expect(onset[None])
        if settings.use_direction:
            motion = scene.motion(push, onset)
            friction, spread, outlier = (
                settings.friction,
                settings.direction_spread,
                settings.direction_outlier,
            )
            pyro.sample(
                f"direction_{k}", ForceDirection(distance, part, onset, motion, friction, spread, outlier)
            )
        if settings.use_free_path:
            tolerance, spread = settings.tolerance, settings.free_spread
            pyro.sample(f"free_{k}", FreePath(distance, part, path, onset, tolerance, spread))


def prepare(recording: Recording, **settings: Any) -> Scene:
    """The scene of a recording; `settings` are fields of `Settings`.

    Raises:
        InputError: the part's mesh is open, or a setting is not known.
    """
    unknown = sorted(set(settings) - set(Settings.__dataclass_fields__))
    if unknown:
        raise InputError(
            f"point_probe has no setting {unknown[0]!r}; it knows {', '.join(Settings.__dataclass_fields__)}."
        )
    return Scene(
        recording.part,
        prior_from_guess(recording.guess),
        SignedDistance(recording.part),
        replace(Settings(), **settings),
    )


@dataclass(frozen=True)
class Felt:
    """What one push felt: where, (3,) in the world, and the angle of the force on the part; NaN for never."""

    onset: Tensor
    direction: Tensor


def felt(push: Push, touch: Touch, settings: Settings, name: str = "a push") -> Felt:
    """Reads onset and direction of force from a push's raw wrench.

    Raises:
        InputError: the wrench has too few rows to tare, is not finite, or starts after or outlasts the path.
    """
    if len(touch.times) <= settings.tare:
        raise InputError(
            f"{name} has {len(touch.times)} rows of force, too few to tare by the first {settings.tare}; "
            "record longer."
        )
    if not np.isfinite(touch.wrench[:, :3]).all():
        raise InputError(f"{name} has a force that is not finite; leave that row out.")
    force = touch.wrench[:, :2] - touch.wrench[: settings.tare, :2].mean(axis=0)
    above = np.flatnonzero(np.hypot(force[:, 0], force[:, 1]) > settings.threshold)
    nothing = torch.tensor(math.nan, dtype=torch.float64)
    if not above.size:
        return Felt(nothing.expand(3), nothing)
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
    return Felt(torch.from_numpy(onset), torch.tensor(direction, dtype=torch.float64))


def observe(scene: Scene, measurements: Sequence[Measurement]) -> Mapping[str, Tensor]:
    """The constraints that pushes put on the program.

    Raises:
        InputError: a measurement is no push, or its wrench cannot be read (see `felt`).
    """
    values: dict[str, Tensor] = {}
    for k, measurement in enumerate(measurements):
        push, touch = _push(measurement, k)
        seen = felt(push, touch, scene.settings, f"push {k}")
        values[f"onset_{k}"] = seen.onset
        if scene.settings.use_direction:
            values[f"direction_{k}"] = seen.direction
        if scene.settings.use_free_path:
            values[f"free_{k}"] = torch.tensor(1.0, dtype=torch.float64)
    return values


def _push(measurement: Measurement, k: int) -> tuple[Push, Touch]:
    push, touch = measurement.action, measurement.observation
    if not isinstance(push, Push) or not isinstance(touch, Touch):
        raise InputError(
            f"measurement {k} is a {measurement.kind} and point_probe explains pushes only; "
            "choose another model."
        )
    return push, touch


def learn(recording: Recording, **settings: Any) -> Settings:
    """Settings from pushes at a known pose: the finger's calibration, offset, spreads, friction, tolerance.

    The finger's place in the tip's xy plane is found by least squares on the signed distance at onset
    (linearised along the normals, three rounds); offset and spread are what is left, the tolerance is the
    deepest free place, and the friction the one with the least squared error of the force's direction.

    Args:
        recording: ten pushes or more, with the true pose.
        settings: fields of `Settings` that are held and not learnt.

    Raises:
        InputError: the recording has no true pose, or fewer than 10 of its pushes touch.
    """
    if recording.truth is None:
        raise InputError("settings are learnt at a known pose; give a recording with its true pose.")
    truth = torch.as_tensor(recording.truth, dtype=torch.float64)
    distance = SignedDistance(recording.part)
    start = replace(Settings(), **{**settings, "finger": (0.0, 0.0, 0.0)})  # what is read is the recorded tip
    pushes = [_push(measurement, k) for k, measurement in enumerate(recording.measurements)]
    seen = [felt(push, touch, start) for push, touch in pushes]
    kept = [k for k, one in enumerate(seen) if not bool(one.direction.isnan())]
    if len(kept) < 10:
        raise InputError(
            f"settings are learnt from 10 touching pushes or more, not from {len(kept)}; record more."
        )
    tips = torch.stack([seen[k].onset for k in kept])
    angles = torch.stack([seen[k].direction for k in kept])
    world_from_tips = torch.stack(
        [rotation_matrix(torch.from_numpy(pushes[k][0].world_from_tip[0])) for k in kept]
    )

    finger = tips.new_tensor(settings.get("finger", start.finger))
    for _ in range(0 if "finger" in settings else 3):
        near = distance(transform(inverse(truth), tips + world_from_tips @ finger))
        normals = near.normal @ rotation_matrix(truth).T
        in_tip = (world_from_tips.transpose(-1, -2) @ normals[..., None])[:, :2, 0]
        finger[:2] -= torch.linalg.lstsq(in_tip, near.distance[:, None]).solution[:, 0]
    near = distance(transform(inverse(truth), tips + world_from_tips @ finger))
    depth, normals = -near.distance, near.normal @ rotation_matrix(truth).T

    inward = torch.atan2(-normals[:, 1], -normals[:, 0])
    paths = [Path(finger_points(pushes[k][0], start)).thinned(start.spacing) for k in kept]
    motions = torch.stack(
        [p.heading(p.locate(tip).travelled, 2.0 * start.spacing) for p, tip in zip(paths, tips, strict=True)]
    )
    turn = _wrapped(torch.atan2(motions[:, 1], motions[:, 0]) - inward)

    def error(cone: float) -> Tensor:
        return _wrapped(angles - inward - cone * torch.tanh(turn / cone))

    cone = float(
        minimize_scalar(lambda a: float((error(a) ** 2).sum()), bounds=(0.02, 1.4), method="bounded").x
    )
    spread = float(depth.std())
    learnt = Settings(
        finger=(float(finger[0]), float(finger[1]), float(finger[2])),
        offset=float(depth.mean()),
        spread=spread,
        friction=math.tan(cone),
        direction_spread=float(error(cone).square().mean().sqrt()),
        tolerance=float(depth.max()),
        free_spread=spread,
    )
    return replace(learnt, **settings)


def _wrapped(angle: Tensor) -> Tensor:
    return torch.remainder(angle + math.pi, 2.0 * math.pi) - math.pi


def invent(seed: int, **options: Any) -> Recording:
    """Pushes made up by the program itself; see `bcppl.models.worlds.point_probe.invent`."""
    from bcppl.models.worlds.point_probe import invent as made_up

    return made_up(seed, **options)


model = Model(program=point_probe, prepare=prepare, observe=observe, pose="part", invent=invent)

"""A part is touched by a point finger that is moved towards it until a force is felt.

Each push tells where on the finger's path contact was first felt, how the finger pushed the part, and (as an
option) that nothing was felt before. The settings come from `learn`, on pushes at a known pose.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pyro
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from bcppl.contact.touch import Touch
from bcppl.distributions.path import Path
from bcppl.distributions.poses import prior_from_guess
from bcppl.distributions.shared_error import SharedError, SharedOnset
from bcppl.distributions.touch import ForceDirection, FreePath, Placed
from bcppl.errors import InputError
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.parts import Part
from bcppl.poses import compose, inverse, rotation_matrix, transform
from bcppl.sensors import Measurement, Push, Recording
from bcppl.traces.model import Model


@dataclass(frozen=True)
class Settings:
    """What is known of the finger and of touching; the defaults are learnt from log 10_130 of MLab_EXP.

    Attributes:
        finger: where the finger really touches, in the recorded tip's frame, metres: its calibration error.
        registration: where the part that is touched stands in the frame whose pose is asked for (a tracker's,
            say): x and y, metres, and yaw, radians, about the part's middle.
        drift: how far the registration of another session lies from that: standard deviations, metres along
            either axis and radians. All pushes of one recording share it; (0, 0) for none.
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

    finger: tuple[float, float, float] = (-0.000704, -0.000821, 0.0)
    registration: tuple[float, float, float] = (-0.000106, -0.000056, 0.001991)
    drift: tuple[float, float] = (0.000147, 0.003448)
    offset: float = -0.000013
    spread: float = 0.000403
    outlier: float = 0.01
    friction: float = 0.413
    direction_spread: float = 0.0413
    direction_outlier: float = 0.01
    tolerance: float = 0.000794
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

    @cached_property
    def middle(self) -> Tensor:
        """The part's middle (3,), in its frame."""
        return torch.tensor(self.part.mesh.centroid, dtype=torch.float64)

    @cached_property
    def part_from_touched(self) -> Tensor:
        """The registration as a pose (7,)."""
        return registration_pose(self.settings.registration, self.middle)

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


def registration_pose(registration: Sequence[float], middle: Tensor) -> Tensor:
    """The pose (7,) of a shift in the plane and a turn about a vertical axis through a part's middle."""
    x, y, yaw = registration
    turn = torch.tensor([0.0, 0.0, 0.0, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)], dtype=torch.float64)
    turn[:3] = middle - transform(turn, middle[None])[0] + torch.tensor([x, y, 0.0], dtype=torch.float64)
    return turn


def finger_points(push: Push, settings: Settings) -> Tensor:
    """Where the finger's touching place was, in the world, at the push's times: (R, 3), metres."""
    finger = torch.tensor([settings.finger], dtype=torch.float64)
    return transform(torch.from_numpy(push.world_from_tip), finger)[:, 0]


def point_probe(scene: Scene, actions: Sequence[Push]) -> None:
    """The program: the part's pose, then for every push where it is felt, which way, and that it was free."""
    settings = scene.settings
    touched = compose(pyro.sample("part", scene.prior), scene.part_from_touched)
    distance = Placed(scene.distance, touched)
    shared = SharedError(distance, scene.middle, *settings.drift, settings.offset, settings.spread)
    for k, push in enumerate(actions):
        path = scene.path(push)
        distance.expect(path.points)
        shared.expect(path)
        onset = pyro.sample(f"onset_{k}", SharedOnset(shared, settings.outlier))
        shared.felt(onset)
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
                f"direction_{k}", ForceDirection(distance, touched, onset, motion, friction, spread, outlier)
            )
        if settings.use_free_path:
            tolerance, spread = settings.tolerance, settings.free_spread
            pyro.sample(f"free_{k}", FreePath(distance, touched, path, onset, tolerance, spread))


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
    """Settings from pushes at a known pose: finger, registration, offset, spreads, friction, tolerance.

    The finger's place in the tip's xy plane and the registration are found by least squares on the signed
    distance at onset (linearised along the normals, three rounds), and the offset is what is left. The spread
    is what the finger alone leaves: from one log to another the scatter differs by nearly a factor of two,
    so it had better be wide. The tolerance is the deepest free place, and the friction the one with the least
    squared error of the force's direction. Where the finger is held nothing is learnt of the registration.

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

    middle = torch.tensor(recording.part.mesh.centroid, dtype=torch.float64)

    def fitted(axes: int) -> tuple[Tensor, Tensor, Tensor]:
        """The first axes of finger (2) and registration (3) by least squares; what is left; normals."""
        found = torch.cat([tips.new_tensor(settings.get("finger", start.finger))[:2], tips.new_zeros(3)])
        for last in (False, False, False, True):
            touched = compose(truth, registration_pose(found[2:].tolist(), middle))
            finger = torch.cat([found[:2], tips.new_zeros(1)])
            places = transform(inverse(touched), tips + world_from_tips @ finger)
            near = distance(places)
            normals = near.normal @ rotation_matrix(touched).T
            if not last and axes:
                in_tip = (world_from_tips.mT @ normals[..., None])[:, :2, 0]
                turning = torch.linalg.cross(places - middle, near.normal)[:, 2:]
                slopes = torch.cat([in_tip, -near.normal[:, :2], -turning], dim=1)[:, :axes]
                found[:axes] -= torch.linalg.lstsq(slopes, near.distance[:, None]).solution[:, 0]
        return found, -near.distance, normals

    held = "finger" in settings
    _, scatter, _ = fitted(0 if held else 2)
    found, depth, normals = fitted(0 if held else 5)
    # Half of what one log shows is taken to last and half for this session's own: two normals of equal
    # variance, of which the sum r was seen, leave r / 2 for the next session, with a variance of 3 / 4 r^2.
    lasting, drift = 0.5 * found[2:], math.sqrt(0.75) * found[2:].abs()

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
    spread = float(scatter.std())
    learnt = Settings(
        finger=(float(found[0]), float(found[1]), 0.0),
        registration=(float(lasting[0]), float(lasting[1]), float(lasting[2])),
        drift=(float(drift[:2].square().mean().sqrt()), float(drift[2])),
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

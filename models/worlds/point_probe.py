"""Simulated pushes of a point finger: a pose drawn from the prior, and observations by the program itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bcppl.arrays import Array
from bcppl.contact.touch import Touch
from bcppl.errors import InputError
from bcppl.geometry.parts import Guess, Part
from bcppl.models.point_probe import point_probe, prepare
from bcppl.poses import identity, rotation_matrix, transform
from bcppl.recordings.importers.point_probe import prism
from bcppl.sensors.likelihoods.point_finger import PointFinger
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.push import Push
from bcppl.traces import generate

SPEED = 0.0033  # m/s, as in the MLab_EXP logs
TIP_PERIOD, FORCE_PERIOD = 0.03, 0.01  # s
REACH = 0.006  # m from the start of a push to its target
AIM = 0.001  # m: standard deviation of the aim
CLEAR = 0.0015  # m: no push starts nearer to the part
STROKE = 0.012  # m
STIFFNESS = 2000.0  # N/m: slope of the force beyond the onset
NOISE = 0.005  # N


def simulate_recording(
    seed: int,
    pushes: int = 10,
    part: Part | None = None,
    translation: float = 0.02,
    yaw: float = math.radians(20.0),
    **settings: Any,
) -> Recording:
    """A recording of pushes on the upright faces of a part whose pose is drawn from the prior.

    A push aims at a random point of an upright face, at most 60 degrees from the normal, with 1 mm of error.

    Args:
        seed: the same seed, the same recording.
        pushes: how many.
        part: the part; the aluminium triangle of MLab_EXP by default.
        translation: half width of the prior in x and y, metres.
        yaw: half width of the prior in yaw, radians.
        settings: fields of `bcppl.sensors.likelihoods.point_finger.FingerSettings`.

    Raises:
        InputError: the part has no upright face, or none that a finger can approach.
    """
    rng = np.random.default_rng(seed)
    part = prism() if part is None else part
    guess = Guess(identity().numpy(), np.array([translation, translation, 0.0]), yaw=yaw)
    x, y = rng.uniform(-translation, translation, 2)
    turn = 0.5 * rng.uniform(-yaw, yaw)
    truth = np.array([x, y, 0.0, math.cos(turn), 0.0, 0.0, math.sin(turn)])
    scene = prepare(Recording(part, guess, [], truth=truth), **settings)
    finger = scene.likelihoods["push"]
    assert isinstance(finger, PointFinger)
    actions = [_push(rng, finger, truth) for _ in range(pushes)]

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(noise_seed(seed))
        trace, _ = generate(point_probe, (scene, actions), {"part": torch.from_numpy(truth)[None]}, 1)
    measurements = []
    for k, push in enumerate(actions):
        angle = (
            float(trace[f"direction_{k}"][0])
            if finger.settings.use_direction
            else rng.uniform(-math.pi, math.pi)
        )
        measurements.append(Measurement(push, _touch(rng, finger, push, trace[f"onset_{k}"][0], angle)))
    return Recording(
        part, guess, measurements, truth=truth, model="point_probe", source=f"simulated by bcppl, seed {seed}"
    )


def noise_seed(seed: int) -> int:
    """The seed of a recording's noise: it differs from inference's, so that they share no draws."""
    return int(np.random.default_rng([seed, 1]).integers(2**62))


def _push(rng: np.random.Generator, finger: PointFinger, truth: Array) -> Push:
    """A straight path onto a random point of an upright face, the finger's tip leading."""
    mesh = finger.part.mesh
    upright = np.abs(mesh.face_normals[:, 2]) < 1e-3
    if not upright.any():
        raise InputError(f"part {finger.part.name!r} has no upright face to push; give one, z up, that has.")
    area = np.where(upright, mesh.area_faces, 0.0)
    low, high = finger.part.vertices[:, 2].min(), finger.part.vertices[:, 2].max()
    for _ in range(1000):
        face = rng.choice(len(area), p=area / area.sum())
        # Uniform in the triangle, then lowered to where a finger reaches: a fifth of the way up.
        root, share = math.sqrt(rng.random()), rng.random()
        place = np.array([1 - root, root * (1 - share), root * share]) @ mesh.triangles[face]
        place[2] = low + 0.2 * (high - low)
        place[:2] += rng.normal(0.0, AIM, 2)
        inward = -mesh.face_normals[face]
        heading = math.atan2(inward[1], inward[0]) + rng.uniform(-math.pi / 3, math.pi / 3)
        way = np.array([math.cos(heading), math.sin(heading), 0.0])
        start = torch.from_numpy(place - REACH * way)
        if float(finger.distance(start).distance) > CLEAR:
            break
    else:
        raise InputError(
            f"part {finger.part.name!r} leaves a finger no room to approach; give one that does."
        )

    times = np.arange(0.0, STROKE / SPEED, TIP_PERIOD)
    in_part = place + (SPEED * times - REACH)[:, None] * way
    places = transform(torch.from_numpy(truth), torch.from_numpy(in_part))
    turn = 0.5 * rng.uniform(-math.pi, math.pi)
    pose = identity(len(times))
    pose[:, 3], pose[:, 6] = math.cos(turn), math.sin(turn)
    offset = torch.tensor(finger.settings.finger, dtype=torch.float64)
    pose[:, :3] = places - rotation_matrix(pose[0]) @ offset
    return Push(times, pose.numpy())


def _touch(rng: np.random.Generator, finger: PointFinger, push: Push, onset: Tensor, angle: float) -> Touch:
    """The raw wrench of an onset (NaN without contact) and an angle of the force on the part."""
    settings, path = finger.settings, finger.path(push)
    times = np.arange(push.times[0], push.times[-1], FORCE_PERIOD)
    force = np.zeros(len(times))
    if bool(onset.isnan().any()):
        angle = 0.0
    else:
        contact_time = push.times[0] + float(path.locate(onset).travelled) / SPEED
        force = np.where(
            times >= contact_time,
            settings.threshold + STIFFNESS * SPEED * (times - contact_time) + 5 * NOISE,
            0.0,
        )
    wrench = rng.normal(0.0, NOISE, (len(times), 6)) + rng.normal(0.0, 0.1, 6)
    wrench[:, 3:] = 0.0
    wrench[:, :2] -= force[:, None] * np.array([math.cos(angle), math.sin(angle)])
    return Touch(times, wrench, np.zeros((0, 7)))

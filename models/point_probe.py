"""A part is touched by a point finger that moves towards it until a contact force.

Each push measures the onset of contact on the finger's path, the direction of the force, and (as an option)
that the path before was free (`PointFinger`). `estimate_settings` estimates the settings from pushes at a
known pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import pyro
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from bcppl.distributions.poses import prior_from_guess
from bcppl.distributions.touch import Path
from bcppl.distributions.touch.direction import scale_of
from bcppl.errors import InputError
from bcppl.geometry.distance import SignedDistance
from bcppl.models.shipped import simulated_in
from bcppl.poses import compose, inverse, quaternions, rotation_matrix, transform
from bcppl.sensors.likelihoods.point_finger import (
    FingerSettings,
    PointFinger,
    contact_of,
    finger_points,
    registration_pose,
)
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Scene, chosen, likelihoods_for
from bcppl.traces import Model


def point_probe(scene: Scene, actions: Sequence[Any]) -> None:
    """The program: the part's pose, then the sites of every push."""
    part = pyro.sample("part", scene.prior)
    for number, action in enumerate(actions):
        scene.sensor(action).observe(number, action, part)


def prepare(recording: Recording, **settings: Any) -> Scene:
    """The scene of a recording; `settings` are fields of `FingerSettings`.

    Raises:
        InputError: the part's mesh is open, or a setting is unknown.
    """
    (finger,) = chosen("point_probe", settings, FingerSettings())
    likelihoods = {"push": partial(PointFinger, settings=finger)}
    return Scene(prior_from_guess(recording.guess), likelihoods_for(recording, likelihoods), "point_probe")


model = Model(
    program=point_probe,
    prepare=prepare,
    observe=Scene.observed,
    pose="part",
    simulate_recording=simulated_in("point_probe"),
    inference=("tempered_smc", {"always_search": True}),
)


def estimate_settings(recording: Recording, **settings: Any) -> FingerSettings:
    """Finger, registration, offset, spreads, friction and tolerance, estimated from pushes at a known pose.

    The finger's position in the tip's xy plane and the registration are least-squares estimates from the
    signed distance at onset (three Gauss-Newton steps along the normals); the offset is the mean residual.
    The spread is that of the residuals without a registration: between logs the scatter differs by nearly a
    factor of two, so a wide one is safer. The tolerance is the largest depth, the friction has the least
    squared error of the force's direction, and the direction's spread the maximum likelihood. With a given
    finger the registration is not estimated.

    Args:
        recording: ten pushes or more, with the true pose.
        settings: fields of `FingerSettings` that are given and not estimated.

    Raises:
        InputError: the recording has no true pose, fewer than 10 of its pushes touch, or a setting is unknown
            or out of range.
    """
    if recording.truth is None:
        raise InputError("settings are estimated at a known pose; give a recording with its true pose.")
    truth = torch.as_tensor(recording.truth, dtype=torch.float64)
    distance = SignedDistance(recording.part)
    (given,) = chosen("point_probe", settings, FingerSettings())
    start = replace(given, finger=(0.0, 0.0, 0.0))  # onsets are of the recorded tip
    pushes = [(m.action, m.observation) for m in recording.measurements]
    contacts = [contact_of(push, touch, start) for push, touch in pushes]
    kept = [k for k, one in enumerate(contacts) if not bool(one.direction.isnan())]
    if len(kept) < 10:
        raise InputError(
            f"settings are estimated from 10 pushes with contact, not from {len(kept)}; record more."
        )
    tips = torch.stack([contacts[k].onset for k in kept])
    angles = torch.stack([contacts[k].direction for k in kept])
    world_from_tips = torch.stack(
        [rotation_matrix(torch.from_numpy(pushes[k][0].world_from_tip[0])) for k in kept]
    )

    middle = torch.tensor(recording.part.mesh.centroid, dtype=torch.float64)

    def fitted(axes: int) -> tuple[Tensor, Tensor, Tensor]:
        """The first axes of finger (2) and registration (3) by least squares; residuals and normals."""
        estimate = torch.cat([tips.new_tensor(settings.get("finger", start.finger))[:2], tips.new_zeros(3)])
        for last in (False, False, False, True):
            touched = compose(truth, registration_pose(estimate[2:].tolist(), middle))
            finger = torch.cat([estimate[:2], tips.new_zeros(1)])
            positions = transform(inverse(touched), tips + world_from_tips @ finger)
            near = distance(positions)
            normals = near.normal @ rotation_matrix(touched).T
            if not last and axes:
                in_tip = (world_from_tips.mT @ normals[..., None])[:, :2, 0]
                turning = torch.linalg.cross(positions - middle, near.normal)[:, 2:]
                jacobian = torch.cat([in_tip, -near.normal[:, :2], -turning], dim=1)[:, :axes]
                estimate[:axes] -= torch.linalg.lstsq(jacobian, near.distance[:, None]).solution[:, 0]
        return estimate, -near.distance, normals

    held = "finger" in settings
    _, scatter, _ = fitted(0 if held else 2)
    estimate, depth, normals = fitted(0 if held else 5)
    # Half of one log's registration is attributed to all sessions and half to its own: given the sum r of two
    # normals of equal variance, the expectation for the next session is r / 2, with a variance of 3 / 4 r^2.
    lasting, drift = 0.5 * estimate[2:], math.sqrt(0.75) * estimate[2:].abs()

    inward = torch.atan2(-normals[:, 1], -normals[:, 0])
    paths = [Path(finger_points(pushes[k][0], start)).thinned(start.spacing) for k in kept]
    motions = torch.stack(
        [p.heading(p.locate(tip).travelled, 2.0 * start.spacing) for p, tip in zip(paths, tips, strict=True)]
    )
    turn = quaternions.wrapped_angle(torch.atan2(motions[:, 1], motions[:, 0]) - inward)

    def error(cone: float) -> Tensor:
        return quaternions.wrapped_angle(angles - inward - cone * torch.tanh(turn / cone))

    cone = float(
        minimize_scalar(lambda a: float((error(a) ** 2).sum()), bounds=(0.02, 1.4), method="bounded").x
    )
    spread = float(scatter.std())
    estimated = FingerSettings(
        finger=(float(estimate[0]), float(estimate[1]), 0.0),
        registration=(float(lasting[0]), float(lasting[1]), float(lasting[2])),
        drift=(float(drift[:2].square().mean().sqrt()), float(drift[2])),
        offset=float(depth.mean()),
        spread=spread,
        friction=math.tan(cone),
        direction_spread=scale_of(error(cone)),
        tolerance=float(depth.max()),
        free_spread=spread,
    )
    return replace(estimated, **settings)

"""A part is seen by depth cameras whose stated poses and ranges are in error.

Errors that are common to all pixels of an image are latent, so that the belief is not overconfident
(`bcppl.sensors.likelihoods.erring_camera`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.pose_normals import product_of_factors
from bcppl.distributions.poses import NormalPose, prior_from_guess
from bcppl.models.shipped import simulated_in
from bcppl.sensors.likelihoods.camera_settings import CameraSettings
from bcppl.sensors.likelihoods.erring_camera import ErringCamera
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Scene, chosen, likelihoods_for
from bcppl.traces import Model, Trace

# Logarithms of the scales of a random walk, in the particles' standard deviations.
SCALES = torch.tensor([0.1, 1.5], dtype=torch.float64).log()


def camera_error(scene: Scene, actions: Sequence[Any]) -> None:
    """The program: the part's pose, then each camera's errors and images."""
    part = pyro.sample("part", scene.prior)
    for number, action in enumerate(actions):
        scene.sensor(action).observe(number, action, part)


def first_views(trace: Trace) -> dict[str, Any]:
    """Each viewpoint's first view."""
    scene, actions = trace.args
    first: dict[str, Any] = {}
    for view in actions:
        first.setdefault(scene.sensor(view).viewpoint(view), view)
    return first


def conditional(trace: Trace, values: Mapping[str, Tensor]) -> Any:
    """The approximate conditional of the part's pose, given where its cameras measure it and their biases.

    It is the prior where cameras see the part where it is.
    """
    scene = trace.args[0]
    instruments: dict[str, list[Any]] = {}
    for name, view in first_views(trace).items():
        if f"seen_by_{name}" in values:
            instruments.setdefault(scene.sensor(view).instrument(view), []).append(view)
    factors = [scene.sensor(views[0]).factor(views, values) for views in instruments.values()]
    return product_of_factors(scene.prior, factors) if factors else scene.prior


def conditional_proposal(trace: Trace) -> None:
    """A proposal: the part's pose from its approximate conditional. Nothing is rendered."""
    pyro.sample("part", conditional(trace, trace.choices))


def joint_proposal(trace: Trace, spreads: Mapping[str, Tensor]) -> None:
    """A proposal: all apparent poses move together, each a little further, and the part follows.

    The apparent poses of two cameras are tied by the part to half a degree, less than the images determine of
    its rotation, so that neither could turn far alone.
    """
    moved, motion = dict(trace.choices), poses.identity(1)
    for k, name in enumerate(first_views(trace)):
        address = f"seen_by_{name}"
        seen = trace[address]
        size = torch.exp(pyro.sample(f"step of {name}", dist.Uniform(*SCALES)))[..., None, None]
        around = NormalPose(poses.compose(motion, seen), size**2 * spreads[address])
        moved[address] = pyro.sample(address, around)
        if k == 0:
            motion = poses.compose(moved[address], poses.inverse(seen))
    pyro.sample("part", conditional(trace, moved))


def prepare(recording: Recording, **settings: Any) -> Scene:
    """The scene of a recording; `settings` are fields of `CameraSettings`.

    Raises:
        InputError: a setting is unknown or out of range, or a camera cannot see the part near its guess.
    """
    (cameras,) = chosen("camera_error", settings, CameraSettings())
    prior = prior_from_guess(recording.guess)
    likelihoods = {"view": partial(ErringCamera, prior=prior, settings=cameras)}
    return Scene(prior, likelihoods_for(recording, likelihoods, only=True), "camera_error")


model = Model(
    program=camera_error,
    prepare=prepare,
    observe=Scene.observed,
    pose="part",
    simulate_recording=simulated_in("two_cameras"),
    proposals=(conditional_proposal, joint_proposal),
)

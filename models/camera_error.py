"""A part is seen by depth cameras that do not stand quite where they are said to, and read a little too far.

The pose of the part is drawn from the prior; the error of each camera's stated pose and the bias of its range
from what the robot's owner says of the calibration. Every view is a depth image rendered where the camera
then stands. Errors that all pixels share are so explained, instead of making the belief sure of a wrong pose.
What is known to stand behind the part is rendered with it: it tells much of the errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.poses import NormalPose, prior_from_guess
from bcppl.errors import InputError
from bcppl.recordings.measurements import DepthImage, Measurement, Recording, View
from bcppl.simulators.camera import Camera, bin_depth
from bcppl.simulators.effort import Effort
from bcppl.simulators.scene import SceneRenderer, background_part, placed
from bcppl.traces import Model


@dataclass(frozen=True)
class Settings:
    """What is known of the cameras.

    Attributes:
        camera_shift, camera_turn: standard deviations of the error of a camera's stated pose, along and about
            each of its axes, metres and radians: what the extrinsic calibration reports.
        bias: standard deviation of what a camera adds to every range, metres.
        scale: of the Laplace noise, metres.
        outlier: the probability that a pixel shows something else than what is rendered.
        effective_pixels: how many independent pixels an image is worth; None for all that are looked at: what
            they have in common is in the errors.
        bins: so many pixels in each direction are read as one, the median of them.
    """

    camera_shift: float = 0.002
    camera_turn: float = math.radians(0.5)
    bias: float = 0.002
    scale: float = 0.002
    outlier: float = 0.1
    effective_pixels: float | None = None
    bins: int = 2


class Look(NamedTuple):
    """What is looked at of one camera's images.

    Attributes:
        region: left, top, width and height of where the part may be, pixels.
        camera: of that region, binned.
        renderer: of the part and, in the frame where the camera is said to stand, what is behind it.
    """

    region: tuple[int, int, int, int]
    camera: Camera
    renderer: SceneRenderer


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over a run: the prior of the part's pose, and what is looked at, by camera."""

    prior: Any
    looks: Mapping[str, Look]
    settings: Settings

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """What each simulator has done so far."""
        return {f"rendering {name}": look.renderer.effort for name, look in self.looks.items()}


def camera_error(scene: Scene, actions: Sequence[View]) -> None:
    """The program: the part's pose, each camera's error and bias, and a depth image for every view."""
    settings = scene.settings
    spread = torch.tensor([settings.camera_shift] * 3 + [settings.camera_turn] * 3)
    part = pyro.sample("part", scene.prior)
    known: dict[str, tuple[Tensor, Tensor]] = {}
    for k, view in enumerate(actions):
        camera = view.camera
        if camera.instrument not in known:  # one error for all views of one camera
            error = pyro.sample(f"error_{camera.instrument}", NormalPose(poses.identity(), spread))
            bias = pyro.sample(f"bias_{camera.instrument}", dist.Normal(0.0, scene.settings.bias))
            known[camera.instrument] = error, bias
        error, bias = known[camera.instrument]
        _, seen, renderer = scene.looks[camera.name]
        still = [torch.as_tensor(camera.world_from_camera)] * (len(renderer.parts) - 1)
        depth = RobustDepth(
            renderer,
            seen,
            placed(part, *still),
            scale=settings.scale,
            outlier=settings.outlier,
            effective_pixels=settings.effective_pixels,
            camera_error=error,
            bias=bias,
        )
        pyro.sample(f"depth_{k}", depth)


def prepare(recording: Recording, **settings: Any) -> Scene:
    """The scene of a recording; `settings` are fields of `Settings`."""
    chosen = Settings(**settings)
    looks: dict[str, Look] = {}
    for camera in (m.action.camera for m in recording.measurements if isinstance(m.action, View)):
        if camera.name not in looks:
            behind = recording.background.get(camera.name)
            still = [] if behind is None else [background_part(camera, behind)]
            region = where_it_may_be(camera, recording)
            seen = camera.cropped(*region).binned(chosen.bins)
            looks[camera.name] = Look(region, seen, SceneRenderer([recording.part, *still]))
    return Scene(prior_from_guess(recording.guess), looks, chosen)


def where_it_may_be(camera: Camera, recording: Recording) -> tuple[int, int, int, int]:
    """The region (left, top, width, height) around the part's guess; all, where that is beside the camera."""
    guess, part = recording.guess, recording.part
    camera_from_world = poses.inverse(poses.as_pose(camera.world_from_camera))
    middle = torch.as_tensor(0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0)))[None]
    there = poses.transform(camera_from_world, poses.transform(poses.as_pose(guess.world_from_part), middle))
    reach = float(np.linalg.norm(part.extent) / 2 + np.linalg.norm(guess.translation))
    corners = there.numpy() + reach * np.array([[x, y, -1] for x in (-1, 1) for y in (-1, 1)])
    pixel = camera.project(corners)
    if not np.isfinite(pixel).all():
        return 0, 0, camera.width, camera.height
    size = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixel.min(axis=0)), 0, size - 1).astype(int)
    high = np.clip(np.ceil(pixel.max(axis=0)), low + 1, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def observe(scene: Scene, measurements: Sequence[Measurement]) -> Mapping[str, Tensor]:
    """The depth images, by address.

    Raises:
        InputError: a measurement is not a view.
    """
    values: dict[str, Tensor] = {}
    for k, measurement in enumerate(measurements):
        image = measurement.observation
        if not isinstance(measurement.action, View) or not isinstance(image, DepthImage):
            raise InputError(
                f"measurement {k} is a {measurement.kind} and camera_error explains views only; "
                "choose another model."
            )
        camera = measurement.action.camera
        left, top, width, height = scene.looks[camera.name].region
        region = image.depth[top : top + height, left : left + width]
        binned = bin_depth(region, scene.settings.bins, near=camera.near, far=camera.far)
        values[f"depth_{k}"] = torch.from_numpy(binned)
    return values


def invent(seed: int, **options: Any) -> Recording:
    """A block on a bench before two cameras that are off: see `bcppl.models.worlds.two_cameras`."""
    from bcppl.models.worlds.two_cameras import record

    return record(seed, **options)


model = Model(program=camera_error, prepare=prepare, observe=observe, pose="part", invent=invent)

"""A part is seen by depth cameras that do not stand quite where they are said to, and read a little too far.

The pose of the part is drawn from the prior; the error of each camera's stated pose and the bias of its range
from what the robot's owner says of the calibration. Every view is a depth image rendered where the camera
then stands. Errors that all pixels share are so explained, instead of making the belief sure of a wrong pose.

A camera's error is not drawn as such but as the pose at which the camera, taken by its word, sees the part.
An image tells that pose whatever the error is, so particles need not follow a ridge. Both say the same.
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
from bcppl.simulators.renderer import DepthRenderer
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
        effective_pixels: how many independent pixels an image is worth, all that are looked at; None for all:
            the errors hold what all pixels have in common, not what neighbours at an edge have.
        bins: so many pixels in each direction are read as one, the median of them.
    """

    camera_shift: float = 0.002
    camera_turn: float = math.radians(0.5)
    bias: float = 0.002
    scale: float = 0.002
    outlier: float = 0.1
    effective_pixels: float | None = 100.0
    bins: int = 3


class Look(NamedTuple):
    """What is looked at of one camera's images.

    Attributes:
        region: left, top, width and height of where the part may be, pixels.
        camera: of that region, binned.
    """

    region: tuple[int, int, int, int]
    camera: Camera


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over a run: the prior, the renderer, and what is looked at, by camera."""

    prior: Any
    renderer: DepthRenderer
    looks: Mapping[str, Look]
    settings: Settings

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """What each simulator has done so far."""
        return {"rendering": self.renderer.effort}


def camera_error(scene: Scene, actions: Sequence[View]) -> None:
    """The program: the part's pose, each camera's bias and error, and a depth image for every view."""
    settings = scene.settings
    part = pyro.sample("part", scene.prior)
    known: dict[str, tuple[Tensor, Tensor]] = {}
    for k, view in enumerate(actions):
        name, camera = view.camera.instrument, scene.looks[view.camera.name].camera
        if name not in known:  # one error for all views of one camera, also of one on a wrist
            bias = pyro.sample(
                f"bias_{name}", dist.Normal(torch.zeros((), dtype=torch.float64), settings.bias)
            )
            along, covariance = apparent(camera, part, settings)
            farther = bias[..., None] * along
            seen = pyro.sample(f"seen_by_{name}", NormalPose(poses.retract(part, farther), covariance))
            stated = torch.as_tensor(camera.world_from_camera)
            moved = poses.compose(part, poses.inverse(poses.retract(seen, -farther)))
            known[name] = poses.compose(poses.inverse(stated), poses.compose(moved, stated)), bias
        error, bias = known[name]
        depth = RobustDepth(
            scene.renderer,
            camera,
            part,
            scale=settings.scale,
            outlier=settings.outlier,
            effective_pixels=settings.effective_pixels,
            camera_error=error,
            bias=bias,
        )
        pyro.sample(f"depth_{k}", depth)


def apparent(camera: Camera, part: Tensor, settings: Settings) -> tuple[Tensor, Tensor]:
    """How a camera's errors move what it sees of a part (N, 7), in the part's tangent space.

    Returns:
        What one metre of bias does, (N, 6), and the covariance (N, 6, 6) that an error of the stated pose
        makes: with an error of v along and w about the camera's axes, a part at p in them seems to be moved
        by -v + p x w and turned by -w.
    """
    stated = torch.as_tensor(camera.world_from_camera)
    place = poses.compose(poses.inverse(stated), part)[..., :3]
    from_camera = poses.rotation_matrix(stated).expand(*part.shape[:-1], 3, 3)
    unit = torch.eye(3, dtype=torch.float64).expand(*place.shape, 3)
    across = torch.linalg.cross(place[..., None, :].expand_as(unit), unit, dim=-1).transpose(-1, -2)
    turned = poses.rotation_matrix(part).transpose(-1, -2) @ from_camera
    upper = torch.cat([-from_camera, from_camera @ across], dim=-1)
    effect = torch.cat([upper, torch.cat([torch.zeros_like(turned), -turned], dim=-1)], dim=-2)
    spread = torch.tensor([settings.camera_shift] * 3 + [settings.camera_turn] * 3, dtype=torch.float64)
    along = (from_camera @ (place / place[..., 2:])[..., None])[..., 0]
    scaled = effect * spread
    return torch.cat([along, torch.zeros_like(along)], dim=-1), scaled @ scaled.transpose(-1, -2)


def prepare(recording: Recording, **settings: Any) -> Scene:
    """The scene of a recording; `settings` are fields of `Settings`."""
    chosen = Settings(**settings)
    looks: dict[str, Look] = {}
    for camera in (m.action.camera for m in recording.measurements if isinstance(m.action, View)):
        if camera.name not in looks:
            region = where_it_may_be(camera, recording)
            looks[camera.name] = Look(region, camera.cropped(*region).binned(chosen.bins))
    return Scene(prior_from_guess(recording.guess), DepthRenderer(recording.part), looks, chosen)


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

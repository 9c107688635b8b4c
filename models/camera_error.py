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
from bcppl.arguments import number_within, whole_number
from bcppl.distributions.depth import RobustDepth
from bcppl.distributions.poses import NormalPose, prior_from_guess
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera, bin_depth
from bcppl.rendering.region import region_of
from bcppl.rendering.renderer import DepthRenderer
from bcppl.rendering.stated_cameras import apparent_covariance, line_of_sight, seen_elsewhere
from bcppl.sensors import DepthImage, Measurement, Recording, View
from bcppl.traces import Model, Trace

# Logarithms of how far what a camera sees is moved, in spreads of the particles.
SIZES = torch.tensor([0.1, 1.5], dtype=torch.float64).log()


@dataclass(frozen=True)
class Cameras:
    """What is known of the cameras.

    Attributes:
        camera_shift, camera_turn: standard deviations of the error of a camera's stated pose, along and about
            each of its axes, metres and radians: what the extrinsic calibration reports.
        bias: standard deviation of what a camera adds to every range, metres.
        scale: of the Laplace noise, metres.
        outlier: the probability that a pixel shows something else than what is rendered.
        bins: so many pixels in each direction are read as one, the median of them.
    """

    camera_shift: float = 0.002
    camera_turn: float = math.radians(0.5)
    bias: float = 0.002
    scale: float = 0.002
    outlier: float = 0.1
    bins: int = 3

    def __post_init__(self) -> None:
        for name in ("camera_shift", "camera_turn", "bias", "scale"):
            number_within(
                f"a site's spread must be positive and {name} is {{}}", getattr(self, name), above=0.0
            )
        whole_number("a camera's images are read with bins {}", self.bins)


@dataclass(frozen=True)
class Settings(Cameras):
    """What is known of the cameras (`Cameras`), and what an image is worth.

    Attributes:
        effective_pixels: how many independent pixels an image is worth, all that are looked at; None for all:
            the errors hold what all pixels have in common, not what neighbours at an edge have.
    """

    effective_pixels: float | None = 100.0


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
    """The program: the part, each camera's bias, where it sees the part, and an image for every view."""
    settings = scene.settings
    part = pyro.sample("part", scene.prior)
    known: dict[str, tuple[Camera, Tensor, Tensor]] = {}
    for k, view in enumerate(actions):
        name, camera = view.camera.instrument, scene.looks[view.camera.name].camera
        if name not in known:  # one error for all views of one camera, also of one on a wrist
            bias = pyro.sample(
                f"bias_{name}", dist.Normal(torch.zeros((), dtype=torch.float64), settings.bias)
            )
            covariance = apparent_covariance(camera, part, settings.camera_shift, settings.camera_turn)
            seen = pyro.sample(f"seen_by_{name}", NormalPose(farther(camera, part, bias), covariance))
            known[name] = camera, farther(camera, seen, -bias), bias
        first, there, bias = known[name]
        if camera.name != first.name:
            there = seen_elsewhere(first, camera, part, there)
        depth = RobustDepth(
            scene.renderer,
            camera,
            there,
            scale=settings.scale,
            outlier=settings.outlier,
            effective_pixels=settings.effective_pixels,
            bias=bias,
        )
        pyro.sample(f"depth_{k}", depth)


def farther(camera: Camera, part: Tensor, bias: Tensor) -> Tensor:
    """Where a part (..., 7) seems to be when a bias (...,) in metres is added to the camera's ranges."""
    moved = part[..., :3] + bias[..., None] * line_of_sight(camera, part)
    return torch.cat([moved, part[..., 3:]], dim=-1)


def given_seen(
    scene: Any,
    looks: Mapping[str, tuple[Camera, Tensor, Tensor]],
    unsure: Mapping[str, Tensor] | None = None,
) -> NormalPose:
    """Nearly the conditional of the part's pose, given where cameras see it and their biases, by instrument.

    The product of the densities of `seen_by_*`, each taken as normal in the tangent space about the product's
    mean, on the axes that the prior leaves free. It hangs on nothing else, so a proposal that draws from it
    is nearly always accepted. Where only an estimate of what a camera sees is known, `unsure` has its
    covariance (6, 6), which adds to the camera's error.
    """
    settings, prior = scene.settings, scene.prior
    free = prior.freedom
    axes = list(free.axes)
    camera, seen, bias = next(iter(looks.values()))
    start = free.coordinates(poses.local(prior.center, farther(camera, seen, -bias)))
    center = poses.retract(prior.center, free.embed(start))
    for _ in range(2):  # the first centre is a few millimetres off, which changes the covariances by 1 %
        precision: Any = 0.0
        pull: Any = 0.0
        for name, (camera, seen, bias) in looks.items():
            covariance = apparent_covariance(camera, center, settings.camera_shift, settings.camera_turn)
            covariance = covariance if unsure is None else covariance + unsure[name]
            own = torch.linalg.inv(covariance)[..., axes, :]
            precision = precision + own[..., axes]
            pull = pull + own @ poses.local(center, farther(camera, seen, -bias))[..., None]
        covariance = torch.linalg.inv(precision)
        center = poses.retract(center, free.embed((covariance @ pull)[..., 0]))
    return NormalPose(center, 0.5 * (covariance + covariance.transpose(-1, -2)), free)


def looks_of(trace: Trace) -> dict[str, tuple[Camera, Tensor, Tensor]]:
    """Each instrument's first camera, where it sees the part (N, 7), and its bias (N,)."""
    scene, actions = trace.args
    first: dict[str, Camera] = {}
    for view in actions:
        first.setdefault(view.camera.instrument, scene.looks[view.camera.name].camera)
    return {name: (c, trace[f"seen_by_{name}"], trace[f"bias_{name}"]) for name, c in first.items()}


def part_anew(trace: Trace) -> None:
    """A proposal: the part from its conditional, given where the cameras see it. Nothing is rendered."""
    pyro.sample("part", given_seen(trace.args[0], looks_of(trace)))


def seen_and_part(trace: Trace, spreads: Mapping[str, Tensor]) -> None:
    """A proposal: all that the cameras see moves as one thing, each a little more, and the part to match.

    What two cameras see is tied by the part to half a degree, less than the images tell of its rotation: so
    neither could turn far alone. With the part drawn anew, it holds nothing back.
    """
    moved: dict[str, tuple[Camera, Tensor, Tensor]] = {}
    motion = poses.identity(1)
    for name, (camera, seen, bias) in looks_of(trace).items():
        address = f"seen_by_{name}"
        size = torch.exp(pyro.sample(f"step of {name}", dist.Uniform(*SIZES)))[..., None, None]
        around = NormalPose(poses.compose(motion, seen), size**2 * spreads[address])
        moved[name] = camera, pyro.sample(address, around), bias
        if len(moved) == 1:
            motion = poses.compose(moved[name][1], poses.inverse(seen))
    pyro.sample("part", given_seen(trace.args[0], moved))


def prepare(recording: Recording, **settings: Any) -> Scene:
    """The scene of a recording; `settings` are fields of `Settings`.

    Raises:
        InputError: a spread is not positive, or a camera cannot see the part near its guess.
    """
    chosen = Settings(**settings)
    guess = recording.guess
    within = float(np.linalg.norm(guess.translation))
    looks: dict[str, Look] = {}
    for camera in (m.action.camera for m in recording.measurements if isinstance(m.action, View)):
        if camera.name not in looks:
            region = region_of(camera, recording.part, guess.world_from_part, within, chosen.bins)
            looks[camera.name] = Look(region, camera.cropped(*region).binned(chosen.bins))
    return Scene(prior_from_guess(guess), DepthRenderer(recording.part), looks, chosen)


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


model = Model(
    program=camera_error,
    prepare=prepare,
    observe=observe,
    pose="part",
    invent=invent,
    proposals=(part_anew, seen_and_part),
)

"""A part is seen by a depth camera, among clutter that nobody has modelled.

The pose of a part is drawn from the prior, and every view is a depth image of it: Laplace noise where the ray
meets the part, something unknown where it does not or where something stands in the way. What is unknown goes
on from one pixel to the next. No mask is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import pyro
import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.distributions.depth import ClutteredDepth, RobustDepth
from bcppl.distributions.poses import prior_from_guess
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.renderer import DepthRenderer
from bcppl.rendering.scene import RendersPart
from bcppl.sensors import DepthImage, Measurement, Recording, View
from bcppl.traces import Model


@dataclass(frozen=True)
class Settings:
    """What is known of the camera.

    Attributes:
        scale: of the Laplace noise, metres.
        clutter: whether unknown things stand about the part and before it, that go on from pixel to pixel
            (`ClutteredDepth`). Otherwise, and wherever a background was measured, what is unknown is
            independent from pixel to pixel (`RobustDepth`).
        temperature: with clutter, what the log-likelihood is divided by. At 1 it tells where the part is;
            around there a belief is too sure, for a mesh, a camera's bias and a stated truth are off for all
            pixels together (on a real frame the stated truth has up to 463 nats less than the best particle,
            so a belief's spread there is not to be trusted).
        stride: every stride-th row and column is looked at with clutter, else every stride-th pixel in each
            direction.
        outlier: without clutter, the probability that a pixel on the part shows something else.
        effective_pixels: without clutter, how many independent pixels a whole image is worth, those that do
            not show the part included; None for all. Neighbouring pixels err together: with all, a belief is
            sure of errors.
    """

    scale: float = 0.005
    outlier: float = 0.05
    effective_pixels: float | None = 500.0
    stride: int = 4
    clutter: bool = True
    temperature: float = 1.0

    def __post_init__(self) -> None:
        number_within("a site's spread must be positive and scale is {}", self.scale, above=0.0)
        whole_number("part_in_view is given stride {}", self.stride)


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over a run: the part, its pose's prior, its renderer, and what may be seen."""

    part: Part
    prior: Any
    renderer: RendersPart
    background: Mapping[str, npt.NDArray[np.float64]]
    settings: Settings
    regions: dict[str, npt.NDArray[np.bool_]] = field(default_factory=dict)

    @property
    def efforts(self) -> Mapping[str, Effort]:
        """What each simulator has done so far."""
        return {"rendering": self.renderer.effort}

    def region(self, camera: Camera) -> npt.NDArray[np.bool_]:
        """The pixels that count: a grid of the given stride."""
        if camera.name not in self.regions:
            grid = np.zeros((camera.height, camera.width), dtype=bool)
            grid[:: self.settings.stride, :: self.settings.stride] = True
            self.regions[camera.name] = grid
        return self.regions[camera.name]


def part_in_view(scene: Scene, actions: Sequence[View]) -> None:
    """The program: the part's pose, then a depth image for every view."""
    part = pyro.sample("part", scene.prior)
    for k, view in enumerate(actions):
        pyro.sample(f"depth_{k}", depth(scene, view.camera, part))


def depth(scene: Scene, camera: Camera, part: Tensor) -> ClutteredDepth | RobustDepth:
    """The depth image of one view."""
    settings, background = scene.settings, scene.background.get(camera.name)
    if settings.clutter and background is None:
        return ClutteredDepth(
            scene.renderer,
            camera,
            part,
            settings.scale,
            lines=settings.stride,
            temperature=settings.temperature,
        )
    return RobustDepth(
        scene.renderer,
        camera,
        part,
        scale=settings.scale,
        outlier=settings.outlier,
        background=background,
        effective_pixels=settings.effective_pixels,
        region=scene.region(camera),
    )


def prepare(
    recording: Recording, renderer: Callable[[Part], RendersPart] = DepthRenderer, **settings: Any
) -> Scene:
    """The scene of a recording.

    Args:
        recording: what was measured.
        renderer: makes the renderer of the part, such as `bcppl.rendering.choice.renderer_for`.
        settings: fields of `Settings`.

    Raises:
        InputError: a spread is not positive, or the stride is no whole number of pixels.
    """
    return Scene(
        recording.part,
        prior_from_guess(recording.guess),
        renderer(recording.part),
        recording.background,
        Settings(**settings),
    )


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
                f"measurement {k} is a {measurement.kind} and part_in_view explains views only; "
                "choose another model."
            )
        values[f"depth_{k}"] = torch.from_numpy(image.depth)
    return values


model = Model(program=part_in_view, prepare=prepare, observe=observe, pose="part", climbs=240)

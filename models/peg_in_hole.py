"""BayesContact's program: a hole is seen by depth cameras, then touched with a peg on a compliant arm.

The part's pose is drawn from the prior. Images are explained by rendering (`CalibratedCamera`), the windows
of a probe by contact physics (`SimulatedProbe`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import pyro

from bcppl.distributions.poses import prior_from_guess
from bcppl.geometry.parts import Part
from bcppl.models.shipped import simulated_in
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.ray_casting import RayCaster
from bcppl.sensors.likelihoods.cameras import CalibratedCamera
from bcppl.sensors.likelihoods.simulated_probe import ProbeSettings, SimulatedProbe
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Scene, chosen, likelihoods_for, require_positive
from bcppl.traces import Model


@dataclass(frozen=True)
class DepthSettings:
    """Noise of a depth image.

    Attributes:
        depth_scale: of the Laplace noise, metres.
        outlier: the probability that a pixel shows something else than the rendered scene.
        effective_pixels: the number of independent pixels that an image is worth; the error of a camera's
            pose is common to all.
    """

    depth_scale: float = 0.003
    outlier: float = 0.1
    effective_pixels: float = 50.0

    def __post_init__(self) -> None:
        require_positive(self, "depth_scale")


def peg_in_hole(scene: Scene, actions: Sequence[Any]) -> None:
    """The program: the part's pose, then each measurement's sites by its sensor."""
    hole = pyro.sample("hole", scene.prior)
    for number, action in enumerate(actions):
        scene.sensor(action).observe(number, action, hole)


def prepare(
    recording: Recording, renderer: Callable[[Part], PartRenderer] = RayCaster, **settings: Any
) -> Scene:
    """The scene of a recording.

    Args:
        recording: of depth images and probe windows.
        renderer: makes the renderer of the part, such as `bcppl.rendering.rasterisation.renderer_for`.
        settings: fields of `DepthSettings` and `ProbeSettings`.

    Raises:
        InputError: a setting is unknown or out of range, there are probe windows and no peg, or the part
            cannot be touched.
    """
    depth, probe = chosen("peg_in_hole", settings, DepthSettings(), ProbeSettings())
    camera = CalibratedCamera(
        recording,
        renderer(recording.part),
        scale=depth.depth_scale,
        outlier=depth.outlier,
        effective_pixels=depth.effective_pixels,
    )
    likelihoods = likelihoods_for(
        recording, {"view": lambda _: camera, "window": partial(SimulatedProbe.prepare, settings=probe)}
    )
    return Scene(prior_from_guess(recording.guess), likelihoods, "peg_in_hole")


model = Model(
    program=peg_in_hole,
    prepare=prepare,
    observe=Scene.observed,
    pose="hole",
    simulate_recording=simulated_in("peg_in_hole"),
)

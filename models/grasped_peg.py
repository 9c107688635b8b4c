"""A peg whose pose in the hand is not as planned: the grasp is latent, like the part's pose.

`peg_in_hole` with one more site, and cameras without latent errors. Commands, the measured peg pose, the
wrench and contact locations are all in the frame of the grip, in which a peg held as planned would lie; only
the peg's surface is displaced, by `grip_from_peg`. While the hand keeps its orientation, a peg displaced by a
millimetre to the left gives the same contacts as a part displaced by a millimetre to the right. The camera
separates the two, or a second touch with the hand turned: half a turn about the peg's axis changes the sign
of one displacement and not of the other. That holds across the axis and not along it: the depth of the peg in
the hand is separated from the part's height by the camera alone, to the accuracy of its extrinsics.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import pyro
import torch

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.distributions.parameters import POSITIVE, PROBABILITY, check_parameters
from bcppl.distributions.poses import NormalPose, prior_from_guess
from bcppl.geometry.parts import Part
from bcppl.models.shipped import simulated_in
from bcppl.rendering.part_renderer import PartRenderer
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors.capabilities import Grasping
from bcppl.sensors.likelihoods.cameras import CalibratedCamera
from bcppl.sensors.likelihoods.screened_probe import simulated_probe
from bcppl.sensors.likelihoods.simulated_probe import ProbeSettings
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Scene, chosen, likelihoods_for
from bcppl.traces import Model

PROBE = ProbeSettings(evidence=("contacts", "pose"), normal_scale=0.0003)


@dataclass(frozen=True)
class DepthSettings:
    """Noise of a depth image.

    Attributes:
        scale: of the Laplace noise of a pixel, metres.
        outlier: the probability that a pixel shows something else than the rendered scene.
        effective_pixels: the number of independent pixels that an image is worth; the error of a camera's
            pose is common to all.
    """

    scale: float = field(default=0.003, metadata=POSITIVE)
    outlier: float = field(default=0.1, metadata=PROBABILITY)
    effective_pixels: float = field(default=50.0, metadata=POSITIVE)

    def __post_init__(self) -> None:
        check_parameters(self)


@dataclass(frozen=True, eq=False)
class GraspScene(Scene):
    """The scene, and the prior of the peg's pose in the hand."""

    hand: NormalPose


def grasped_peg(scene: GraspScene, actions: Sequence[Any]) -> None:
    """The program: the part's pose, the peg's pose in the hand, then each measurement's sites."""
    hole = pyro.sample("hole", scene.prior)
    grip_from_peg = pyro.sample("grip_from_peg", scene.hand)
    for number, action in enumerate(actions):
        sensor = scene.sensor(action)
        if isinstance(sensor, Grasping):
            sensor = sensor.grasping(grip_from_peg)
        sensor.observe(number, action, hole)


def by_known_cameras(
    recording: Recording, name: str, renderer: Callable[[Part], PartRenderer] = renderer_for, **settings: Any
) -> Scene:
    """The scene of a recording whose cameras have no latent errors, for tempered SMC, under a model's name.

    Args:
        recording: of depth images and probe windows.
        name: of the model, for messages.
        renderer: makes the renderer of the part; by default the one that is faster for its mesh.
        settings: fields of `DepthSettings` and `ProbeSettings`.

    Raises:
        InputError: a setting is unknown or out of range, there are probe windows and no peg, or the part
            cannot be touched.
    """
    depth, probe = chosen(name, settings, DepthSettings(), PROBE)
    camera = CalibratedCamera(recording, renderer(recording.part), **asdict(depth))
    windows = partial(simulated_probe, settings=probe)
    likelihoods = likelihoods_for(recording, {"view": lambda _: camera, "window": windows})
    return Scene(prior_from_guess(recording.guess), likelihoods, name)


def prepare(
    recording: Recording, grip_shift: float = 0.0015, grip_turn: float = math.radians(1.5), **settings: Any
) -> GraspScene:
    """The scene of a recording.

    Args:
        recording: of depth images and probe windows.
        grip_shift: standard deviation of the peg's position in the hand along each axis of the grip, metres.
        grip_turn: standard deviation of its orientation about each axis, radians.
        settings: as for `by_known_cameras`.

    Raises:
        InputError: a spread is not positive, grip_shift is longer than the peg or grip_turn beyond pi; or as
            `by_known_cameras`.
    """
    longest = math.inf if recording.peg is None else float(recording.peg.extent.max())
    for name, value, most in (("grip_shift", grip_shift, longest), ("grip_turn", grip_turn, math.pi)):
        what = (
            "how far a peg is off in the hand has a positive spread, in metres or radians (peg_in_hole takes "
            f"it to be exact); {name} is {{}}"
        )
        number_within(what, value, above=0.0, most=most)
    spread = torch.tensor([grip_shift] * 3 + [grip_turn] * 3, dtype=torch.float64)
    known = by_known_cameras(recording, "grasped_peg", **settings)
    return GraspScene(known.prior, known.likelihoods, "grasped_peg", NormalPose(poses.identity(), spread))


model = Model(
    program=grasped_peg,
    prepare=prepare,
    observe=Scene.observed,
    pose="hole",
    simulate_recording=simulated_in("grasped_peg"),
)

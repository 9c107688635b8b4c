"""A peg whose pose in the hand is not as planned: the grasp is latent, like the part's pose.

`peg_in_hole` with one more site. Commands, the measured peg pose, the wrench and contact locations are all in
the frame of the grip, in which a peg held as planned would lie; only the peg's surface is displaced, by
`grip_from_peg`. While the hand keeps its orientation, a peg displaced by a millimetre to the left gives the
same contacts as a part displaced by a millimetre to the right. The camera separates the two, or a second
touch with the hand turned: half a turn about the peg's axis changes the sign of one displacement and not of
the other. That holds across the axis and not along it: the depth of the peg in the hand is separated from the
part's height by the camera alone, to the accuracy of its extrinsics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pyro
import torch

from bcppl import poses
from bcppl.arguments import number_within
from bcppl.distributions.poses import NormalPose
from bcppl.models import peg_in_hole
from bcppl.models.shipped import simulated_in
from bcppl.sensors.capabilities import Grasping
from bcppl.sensors.measurements import Recording
from bcppl.sensors.scene import Scene
from bcppl.traces import Model


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


def prepare(
    recording: Recording, grip_shift: float = 0.0015, grip_turn: float = math.radians(1.5), **settings: Any
) -> GraspScene:
    """The scene of a recording.

    Args:
        recording: of depth images and probe windows.
        grip_shift: standard deviation of the peg's position in the hand along each axis of the grip, metres.
        grip_turn: standard deviation of its orientation about each axis, radians.
        settings: as for `peg_in_hole.prepare`.

    Raises:
        InputError: a spread is not positive, grip_shift is longer than the peg or grip_turn beyond pi; or as
            `peg_in_hole.prepare`.
    """
    longest = math.inf if recording.peg is None else float(recording.peg.extent.max())
    for name, value, most in (("grip_shift", grip_shift, longest), ("grip_turn", grip_turn, math.pi)):
        what = (
            f"a spread is in metres or radians, and positive unless the model is peg_in_hole; {name} is {{}}"
        )
        number_within(what, value, above=0.0, most=most)
    spread = torch.tensor([grip_shift] * 3 + [grip_turn] * 3, dtype=torch.float64)
    known = peg_in_hole.prepare(recording, **settings)
    return GraspScene(known.prior, known.likelihoods, "grasped_peg", NormalPose(poses.identity(), spread))


model = Model(
    program=grasped_peg,
    prepare=prepare,
    observe=Scene.observed,
    pose="hole",
    simulate_recording=simulated_in("grasped_peg"),
)

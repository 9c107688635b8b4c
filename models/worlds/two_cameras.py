"""A simulated bench: a block with a square hole before two depth cameras whose stated poses are in error.

The cameras' ranges are biased, and their images have the noise of real sensors. Inference reads nothing of it
but the recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from bcppl import poses
from bcppl.distributions.poses import SwingTwistPose
from bcppl.geometry.extrusion import block_with_square_hole
from bcppl.geometry.parts import Guess
from bcppl.models.worlds.peg_in_hole import GUESS, cameras, table
from bcppl.models.worlds.simulated_sensors import depth_image, draw_pose, perturbed
from bcppl.rendering.depth_noise import DepthNoise
from bcppl.rendering.scene import SceneRenderer
from bcppl.sensors import Measurement, Recording, View


@dataclass(frozen=True)
class WorldParameters:
    """Parameters of the bench: metres, radians, and standard deviations where nothing else is stated.

    Attributes:
        translation, tilt, yaw: limits of the prior of the block's pose.
        camera_shift, camera_turn: errors of the cameras' stated poses, along and about each axis.
        bias: of a camera's ranges.
        noise: of the depth images.
        views: of each camera.
    """

    translation: float = 0.02
    tilt: float = math.radians(10.0)
    yaw: float = math.radians(30.0)
    camera_shift: float = 0.002
    camera_turn: float = math.radians(0.5)
    bias: float = 0.002
    noise: DepthNoise = field(default_factory=DepthNoise)
    views: int = 1


def simulate_recording(seed: int, world: WorldParameters | None = None) -> Recording:
    """A recording of depth views by two cameras, the true pose drawn from the prior.

    Args:
        seed: same seed, same recording.
        world: parameters of the bench; the default ones unless given.
    """
    world = WorldParameters() if world is None else world
    generator = np.random.default_rng(seed)
    guess = poses.as_pose([*GUESS, 1.0, 0.0, 0.0, 0.0])
    prior = SwingTwistPose(guess, world.translation, world.tilt, world.yaw)
    truth = draw_pose(prior, int(generator.integers(2**62)))
    part, still = block_with_square_hole(hole=0.016, offset=(0.007, 0.005)), table()
    empty, bench = SceneRenderer([still]), SceneRenderer([part, still])
    both = torch.stack([truth, poses.identity()])
    measurements, background = [], {}
    for camera in cameras(generator):
        background[camera.name] = empty.background(camera, poses.identity(1))
        stated = torch.from_numpy(camera.world_from_camera)
        true_pose = perturbed(stated, world.camera_shift, world.camera_turn, generator)
        bias = generator.normal(scale=world.bias)
        seen = bench.images(replace(camera, world_from_camera=true_pose.numpy()), both)[0] + bias
        for _ in range(world.views):
            depth = world.noise.sample(camera, seen, generator)
            measurements.append(Measurement(View(camera), depth_image(depth)))
    return Recording(
        part=part,
        guess=Guess(guess.numpy(), np.full(3, world.translation), world.tilt, world.yaw),
        measurements=measurements,
        background=background,
        truth=truth.numpy(),
        model="camera_error",
        source=f"simulated by bcppl, seed {seed}",
    )

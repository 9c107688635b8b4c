"""A made-up bench: a block with a square hole before two depth cameras that are not where they say.

Each camera's stated pose is off, its ranges are biased, and its images have what real sensors add. Nothing
here is read by inference except the recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from bcppl import poses
from bcppl.distributions.poses import SwingTwistPose
from bcppl.geometry.extrusion import block_with_square_hole
from bcppl.geometry.guess import Guess
from bcppl.models.worlds.peg_in_hole import GUESS, cameras, shifted, table
from bcppl.rendering.depth_noise import DepthNoise
from bcppl.rendering.scene import SceneRenderer
from bcppl.sensors import DepthImage, Measurement, Recording, View


@dataclass(frozen=True)
class World:
    """What the bench is like: metres, radians, and standard deviations where nothing else is said.

    Attributes:
        translation, tilt, yaw: limits of the prior of the block's pose.
        camera_shift, camera_turn: how far off the cameras' stated poses are, along and about each axis.
        bias: what a camera adds to all its ranges.
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


def record(seed: int, world: World | None = None) -> Recording:
    """One recording: depth views of two cameras, the true pose drawn from the prior.

    Args:
        seed: same seed, same recording.
        world: the bench; the default one unless given.
    """
    world = World() if world is None else world
    generator = np.random.default_rng(seed)
    guess = poses.as_pose([*GUESS, 1.0, 0.0, 0.0, 0.0])
    prior = SwingTwistPose(guess, world.translation, world.tilt, world.yaw)
    with torch.random.fork_rng(devices=[]):
        # Inference may well be given the same seed, and must not draw the truth with it.
        torch.manual_seed(int(generator.integers(2**62)))
        truth = prior.sample()
    part, still = block_with_square_hole(hole=0.016, offset=(0.007, 0.005)), table()
    empty, bench = SceneRenderer([still]), SceneRenderer([part, still])
    both = torch.stack([truth, poses.identity()])
    measurements, background = [], {}
    for camera in cameras(generator):
        background[camera.name] = empty.background(camera, poses.identity(1))
        stated = torch.from_numpy(camera.world_from_camera)
        there = shifted(stated, world.camera_shift, world.camera_turn, generator)
        bias = generator.normal(scale=world.bias)
        seen = bench.images(replace(camera, world_from_camera=there.numpy()), both)[0] + bias
        for _ in range(world.views):
            depth = world.noise.sample(camera, seen, generator)
            image = DepthImage(depth.astype(np.float32).astype(np.float64))
            measurements.append(Measurement(View(camera), image))
    return Recording(
        part=part,
        guess=Guess(guess.numpy(), np.full(3, world.translation), world.tilt, world.yaw),
        measurements=measurements,
        background=background,
        truth=truth.numpy(),
        model="camera_error",
        source=f"simulated by bcppl, seed {seed}",
    )

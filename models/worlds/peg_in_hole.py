"""A simulated bench: a block with a square hole, two depth cameras, and an arm that probes it with a peg.

The world is simulated in finer steps and with other friction and contact stiffness than inference assumes,
and its cameras' stated poses are in error. Inference reads nothing of it but the recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.distributions.poses import SwingTwistPose
from bcppl.geometry.camera import Camera
from bcppl.geometry.extrusion import block, block_with_square_hole, box_peg
from bcppl.geometry.parts import Guess, Part
from bcppl.models.worlds.simulated_sensors import (
    ProbeErrors,
    depth_image,
    draw_pose,
    measured_windows,
    perturbed,
    smooth_path,
)
from bcppl.rendering.ray_casting import RayCaster
from bcppl.robot.motion import Probe
from bcppl.sensors import Measurement, Recording, View

# The world's contact: finer in time, more slippery and stiffer than inference assumes.
CONTACT = ContactParameters(time_step=0.0005, friction=0.2, time_constant=0.003)


@dataclass(frozen=True)
class WorldParameters(ProbeErrors):
    """Parameters of the bench: metres, radians, and standard deviations where nothing else is stated.

    Attributes:
        hole, clearance: side of the square hole, and its difference to the peg's.
        offset: of the hole in the block's frame.
        translation, tilt, yaw: limits of the prior of the block's pose.
        depth_noise: scale of the Laplace noise of a depth pixel.
        camera_shift, camera_turn: errors of the cameras' stated poses, along and about each axis.
        estimate_shift, estimate_turn: errors of the estimate that the probe is planned for, likewise.
        contact: the physics.
    """

    hole: float = 0.016
    clearance: float = 0.0005
    offset: tuple[float, float] = (0.007, 0.005)
    translation: float = 0.02
    tilt: float = math.radians(10.0)
    yaw: float = math.radians(30.0)
    depth_noise: float = 0.002
    camera_shift: float = 0.002
    camera_turn: float = math.radians(0.5)
    estimate_shift: float = 0.002
    estimate_turn: float = math.radians(1.0)
    contact: ContactParameters = CONTACT


PEG_LENGTH = 0.08
RATE, WINDOW = 100, 0.5  # samples and seconds
STIFFNESS = np.array([2500.0, 2500.0, 2500.0, 150.0, 150.0, 150.0])
DAMPING = np.array([120.0, 120.0, 120.0, 2.5, 2.5, 2.5])
GUESS = (0.5, 0.0, 0.15)  # m: the block's guessed position; the table's top is z = 0

# Metrology's 3-2-1: a press and slides on the top, the same on one side, a press on the next. Strokes end
# 7 mm inside the face, at 60 mm/s or less, so that they meet it in spite of errors of millimetres in the
# estimate; slides keep off the hole. A knot is a time (s) and a position of the tip (m) in the block's frame.
STROKE, CLEAR, DEEP = 0.007, 0.005, -0.014
SIDE = 0.03 + 0.00775
KNOTS = (
    (0.00, (-0.020, -0.019, 0.080)),
    (2.40, (-0.020, -0.019, CLEAR)),
    (2.90, (-0.020, -0.019, CLEAR)),
    (3.10, (-0.020, -0.019, -STROKE)),
    (3.60, (0.020, -0.019, -STROKE)),
    (4.05, (0.020, 0.018, -STROKE)),
    (4.20, (0.024, 0.018, CLEAR)),
    (4.40, (SIDE + CLEAR, 0.018, CLEAR)),
    (4.60, (SIDE + CLEAR, 0.018, DEEP)),
    (4.80, (SIDE - STROKE, 0.018, DEEP)),
    (5.20, (SIDE - STROKE, -0.018, DEEP)),
    (5.30, (SIDE + CLEAR, -0.018, DEEP)),
    (5.46, (SIDE + CLEAR, -SIDE - CLEAR, DEEP)),
    (5.64, (0.012, -SIDE - CLEAR, DEEP)),
    (5.82, (0.012, -SIDE + STROKE, DEEP)),
    (6.00, (0.012, -SIDE + STROKE, DEEP)),
)


def probe(world_from_estimate: torch.Tensor) -> Probe:
    """The six touches, planned for an estimate (7,) of the block's pose."""
    return probe_through("touches", KNOTS, world_from_estimate)


def probe_through(
    name: str, knots: tuple[tuple[float, tuple[float, float, float]], ...], world_from_estimate: torch.Tensor
) -> Probe:
    """A probe whose tip moves through knots in the frame of an estimate (7,), with its orientation.

    The motion between knots is straight, with corners rounded over 60 ms.
    """
    times, tip = smooth_path(np.array([t for t, _ in knots]), np.array([p for _, p in knots]))
    sensor = torch.from_numpy(tip + np.array([0.0, 0.0, PEG_LENGTH]))
    world_from_peg = world_from_estimate.expand(len(times), 7).clone()
    world_from_peg[:, :3] = poses.transform(world_from_estimate, sensor)
    stamps = np.arange(round(knots[-1][0] * RATE)) / RATE
    return Probe(name, times, world_from_peg.numpy(), STIFFNESS, DAMPING, stamps)


def cameras(generator: np.random.Generator) -> list[Camera]:
    """Two cameras 0.35 to 0.6 m from the guess, 30 to 60 degrees above the table, looking at it."""
    both = []
    heading = generator.uniform(0.0, 2.0 * math.pi)
    for k in range(2):
        distance = generator.uniform(0.35, 0.6)
        height = math.radians(generator.uniform(30.0, 60.0))
        around = heading + k * math.radians(90.0)
        back = np.array(
            [math.cos(height) * math.cos(around), math.cos(height) * math.sin(around), math.sin(height)]
        )
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(-back, right), -back], axis=1)
        quaternion = Rotation.from_matrix(axes).as_quat()[[3, 0, 1, 2]]
        pose = np.concatenate([np.array(GUESS) + distance * back, quaternion])
        both.append(Camera(f"camera_{k}", 160, 120, 160.0, 160.0, 79.5, 59.5, pose, near=0.1, far=2.0))
    return both


def table() -> Part:
    """The table's top as a thin slab, 2 m wide, its upper face at z = 0."""
    return block((2.0, 2.0, 0.01), "table")


def simulate_recording(seed: int, world: WorldParameters | None = None) -> Recording:
    """A recording of two depth views and a 6 s probe in twelve windows, the true pose drawn from the prior.

    Args:
        seed: same seed, same recording.
        world: parameters of the bench; the default ones unless given.
    """
    world = WorldParameters() if world is None else world
    generator = np.random.default_rng(seed)
    part = block_with_square_hole(hole=world.hole, offset=world.offset)
    peg = box_peg(world.hole - world.clearance, PEG_LENGTH)
    guess = poses.as_pose([*GUESS, 1.0, 0.0, 0.0, 0.0])
    prior = SwingTwistPose(guess, world.translation, world.tilt, world.yaw)
    truth = draw_pose(prior, int(generator.integers(2**62)))

    behind, renderer = RayCaster(table()), RayCaster(part)
    measurements, background = [], {}
    for camera in cameras(generator):
        background[camera.name] = behind.images(camera, poses.identity(1))[0]
        background[camera.name][~np.isfinite(background[camera.name])] = np.nan
        stated = torch.from_numpy(camera.world_from_camera)
        true_pose = perturbed(stated, world.camera_shift, world.camera_turn, generator)
        moved = replace(camera, world_from_camera=true_pose.numpy())
        depth = np.minimum(behind.images(moved, poses.identity(1))[0], renderer.images(moved, truth[None])[0])
        depth = depth + generator.laplace(scale=world.depth_noise, size=depth.shape)
        depth[~np.isfinite(depth) | (depth < camera.near) | (depth > camera.far)] = np.nan
        measurements.append(Measurement(View(camera), depth_image(depth)))

    action = probe(perturbed(truth, world.estimate_shift, world.estimate_turn, generator))
    rollout = PegPhysics(part, peg, world.contact).start(truth[None], action)
    rollout.advance(len(action.stamps))
    measurements += measured_windows(action, rollout, world, round(WINDOW * RATE), generator)
    return Recording(
        part=part,
        guess=Guess(guess.numpy(), np.full(3, world.translation), world.tilt, world.yaw),
        measurements=measurements,
        peg=peg,
        background=background,
        truth=truth.numpy(),
        model="peg_in_hole",
        source=f"simulated by bcppl, seed {seed}",
    )

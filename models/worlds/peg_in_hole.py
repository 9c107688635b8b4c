"""A made-up bench: a block with a square hole, two depth cameras, and an arm that probes it with a peg.

The world is simulated in finer steps and with other friction and contact stiffness than inference uses, and
its cameras do not stand where they say. Nothing here is read by inference except the recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.contact.touch import Touch
from bcppl.distributions.poses import SwingTwistPose
from bcppl.geometry.camera import Camera
from bcppl.geometry.extrusion import block, block_with_square_hole, box_peg
from bcppl.geometry.guess import Guess
from bcppl.geometry.parts import Part
from bcppl.rendering.ray_casting import RayCaster
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors import DepthImage, Measurement, Recording, View

Array = npt.NDArray[np.float64]

# The world's contact: finer in time, more slippery and harder than inference believes.
CONTACT = ContactParameters(time_step=0.0005, friction=0.2, time_constant=0.003)


@dataclass(frozen=True)
class World:
    """What the bench is like: metres, radians, and standard deviations where nothing else is said.

    Attributes:
        hole, clearance: side of the square hole, and how much narrower the peg is.
        offset: where the hole is in the block's frame.
        translation, tilt, yaw: limits of the prior of the block's pose.
        depth_noise: scale of the Laplace noise of a depth pixel.
        camera_shift, camera_turn: how far off the cameras' stated poses are, along and about each axis.
        estimate_shift, estimate_turn: how far off the look is that the probe is laid out by, likewise.
        force_noise, torque_noise: of the wrench, N and N m.
        force_bias, torque_bias: of the untared sensor's zero, N and N m.
        peg_noise, peg_turn: of the peg's measured pose.
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
    force_noise: float = 0.1
    torque_noise: float = 0.005
    force_bias: float = 1.0
    torque_bias: float = 0.05
    peg_noise: float = 0.00005
    peg_turn: float = math.radians(0.02)
    contact: ContactParameters = CONTACT


PEG_LENGTH = 0.08
RATE, WINDOW = 100, 0.5  # samples and seconds
STIFFNESS = np.array([2500.0, 2500.0, 2500.0, 150.0, 150.0, 150.0])
DAMPING = np.array([120.0, 120.0, 120.0, 2.5, 2.5, 2.5])
GUESS = (0.5, 0.0, 0.15)  # m: where the block is thought to be; the table's top is z = 0

# Metrology's 3-2-1: a press and slides on the top, the same on one side, a press on the next. Strokes go 7 mm
# past the face, so that a look that is off by millimetres still meets it, at 60 mm/s or less; slides keep off
# the hole. A knot says when (s) the tip is where (m, in the block's frame).
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


def probe(world_from_look: torch.Tensor) -> Probe:
    """The six touches laid out around where a look says that the block is, `world_from_look` (7,).

    Between knots the tip goes straight, its corners rounded over 60 ms; the peg keeps the look's orientation.
    """
    times, places = np.array([t for t, _ in KNOTS]), np.array([p for _, p in KNOTS])
    fine = np.arange(0.0, 6.0 + 1e-9, 0.005)
    straight = np.stack([np.interp(fine, times, places[:, axis]) for axis in range(3)], axis=1)
    tip = uniform_filter1d(straight, 12, axis=0, mode="nearest")
    sensor = torch.from_numpy(tip + np.array([0.0, 0.0, PEG_LENGTH]))
    world_from_peg = world_from_look.expand(len(fine), 7).clone()
    world_from_peg[:, :3] = poses.transform(world_from_look, sensor)
    stamps = np.arange(round(6.0 * RATE)) / RATE
    return Probe("touches", fine, world_from_peg.numpy(), STIFFNESS, DAMPING, stamps)


def cameras(generator: np.random.Generator) -> list[Camera]:
    """Two cameras 0.35 to 0.6 m from the guess, 30 to 60 degrees above the table, looking at it."""
    found = []
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
        found.append(Camera(f"camera_{k}", 160, 120, 160.0, 160.0, 79.5, 59.5, pose, near=0.1, far=2.0))
    return found


def shifted(pose: torch.Tensor, shift: float, turn: float, generator: np.random.Generator) -> torch.Tensor:
    """A pose (7,) moved by normal errors along (m) and about (rad) its axes."""
    error = generator.normal(size=6) * np.array([shift] * 3 + [turn] * 3)
    return poses.retract(pose, torch.from_numpy(error))


def _seen_from(camera: Camera, pose: torch.Tensor) -> Camera:
    return Camera(**{**camera.__dict__, "world_from_camera": pose.numpy()})


def table() -> Part:
    """The table's top as a thin slab, 2 m wide, its upper face at z = 0."""
    return block((2.0, 2.0, 0.01), "table")


def record(seed: int, world: World | None = None) -> Recording:
    """One recording: two depth views and a 6 s probe in twelve windows, the true pose drawn from the prior.

    Args:
        seed: same seed, same recording.
        world: the bench; the default one unless given.
    """
    world = World() if world is None else world
    generator = np.random.default_rng(seed)
    part = block_with_square_hole(hole=world.hole, offset=world.offset)
    peg = box_peg(world.hole - world.clearance, PEG_LENGTH)
    guess = poses.as_pose([*GUESS, 1.0, 0.0, 0.0, 0.0])
    prior = SwingTwistPose(guess, world.translation, world.tilt, world.yaw)
    with torch.random.fork_rng(devices=[]):
        # Inference may well be given the same seed, and must not draw the truth with it.
        torch.manual_seed(int(generator.integers(2**62)))
        truth = prior.sample()

    behind, renderer = RayCaster(table()), RayCaster(part)
    measurements, background = [], {}
    for camera in cameras(generator):
        background[camera.name] = behind.images(camera, poses.identity(1))[0]
        background[camera.name][~np.isfinite(background[camera.name])] = np.nan
        believed = torch.from_numpy(camera.world_from_camera)
        there = _seen_from(camera, shifted(believed, world.camera_shift, world.camera_turn, generator))
        depth = np.minimum(behind.images(there, poses.identity(1))[0], renderer.images(there, truth[None])[0])
        depth = depth + generator.laplace(scale=world.depth_noise, size=depth.shape)
        depth[~np.isfinite(depth) | (depth < camera.near) | (depth > camera.far)] = np.nan
        measurements.append(
            Measurement(View(camera), DepthImage(depth.astype(np.float32).astype(np.float64)))
        )

    action = probe(shifted(truth, world.estimate_shift, world.estimate_turn, generator))
    rollout = PegPhysics(part, peg, world.contact).start(truth[None], action)
    rollout.advance(len(action.stamps))
    count = len(action.stamps)
    noise = generator.normal(size=(count, 6)) * ([world.force_noise] * 3 + [world.torque_noise] * 3)
    bias = generator.normal(size=6) * ([world.force_bias] * 3 + [world.torque_bias] * 3)
    wrench = rollout.wrench[0] + noise + bias
    wobble = generator.normal(size=(count, 6)) * ([world.peg_noise] * 3 + [world.peg_turn] * 3)
    world_from_peg = poses.retract(
        torch.from_numpy(rollout.world_from_peg[0].copy()), torch.from_numpy(wobble)
    ).numpy()
    step = round(WINDOW * RATE)
    for first in range(0, count, step):
        rows = slice(first, first + step)
        touch = Touch(action.stamps[rows], wrench[rows], world_from_peg[rows])
        measurements.append(Measurement(ProbeWindow(action, first, first + step), touch))

    widths = np.full(3, world.translation)
    return Recording(
        part=part,
        guess=Guess(guess.numpy(), widths, world.tilt, world.yaw),
        measurements=measurements,
        peg=peg,
        background=background,
        truth=truth.numpy(),
        model="peg_in_hole",
        source=f"simulated by bcppl, seed {seed}",
    )

"""A made-up plate with four equal holes: a near camera sees one, and a pin touches two places beside it.

Which hole is seen and where it is are drawn; the plate lies accordingly. The pin goes down where that hole
would have a neighbour to its right, and where it would have one behind it: into a hole or onto the plate.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
import torch
import trimesh
from scipy.ndimage import uniform_filter1d

from bcppl import poses
from bcppl.contact.physics import PegPhysics
from bcppl.contact.touch import Touch
from bcppl.distributions.poses import SwingTwistPose
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.extrusion import box_peg
from bcppl.geometry.guess import Guess
from bcppl.geometry.parts import Part, Piece
from bcppl.models.which_hole import HOLES, PITCH
from bcppl.models.worlds import peg_in_hole as bench
from bcppl.rendering.ray_casting import RayCaster
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors import DepthImage, Measurement, Recording, View

HOLE, PIN, MARGIN, THICK = 0.018, 0.008, 0.03, 0.02
CLEAR, STROKE = 0.005, 0.006
# From near by a look is better than from where a whole part is in view.
WORLD = bench.World(estimate_shift=0.001)
# When (s) the tip is to be where (m, in the frame of the seen hole).
KNOTS = (
    (0.0, (PITCH, 0.0, 0.015)),
    (0.3, (PITCH, 0.0, CLEAR)),
    (0.5, (PITCH, 0.0, -STROKE)),
    (0.8, (PITCH, 0.0, -STROKE)),
    (1.0, (PITCH, 0.0, CLEAR)),
    (1.4, (0.0, PITCH, CLEAR)),
    (1.6, (0.0, PITCH, -STROKE)),
    (2.0, (0.0, PITCH, -STROKE)),
)


def plate() -> Part:
    """The plate, its frame in the first hole, z up out of its top face."""
    low, high = -0.5 * HOLE - MARGIN, PITCH + 0.5 * HOLE + MARGIN
    inner = [shapely.box(x - 0.5 * HOLE, y - 0.5 * HOLE, x + 0.5 * HOLE, y + 0.5 * HOLE) for x, y in HOLES]
    outline = shapely.Polygon(shapely.box(low, low, high, high).exterior, [each.exterior for each in inner])
    mesh = trimesh.creation.extrude_polygon(outline, THICK)
    vertices = np.asarray(mesh.vertices, dtype=np.float64) - np.array([0.0, 0.0, THICK])
    # Strips from edge to edge, along y between the columns of holes and along x between the rows.
    cuts = [low, -0.5 * HOLE, 0.5 * HOLE, PITCH - 0.5 * HOLE, PITCH + 0.5 * HOLE, high]
    pieces = []
    for first, last in zip(cuts[::2], cuts[1::2], strict=True):
        across, middle = 0.5 * (last - first), 0.5 * (first + last)
        along, center = 0.5 * (high - low), 0.5 * (low + high)
        for half, place in (((across, along), (middle, center)), ((along, across), (center, middle))):
            pieces.append(Piece("box", np.array([*half, 0.5 * THICK]), np.array([*place, -0.5 * THICK])))
    part = Part("plate with four holes", vertices, np.asarray(mesh.faces, dtype=np.int64), pieces)
    part.check()
    return part


def probe(world_from_look: torch.Tensor) -> Probe:
    """Two presses beside where a look says that the hole is, `world_from_look` (7,)."""
    times, places = np.array([t for t, _ in KNOTS]), np.array([p for _, p in KNOTS])
    fine = np.arange(0.0, times[-1] + 1e-9, 0.005)
    straight = np.stack([np.interp(fine, times, places[:, axis]) for axis in range(3)], axis=1)
    tip = uniform_filter1d(straight, 12, axis=0, mode="nearest")
    command = world_from_look.expand(len(fine), 7).clone()
    sensor = torch.from_numpy(tip + np.array([0.0, 0.0, bench.PEG_LENGTH]))
    command[:, :3] = poses.transform(world_from_look, sensor)
    stamps = np.arange(round(times[-1] * bench.RATE)) / bench.RATE
    return Probe("neighbours", fine, command.numpy(), bench.STIFFNESS, bench.DAMPING, stamps)


def which(seed: int) -> int:
    """Which hole is seen in a recording."""
    return int(np.random.default_rng([seed, 1]).integers(len(HOLES)))


def record(seed: int, world: bench.World | None = None) -> Recording:
    """One recording: a depth image of one hole, and a 2 s probe in four windows.

    Args:
        seed: same seed, same recording.
        world: noise and contact of the bench; `WORLD` unless given.
    """
    world = WORLD if world is None else world
    part, pin = plate(), box_peg(PIN, bench.PEG_LENGTH, name="pin")
    generator = np.random.default_rng([seed, 2])
    guess, widths = poses.as_pose([*bench.GUESS, 1.0, 0.0, 0.0, 0.0]), np.full(3, 0.005)
    tilt, yaw = math.radians(3.0), math.radians(5.0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(generator.integers(2**62)))
        hole = SwingTwistPose(guess, torch.from_numpy(widths), tilt, yaw).sample()
    beside = poses.identity()
    beside[:2] = -torch.tensor(HOLES[which(seed)], dtype=torch.float64)
    world_from_plate = poses.compose(hole, beside)

    # 22 mm of the plate are in view: no neighbour and no edge.
    target = np.array(bench.GUESS)
    eye = looking_at(target + np.array([0.03, -0.05, 0.25]), target)
    camera = Camera("near", 60, 60, 700.0, 700.0, 29.5, 29.5, np.asarray(eye), near=0.1, far=1.0)
    stood = torch.from_numpy(camera.world_from_camera)
    there = bench.shifted(stood, world.camera_shift, world.camera_turn, generator).numpy()
    renderer = RayCaster(part)
    depth = renderer.images(Camera(**{**camera.__dict__, "world_from_camera": there}), world_from_plate[None])
    image = depth[0] + generator.laplace(scale=world.depth_noise, size=depth[0].shape)
    image[~np.isfinite(image)] = np.nan
    seen = DepthImage(image.astype(np.float32).astype(np.float64))
    measurements = [Measurement(View(camera), seen)]

    action = probe(bench.shifted(hole, world.estimate_shift, world.estimate_turn, generator))
    count = len(action.stamps)
    rollout = PegPhysics(part, pin, world.contact).start(world_from_plate[None], action).advance(count)
    noise = generator.normal(size=(count, 6)) * ([world.force_noise] * 3 + [world.torque_noise] * 3)
    bias = generator.normal(size=6) * ([world.force_bias] * 3 + [world.torque_bias] * 3)
    wobble = generator.normal(size=(count, 6)) * ([world.peg_noise] * 3 + [world.peg_turn] * 3)
    pose = poses.retract(torch.from_numpy(rollout.world_from_peg[0].copy()), torch.from_numpy(wobble)).numpy()
    for first in range(0, count, 50):
        rows = slice(first, first + 50)
        touch = Touch(action.stamps[rows], rollout.wrench[0, rows] + noise[rows] + bias, pose[rows])
        measurements.append(Measurement(ProbeWindow(action, first, first + 50), touch))
    return Recording(
        part=part,
        guess=Guess(guess.numpy(), widths, tilt, yaw),
        measurements=measurements,
        peg=pin,
        truth=hole.numpy(),
        model="which_hole",
        source=f"simulated by bcppl, seed {seed}",
    )

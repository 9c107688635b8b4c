"""A simulated plate with four equal holes: a near camera sees one, and a pin touches two points beside it.

The hole in view and its pose are drawn, and with them the plate's pose. The pin descends where that hole
would have a neighbour to its right, and where it would have one behind it: into a hole or onto the plate.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import shapely
import torch
import trimesh

from bcppl import poses
from bcppl.contact.physics import PegPhysics
from bcppl.distributions.poses import SwingTwistPose
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.extrusion import box_peg
from bcppl.geometry.parts import Guess, Part, Piece
from bcppl.models.which_hole import HOLES, PITCH
from bcppl.models.worlds import peg_in_hole as bench
from bcppl.models.worlds.simulated_sensors import depth_image, draw_pose, measured_windows, perturbed
from bcppl.rendering.ray_casting import RayCaster
from bcppl.robot.motion import Probe
from bcppl.sensors import Measurement, Recording, View

HOLE, PIN, MARGIN, THICK = 0.018, 0.008, 0.03, 0.02
CLEAR, STROKE = 0.005, 0.006
_WINDOW = 50  # samples
# A near camera's estimate is better than that of one with the whole part in view.
WORLD = bench.WorldParameters(estimate_shift=0.001)
# Times (s) and positions of the tip (m, in the frame of the hole in view).
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


def probe(world_from_estimate: torch.Tensor) -> Probe:
    """Two presses beside a hole, planned for an estimate (7,) of its pose."""
    return bench.probe_through("neighbours", KNOTS, world_from_estimate)


def which(seed: int) -> int:
    """The number of the hole in view in a recording."""
    return int(np.random.default_rng([seed, 1]).integers(len(HOLES)))


def simulate_recording(seed: int, world: bench.WorldParameters | None = None) -> Recording:
    """A recording of a depth image of one hole, and a 2 s probe in four windows.

    Args:
        seed: same seed, same recording.
        world: noise and contact of the bench; `WORLD` unless given.
    """
    world = WORLD if world is None else world
    part, pin = plate(), box_peg(PIN, bench.PEG_LENGTH, name="pin")
    generator = np.random.default_rng([seed, 2])
    guess, widths = poses.as_pose([*bench.GUESS, 1.0, 0.0, 0.0, 0.0]), np.full(3, 0.005)
    tilt, yaw = math.radians(3.0), math.radians(5.0)
    prior = SwingTwistPose(guess, torch.from_numpy(widths), tilt, yaw)
    hole = draw_pose(prior, int(generator.integers(2**62)))
    beside = poses.identity()
    beside[:2] = -torch.tensor(HOLES[which(seed)], dtype=torch.float64)
    world_from_plate = poses.compose(hole, beside)

    # 22 mm of the plate are in view: no neighbour and no edge.
    target = np.array(bench.GUESS)
    eye = looking_at(target + np.array([0.03, -0.05, 0.25]), target)
    camera = Camera("near", 60, 60, 700.0, 700.0, 29.5, 29.5, np.asarray(eye), near=0.1, far=1.0)
    stated = torch.from_numpy(camera.world_from_camera)
    true_pose = perturbed(stated, world.camera_shift, world.camera_turn, generator)
    moved = replace(camera, world_from_camera=true_pose.numpy())
    image = RayCaster(part).images(moved, world_from_plate[None])[0]
    image = image + generator.laplace(scale=world.depth_noise, size=image.shape)
    image[~np.isfinite(image)] = np.nan

    action = probe(perturbed(hole, world.estimate_shift, world.estimate_turn, generator))
    rollout = PegPhysics(part, pin, world.contact).start(world_from_plate[None], action)
    rollout.advance(len(action.stamps))
    measurements = [
        Measurement(View(camera), depth_image(image)),
        *measured_windows(action, rollout, world, _WINDOW, generator),
    ]
    return Recording(
        part=part,
        guess=Guess(guess.numpy(), widths, tilt, yaw),
        measurements=measurements,
        peg=pin,
        truth=hole.numpy(),
        model="which_hole",
        source=f"simulated by bcppl, seed {seed}",
    )

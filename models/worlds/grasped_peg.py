"""A simulated bench like that of `peg_in_hole`, but the peg's pose in the hand is not as planned.

The block is touched on its top and on two sides, then on the same sides with the hand turned by half a turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from bcppl import poses
from bcppl.contact.nuisances import Nuisances
from bcppl.contact.physics import PegPhysics
from bcppl.models.worlds import peg_in_hole as bench
from bcppl.models.worlds.simulated_sensors import measured_windows, perturbed, smooth_path
from bcppl.robot.motion import Probe
from bcppl.sensors.measurements import Recording

_WINDOW = 80  # samples


@dataclass(frozen=True)
class WorldParameters(bench.WorldParameters):
    """Parameters of the bench.

    Attributes:
        grip_shift, grip_turn: standard deviations of the peg's pose in the hand, along and about each axis of
            the grip, metres and radians.
    """

    grip_shift: float = 0.0015
    grip_turn: float = math.radians(1.5)


STROKE, CLEAR, DEEP, SIDE = bench.STROKE, bench.CLEAR, bench.DEEP, bench.SIDE
# Times (s), positions of the tip (m, in the block's frame), and turns of the hand (half turns).
KNOTS = (
    (0.00, (-0.020, -0.019, 0.020), 0.0),
    (0.30, (-0.020, -0.019, CLEAR), 0.0),
    (0.50, (-0.020, -0.019, -STROKE), 0.0),
    (0.80, (-0.020, -0.019, -STROKE), 0.0),
    (1.00, (-0.020, -0.019, CLEAR), 0.0),
    (1.30, (SIDE + CLEAR, 0.000, CLEAR), 0.0),
    (1.50, (SIDE + CLEAR, 0.000, DEEP), 0.0),
    (1.70, (SIDE - STROKE, 0.000, DEEP), 0.0),
    (1.90, (SIDE - STROKE, 0.000, DEEP), 0.0),
    (2.10, (SIDE + CLEAR, 0.000, DEEP), 0.0),
    (2.40, (SIDE + CLEAR, -SIDE - CLEAR, DEEP), 0.0),
    (2.60, (0.000, -SIDE - CLEAR, DEEP), 0.0),
    (2.80, (0.000, -SIDE + STROKE, DEEP), 0.0),
    (3.00, (0.000, -SIDE + STROKE, DEEP), 0.0),
    (3.20, (0.000, -SIDE - 3 * CLEAR, DEEP), 0.0),
    (4.00, (0.000, -SIDE - 3 * CLEAR, DEEP), 1.0),
    (4.30, (0.000, -SIDE + STROKE, DEEP), 1.0),
    (4.50, (0.000, -SIDE + STROKE, DEEP), 1.0),
    (4.70, (0.000, -SIDE - CLEAR, DEEP), 1.0),
    (4.90, (SIDE + CLEAR, -SIDE - CLEAR, DEEP), 1.0),
    (5.20, (SIDE + CLEAR, 0.000, DEEP), 1.0),
    (5.40, (SIDE - STROKE, 0.000, DEEP), 1.0),
    (5.60, (SIDE - STROKE, 0.000, DEEP), 1.0),
)


def probe(world_from_estimate: torch.Tensor) -> Probe:
    """The touches, planned for an estimate (7,) of the block's pose."""
    times, path = smooth_path(
        np.array([t for t, _, _ in KNOTS]), np.array([[*position, turn] for _, position, turn in KNOTS])
    )
    estimate_from_peg = poses.identity(len(times))
    estimate_from_peg[:, :3] = torch.from_numpy(path[:, :3] + np.array([0.0, 0.0, bench.PEG_LENGTH]))
    half = torch.from_numpy(0.5 * math.pi * path[:, 3])
    estimate_from_peg[:, 3], estimate_from_peg[:, 6] = torch.cos(half), torch.sin(half)
    command = poses.compose(world_from_estimate.expand(len(times), 7), estimate_from_peg).numpy()
    stamps = np.arange(round(KNOTS[-1][0] * bench.RATE)) / bench.RATE
    return Probe("turned touches", times, command, bench.STIFFNESS, bench.DAMPING, stamps)


def grip_from_peg(seed: int, world: WorldParameters | None = None) -> torch.Tensor:
    """The true pose (7,) of the peg in the hand of a recording."""
    world = WorldParameters() if world is None else world
    generator = np.random.default_rng([seed, 1])
    return perturbed(poses.identity(), world.grip_shift, world.grip_turn, generator)


def simulate_recording(seed: int, world: WorldParameters | None = None) -> Recording:
    """A recording of two depth views and a 5.6 s probe in seven windows.

    Args:
        seed: same seed, same recording.
        world: parameters of the bench; the default ones unless given.
    """
    world = WorldParameters() if world is None else world
    upright = bench.simulate_recording(seed, world)
    assert upright.peg is not None and upright.truth is not None
    truth, generator = torch.from_numpy(upright.truth), np.random.default_rng([seed, 2])
    action = probe(perturbed(truth, world.estimate_shift, world.estimate_turn, generator))
    held = Nuisances(grip_from_peg=grip_from_peg(seed, world)[None])
    physics = PegPhysics(upright.part, upright.peg, world.contact)
    rollout = physics.start(truth[None], action, held).advance(len(action.stamps))
    measurements = [m for m in upright.measurements if m.kind == "view"]
    measurements += measured_windows(action, rollout, world, _WINDOW, generator)
    return replace(upright, measurements=measurements, model="grasped_peg")

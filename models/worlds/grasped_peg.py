"""A made-up bench like that of `peg_in_hole`, but the peg sits in the hand not quite as planned.

The block is touched on its top and on two sides, then on the same sides with the hand turned by half a turn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import uniform_filter1d

from bcppl import poses
from bcppl.contact.nuisances import Nuisances
from bcppl.contact.physics import PegPhysics
from bcppl.contact.touch import Touch
from bcppl.models.worlds import peg_in_hole as bench
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors.measurements import Measurement, Recording


@dataclass(frozen=True)
class World(bench.World):
    """What the bench is like.

    Attributes:
        grip_shift, grip_turn: how far off the peg sits in the hand, along and about each axis of the grip,
            standard deviations, metres and radians.
    """

    grip_shift: float = 0.0015
    grip_turn: float = math.radians(1.5)


STROKE, CLEAR, DEEP, SIDE = bench.STROKE, bench.CLEAR, bench.DEEP, bench.SIDE
# When (s) the tip is to be where (m, in the block's frame), and how far the hand is turned (half turns).
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


def probe(world_from_look: torch.Tensor) -> Probe:
    """The touches laid out around where a look says that the block is, `world_from_look` (7,)."""
    times, places = np.array([t for t, _, _ in KNOTS]), np.array([[*p, turn] for _, p, turn in KNOTS])
    fine = np.arange(0.0, times[-1] + 1e-9, 0.005)
    straight = np.stack([np.interp(fine, times, places[:, axis]) for axis in range(4)], axis=1)
    smooth = uniform_filter1d(straight, 12, axis=0, mode="nearest")
    look_from_peg = poses.identity(len(fine))
    look_from_peg[:, :3] = torch.from_numpy(smooth[:, :3] + np.array([0.0, 0.0, bench.PEG_LENGTH]))
    half = torch.from_numpy(0.5 * math.pi * smooth[:, 3])
    look_from_peg[:, 3], look_from_peg[:, 6] = torch.cos(half), torch.sin(half)
    command = poses.compose(world_from_look.expand(len(fine), 7), look_from_peg).numpy()
    stamps = np.arange(round(times[-1] * bench.RATE)) / bench.RATE
    return Probe("turned touches", fine, command, bench.STIFFNESS, bench.DAMPING, stamps)


def grip_from_peg(seed: int, world: World | None = None) -> torch.Tensor:
    """Where the peg really sits in the hand of a recording, (7,)."""
    world = World() if world is None else world
    generator = np.random.default_rng([seed, 1])
    return bench.shifted(poses.identity(), world.grip_shift, world.grip_turn, generator)


def record(seed: int, world: World | None = None) -> Recording:
    """One recording: two depth views and a 5.6 s probe in seven windows.

    Args:
        seed: same seed, same recording.
        world: the bench; the default one unless given.
    """
    world = World() if world is None else world
    seen = bench.record(seed, world)
    assert seen.peg is not None and seen.truth is not None
    truth, generator = torch.from_numpy(seen.truth), np.random.default_rng([seed, 2])
    action = probe(bench.shifted(truth, world.estimate_shift, world.estimate_turn, generator))
    count = len(action.stamps)
    held = Nuisances(grip_from_peg=grip_from_peg(seed, world)[None])
    rollout = PegPhysics(seen.part, seen.peg, world.contact).start(truth[None], action, held).advance(count)
    noise = generator.normal(size=(count, 6)) * ([world.force_noise] * 3 + [world.torque_noise] * 3)
    bias = generator.normal(size=6) * ([world.force_bias] * 3 + [world.torque_bias] * 3)
    wobble = generator.normal(size=(count, 6)) * ([world.peg_noise] * 3 + [world.peg_turn] * 3)
    grip = poses.retract(torch.from_numpy(rollout.world_from_peg[0].copy()), torch.from_numpy(wobble)).numpy()
    measurements = [m for m in seen.measurements if m.kind == "view"]
    for first in range(0, count, 80):
        rows = slice(first, first + 80)
        touch = Touch(action.stamps[rows], rollout.wrench[0, rows] + noise[rows] + bias, grip[rows])
        measurements.append(Measurement(ProbeWindow(action, first, first + 80), touch))
    changed = {"measurements": measurements, "model": "grasped_peg"}
    return Recording(**{**seen.__dict__, **changed})

"""Short-touch cases: a peg held by a spring is pressed once onto the edge of a block."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pyro

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.contact.probe_rollout import ProbeRollout
from bcppl.contact.sensing.location import ContactSensing
from bcppl.distributions.contact import ChamferContacts, ContactsInTime
from bcppl.distributions.poses import UniformPose
from bcppl.geometry.extrusion import block, box_peg
from bcppl.inference.filters.tempered_smc import kernel as shipped
from bcppl.robot.motion import Probe
from bcppl.traces.carried import carried
from tests.calibration.case import Case

RATE, STAMPS, LENGTH = 100, 24, 0.05
BLOCK, PEG = block((0.04, 0.04, 0.02)), box_peg(0.01, LENGTH)
CENTER = poses.as_pose([0.4, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0])


def pressed() -> Probe:
    """Down from 7 mm above the block's top to 5 mm below it, half of the peg over the block's edge."""
    times = np.array([0.0, 0.05, 0.2, 0.24])
    command = np.tile(np.array([0.42, 0.0, 0.1 + LENGTH, 1.0, 0.0, 0.0, 0.0]), (4, 1))
    command[:, 2] += np.array([0.007, 0.007, -0.005, -0.005])
    stiffness, damping = np.repeat([2500.0, 150.0], 3), np.repeat([120.0, 2.5], 3)
    return Probe("press", times, command, stiffness, damping, np.arange(STAMPS) / RATE)


PROBE = pressed()
PHYSICS = PegPhysics(BLOCK, PEG, ContactParameters(time_step=0.005))
SENSING = ContactSensing(PEG, rate=RATE, tare=4)
# The block may be beside where it is thought to be, above it, and tilted about the edge that is pressed.
PRIOR = UniformPose(CENTER, (0.004, 0.0, 0.003), 0.15, rotation="y")
EFFORT: dict[str, Any] = {"sweeps": 8, "share": 0.6, "particles": 75, "settling": 24}


class Felt:
    """The program: a pose, and the contacts felt from stamp 4 (after the sensor's zero) to the end."""

    def __init__(self, scale: float = 0.001, surrogate: bool = False) -> None:
        self.scale, self.surrogate = scale, surrogate

    def __call__(self, count: int) -> None:
        pose = pyro.sample("pose", PRIOR)
        if count:
            begin = partial(ProbeRollout.start, PHYSICS, SENSING, pose, PROBE)
            track = carried("press", begin)
            seen: Any
            if self.surrogate:
                seen = ChamferContacts(track, 4, STAMPS, self.scale, 2.0 * (3.0 * self.scale) ** 2)
            else:
                seen = ContactsInTime(track, 4, STAMPS, self.scale, every=3)
            pyro.sample("seen", seen)


def touched(scale: float = 0.001, believed: float | None = None) -> Case:
    """One press, by the normalised contact likelihood."""
    program, inferred = Felt(scale), Felt(believed or scale)
    return Case(program, CENTER, PRIOR.freedom, shipped("pose"), inferred, **EFFORT)


def surrogate() -> Case:
    """The same press by the Chamfer surrogate, whose `sample` is a model of its own: coverage only."""
    program = Felt(0.002, surrogate=True)
    return Case(program, CENTER, PRIOR.freedom, shipped("pose"), program, **EFFORT)

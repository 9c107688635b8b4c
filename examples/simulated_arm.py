"""A simulated arm beside a part, for trying programs, and its clock.

    python simulated_arm.py --seed 31000 --look look.h5

writes what the bench's two cameras see.
"""

from __future__ import annotations

import argparse
import threading
import time
from typing import Literal

import mujoco
import numpy as np
import torch

from bcppl import poses, save
from bcppl.arrays import Array
from bcppl.contact.mujoco_model import build_model
from bcppl.geometry.parts import Part
from bcppl.models.worlds import bench_scene
from bcppl.models.worlds.bench.scene import BenchScene

DAMPED = 0.06, 0.016  # s: damping over stiffness, along and about
PATIENCE = 0.5  # s that the clock waits for a command, at the client's pace
NOISE = np.array([0.15] * 3 + [0.005] * 3)  # N, N m

Pace = Literal["clock", "client"]


class SimulatedArm:
    """A peg on a spring to a commanded pose, beside a part, in MuJoCo.

    Args:
        scene: of the bench.
        tick: s that it advances at a time.
    """

    def __init__(self, scene: BenchScene, tick: float) -> None:
        self.model = build_model(scene.part, scene.peg, scene.contact)
        self.model.opt.timestep = 0.0005
        self._steps = round(tick / self.model.opt.timestep)
        self.data = mujoco.MjData(self.model)
        self._noise = np.random.default_rng([scene.seed, 77])
        start = start_of(scene, scene.peg)
        self.data.qpos[:7] = start
        self._place(1, scene.truth)
        self.command(start, np.full(6, 2500.0))

    def command(self, world_from_peg: Array, stiffness: Array) -> None:
        """Follow a pose (7,) by a spring of stiffness (6,): N/m along, N m/rad about the peg's axes."""
        self._place(0, world_from_peg)
        damping = stiffness * np.repeat(DAMPED, 3)
        self.model.actuator_biasprm[:, 1] = -stiffness
        self.model.actuator_biasprm[:, 2] = -damping

    def advance(self) -> tuple[Array, Array]:
        """The pose (7,) and the wrench (6,) in the peg's frame, one tick later."""
        for _ in range(self._steps):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        sensed = self.data.sensordata
        return sensed[:7].copy(), -sensed[7:13] + NOISE * self._noise.normal(size=6)

    def _place(self, number: int, pose: Array) -> None:
        self.data.mocap_pos[number], self.data.mocap_quat[number] = pose[:3], pose[3:]


class Clock:
    """When a simulated arm moves on: in real time, or with each command of the client.

    At the client's pace a slow machine loses nothing.
    """

    def __init__(self, pace: Pace) -> None:
        self.pace, self._begun = pace, time.monotonic()
        self._commanded, self._follows = threading.Event(), False

    def command(self) -> None:
        """Say that there is a command."""
        self._follows = True
        self._commanded.set()

    def wait(self, stamp: float) -> None:
        """Wait until a simulated time (s since the beginning) is over."""
        if self.pace == "client" and self._follows:
            self._commanded.wait(PATIENCE)
            self._commanded.clear()
        elif (left := self._begun + stamp - time.monotonic()) > 0.0:
            time.sleep(left)


def start_of(scene: BenchScene, peg: Part) -> Array:
    """A pose (7,) of the peg, upright, its tip 60 mm above the middle of the guess."""
    upright = poses.identity().numpy().copy()
    upright[:3] = torch.from_numpy(scene.guess.world_from_part)[:3].numpy()
    upright[2] += 0.06 - float(peg.vertices[:, 2].min())
    return np.asarray(upright)


def options(description: str | None) -> argparse.ArgumentParser:
    """The options that all stand-ins have."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=31000, help="of the bench")
    parser.add_argument("--look", default="look.h5", help="file for what the cameras see")
    return parser


def main() -> None:
    """Write what the cameras see."""
    arguments = options(__doc__).parse_args()
    save(bench_scene(arguments.seed).look(), arguments.look)


if __name__ == "__main__":
    main()

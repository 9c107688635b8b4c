"""The arm and the cameras of a bench scene, asked to do one thing after another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.models.worlds.bench import BenchScene
from bcppl.models.worlds.inserting import InsertionResult
from bcppl.robot.insertion_plan import InsertionPlan
from bcppl.sensors import DepthImage, Measurement
from bcppl.sensors.candidates import Candidate, motion_of

Array = npt.NDArray[np.float64]

_BETWEEN = 0.5  # s from the end of one probe to the beginning of the next
_VIEWS = 9  # what cameras that come later are drawn from, beside what the scene is


class BenchArm:
    """A world for `bcppl.inference.design.loop`, which remembers the time and where its sensor has drifted.

    The first plan is felt as in `BenchScene.probe`; every other has new noise, and a zero that has walked on.
    A camera that the scene does not know stands off from where it says, and has a range bias, as the scene's
    cameras do; one that shares its device with one of these, by the same.

    Attributes:
        scene: the bench scene.
        clock: seconds; when the next plan begins.
    """

    def __init__(self, scene: BenchScene) -> None:
        self.scene = scene
        self.clock = 0.0
        self._sensors = scene.sensors()
        self._looking = np.random.default_rng([scene.seed, _VIEWS])
        self._off: dict[str, tuple[Array, float]] = {}
        for camera, stands, bias in zip(
            scene.cameras, scene.world_from_cameras, scene.range_bias, strict=True
        ):
            off = poses.local(torch.from_numpy(camera.world_from_camera), torch.from_numpy(stands))
            self._off[camera.instrument] = off.numpy(), float(bias)

    def execute(self, candidate: Candidate) -> list[Measurement]:
        """What is measured: the windows of a plan, on a clock that goes on, or an image.

        Raises:
            InputError: it is asked for something else.
        """
        motion = motion_of(candidate)
        if motion is None:
            return [Measurement(candidate, self._look(candidate.camera))]
        began = candidate.times[0]
        plan = replace(candidate, times=candidate.times - began + self.clock)
        self.clock = float(plan.times[-1]) + _BETWEEN
        return self.scene.felt(plan, self._sensors)

    def insert(self, plan: InsertionPlan) -> InsertionResult:
        """An insertion as it truly went.

        Raises:
            InputError: what is given is no plan of one.
        """
        if not isinstance(plan, InsertionPlan):
            raise InputError(
                f"the arm is asked to insert by a {type(plan).__name__}; give what `insertion_plan` makes."
            )
        return self.scene.insert(plan, self._sensors)

    def _look(self, camera: Camera) -> DepthImage:
        bench = self.scene.bench
        if camera.instrument not in self._off:
            spread = np.array([bench.camera_shift] * 3 + [bench.camera_turn] * 3) * bench.camera_error_factor
            off = spread * self._looking.normal(size=6)
            self._off[camera.instrument] = off, float(self._looking.normal(scale=bench.range_bias))
        off, bias = self._off[camera.instrument]
        stands = poses.retract(torch.as_tensor(camera.world_from_camera), torch.from_numpy(off))
        depth = self.scene.depth_from(replace(camera, world_from_camera=stands.numpy()))
        read = bench.depth_noise.sample(camera, depth + bias, self._looking)
        return DepthImage(read.astype(np.float32).astype(np.float64))

"""The arm and the cameras of a bench scene, which execute one candidate after another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.geometry.camera import Camera
from bcppl.models.worlds.bench.scene import BenchScene
from bcppl.models.worlds.inserting import InsertionResult
from bcppl.models.worlds.simulated_sensors import depth_image, per_axis
from bcppl.robot.plan import InsertionPlan
from bcppl.sensors import DepthImage, Measurement
from bcppl.sensors.candidates import Candidate, motion_of

_BETWEEN = 0.5  # s from the end of one probe to the beginning of the next
_VIEWS = 9  # stream of random numbers for further cameras


class BenchArm:
    """A world for `bcppl.inference.design.loop`, with a clock and a drifting wrench sensor.

    The first plan is measured as in `BenchScene.probe`; every other has new noise, and a bias that has
    drifted. A camera that is not the scene's has an error of its stated pose and a range bias like those; one
    of the same device has the same.

    Attributes:
        scene: the bench scene.
        clock: seconds; when the next plan begins.
    """

    def __init__(self, scene: BenchScene) -> None:
        self.scene = scene
        self.clock = 0.0
        self._errors = scene.sensor_errors()
        self._views = np.random.default_rng([scene.seed, _VIEWS])
        self._cameras: dict[str, tuple[Array, float]] = {}  # by device, error of the pose and range bias
        true_poses, bias = scene.world_from_cameras, scene.range_bias
        for k, camera in enumerate(scene.cameras):
            stated, true_pose = torch.from_numpy(camera.world_from_camera), torch.from_numpy(true_poses[k])
            self._cameras[camera.instrument] = poses.local(stated, true_pose).numpy(), float(bias[k])

    def execute(self, candidate: Candidate) -> list[Measurement]:
        """The measurements of a candidate: the windows of a plan, later than those before it, or an image.

        Raises:
            InputError: it is of no known kind.
        """
        motion = motion_of(candidate)
        if motion is None:
            return [Measurement(candidate, self._look(candidate.camera))]
        plan = replace(candidate, times=candidate.times - candidate.times[0] + self.clock)
        self.clock = float(plan.times[-1]) + _BETWEEN
        return self.scene.measure(plan, self._errors)

    def insert(self, plan: InsertionPlan) -> InsertionResult:
        """The true result of an insertion."""
        return self.scene.insert(plan, self._errors)

    def _look(self, camera: Camera) -> DepthImage:
        bench = self.scene.bench
        if camera.instrument not in self._cameras:
            spread = per_axis(bench.camera_shift, bench.camera_turn) * bench.camera_error_factor
            error = spread * self._views.normal(size=6)
            self._cameras[camera.instrument] = error, float(self._views.normal(scale=bench.range_bias))
        error, bias = self._cameras[camera.instrument]
        true_pose = poses.retract(torch.as_tensor(camera.world_from_camera), torch.from_numpy(error))
        depth = self.scene.depth_from(replace(camera, world_from_camera=true_pose.numpy()))
        read = bench.depth_noise.sample(camera, depth + bias, self._views)
        return depth_image(read)

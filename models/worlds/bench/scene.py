"""The bench of the accuracy benchmark: seven parts, two depth cameras, and an arm that executes plans.

Scenes differ in part, clearance, pose, cameras and their errors, friction, stiffness and damping of contacts.
Inference reads nothing of it but the recording, and no parameter is shared with a model.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from bcppl import poses
from bcppl.arguments import seed_number
from bcppl.arrays import Array
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.distributions.poses import SwingTwistPose
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.extrusion import block, peg_for
from bcppl.geometry.parts import Guess, Part
from bcppl.geometry.turns import turns_freely
from bcppl.models.worlds.bench.errors import DrawnErrors, drawn_errors
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.parts import PARTS, PEG_LENGTH, BenchPart, bench_part
from bcppl.models.worlds.bench.reality import BenchReality
from bcppl.models.worlds.guarded_motion import Execution, execute
from bcppl.models.worlds.inserting import InsertionResult, insert, samples_of
from bcppl.models.worlds.occlusion import occluder
from bcppl.models.worlds.simulated_sensors import (
    SensorErrors,
    depth_image,
    draw_pose,
    per_axis,
    windows,
)
from bcppl.rendering.scene import SceneRenderer
from bcppl.robot.commands import stamps_of
from bcppl.robot.plan import InsertionPlan, Plan
from bcppl.sensors import DepthImage, Measurement, Recording, View

# Streams of random numbers: a given part or plan changes no other draw of a scene.
_CHOICE, _POSE, _CAMERAS, _CONTACT, _IMAGES = range(5)  # those after are in simulated_sensors


@dataclass(frozen=True, eq=False)
class BenchScene:
    """One scene of the bench: its true parameters, and its recordings.

    Attributes:
        seed: same seed, same scene.
        bench: parameters that it was drawn from.
        kind: the part with its hole's outline and place.
        clearance: of hole and peg, diametral, metres.
        peg: the held peg, as it is stated; `true_peg` is what it is.
        guess: the prior of the part's pose.
        truth: (7,) true `world_from_part` before any touch. The target of inference is the pose after the
            probe, which a recording states; they differ where the part slides.
        contact: the world's physics.
        cameras: the two cameras, with their stated poses.
        world_from_cameras: (2, 7) their true poses.
        range_bias: (2,) of their ranges, metres.
        hidden_view: the camera behind the occluder; None without one.
    """

    seed: int
    bench: BenchParameters
    kind: BenchPart
    clearance: float
    peg: Part
    guess: Guess
    truth: Array
    contact: ContactParameters
    cameras: Sequence[Camera]
    world_from_cameras: Array
    range_bias: Array
    hidden_view: int | None

    @property
    def part(self) -> Part:
        """The part with the hole."""
        return self.kind.part

    @property
    def friction(self) -> float:
        """The coefficient between peg and part."""
        return self.contact.friction

    @property
    def name(self) -> str:
        """The part and the clearance in words."""
        return f"{self.kind.name}, {1000 * self.clearance:g} mm"

    def look(self) -> Recording:
        """The recording of the two views alone."""
        return self._recording((), self.truth)

    def probe(self, plan: Plan) -> Recording:
        """The recording of the same two views and of an executed plan, in windows."""
        touches = self.measure(plan)
        return self._recording(touches, self.reality.part_at())

    def measure(self, plan: Plan, errors: SensorErrors | None = None) -> list[Measurement]:
        """The windows of an executed plan, with the sensors' next errors, or those of their first use."""
        execution, wrench, world_from_peg = self.execute(plan, errors)
        length = max(1, round(self.bench.window * plan.rate))
        return windows(execution.probe, wrench, world_from_peg, length)

    def execute(self, plan: Plan, errors: SensorErrors | None = None) -> tuple[Execution, Array, Array]:
        """The true execution of a plan, and the measured wrench (T, 6) and peg poses (T, 7).

        With the errors of an earlier use what has slipped stays so; without, everything is as at first.
        """
        errors = errors or self.sensor_errors()
        reality = errors.reality or self._fresh()
        self._executed[:] = [reality]
        error, pose_error = errors.sample(len(stamps_of(plan)), plan.rate)
        reality.begin(plan)
        execution = execute(plan, self.part, self.true_peg, self.contact, self.truth, error, reality=reality)
        measured = poses.retract(torch.from_numpy(execution.encoders), torch.from_numpy(pose_error)).numpy()
        return execution, execution.felt + error, measured

    def insert(self, plan: InsertionPlan, errors: SensorErrors | None = None) -> InsertionResult:
        """The true result of an insertion, with peg and part where the executed plans have left them."""
        error, pose_error = (errors or self.sensor_errors()).sample(samples_of(plan), plan.search.rate)
        hole, peg = self.kind.part_from_hole, self.true_peg
        return insert(plan, self.part, peg, self.contact, self.truth, hole, error, pose_error, self.reality)

    def sensor_errors(self) -> SensorErrors:
        """The errors of the sensors, from the first sample on, on a bench on which nothing has slipped."""
        return SensorErrors(self.bench, self.seed, self._fresh())

    # ---- what is really the case

    @functools.cached_property
    def drawn(self) -> DrawnErrors:
        """The errors of this scene's robot, grasp and parts."""
        is_round = self.bench.errors.grasp_yaw > 0.0 and turns_freely(self.peg)
        return drawn_errors(self.seed, self.bench.errors, self.clearance, is_round=is_round)

    @functools.cached_property
    def true_peg(self) -> Part:
        """The peg as it is, in the frame of the stated one."""
        radius, length = self.drawn.peg_growth
        if not (radius or length):
            return self.peg
        return peg_for(self.kind.hole, self.clearance - 2.0 * radius, PEG_LENGTH + length, self.peg.name)

    @property
    def reality(self) -> BenchReality:
        """Where arm, peg and part truly are after the last executed plan."""
        return self._executed[0] if self._executed else self._fresh()

    def apparent(self, world_from_peg: Array) -> Array:
        """The pose (7,) of the part relative to the peg: the one that an errorless robot would believe.

        With the peg measured at a pose, without force, after the slips of the executed plans: the
        `world_from_part` at which the part would be as it truly is relative to the peg. It is the truth
        where nothing is wrong, and the right one to plan an insertion for.

        Args:
            world_from_peg: (7,) pose at which the robot's encoders state the peg.
        """
        return self.reality.apparent(world_from_peg)

    @functools.cached_property
    def _executed(self) -> list[BenchReality]:
        """The reality of the last executed plan; empty before any."""
        return []

    def _fresh(self) -> BenchReality:
        return BenchReality(self.drawn, self.truth)

    def _recording(self, touches: Sequence[Measurement], truth: Array) -> Recording:
        images, background = self._views
        views = [Measurement(View(c), i) for c, i in zip(self.cameras, images, strict=True)]
        return Recording(
            part=self.part,
            guess=self.guess,
            measurements=[*views, *touches],
            peg=self.peg,
            background=background,
            truth=truth,
            model="look_and_touch",
            source=f"simulated by bcppl, accuracy bench, seed {self.seed}: {self.name}",
        )

    @functools.cached_property
    def _views(self) -> tuple[list[DepthImage], dict[str, Array]]:
        """The images of the two cameras, and of the table alone from their stated poses."""
        generator = _generator(self.seed, _IMAGES)
        images, background = [], {}
        empty = SceneRenderer([_table()])
        for k, camera in enumerate(self.cameras):
            background[camera.name] = empty.background(camera, poses.identity(1))
            depth = self.true_depth(k) + self.range_bias[k]
            read = self.bench.depth_noise.sample(camera, depth, generator)
            images.append(depth_image(read))
        return images, background

    def true_depth(self, view: int) -> Array:
        """The depth (H, W) in metres from a camera's true pose, without noise or bias."""
        camera = replace(self.cameras[view], world_from_camera=self.world_from_cameras[view])
        return self.depth_from(camera, hidden=view == self.hidden_view)

    def depth_from(self, camera: Camera, hidden: bool = False) -> Array:
        """The depth (H, W) in metres of a camera without error, with the occluder or without."""
        parts, world_from_parts = [self.part, _table()], [torch.from_numpy(self.truth), poses.identity()]
        if hidden:
            angle = _generator(self.seed, _CAMERAS, 1).uniform(0.0, 2.0 * math.pi)
            box, pose = occluder(camera, self.part, self.truth, self.bench.hidden, angle)
            parts.append(box)
            world_from_parts.append(torch.from_numpy(pose))
        return SceneRenderer(parts).images(camera, torch.stack(world_from_parts))[0]


def bench_scene(
    seed: int, bench: BenchParameters | None = None, part: str | None = None, clearance: float | None = None
) -> BenchScene:
    """One scene of the bench.

    Args:
        seed: same seed, same scene; a given part or clearance changes nothing else of it.
        bench: parameters that it is drawn from; the default ones unless given.
        part: a name in `parts.PARTS`; drawn unless given.
        clearance: diametral, metres; drawn unless given.

    Raises:
        InputError: the seed is no whole number from 0, there is no such part, or its hole takes no peg with
            that clearance.
    """
    seed = seed_number(seed)
    bench = BenchParameters() if bench is None else bench
    choice = _generator(seed, _CHOICE)
    drawn_part, drawn_clearance = choice.integers(len(PARTS)), choice.integers(len(bench.clearances))
    kind = bench_part(list(PARTS)[drawn_part] if part is None else part)
    clearance = bench.clearances[drawn_clearance] if clearance is None else float(clearance)
    centre = np.array([*bench.top[:2], bench.top[2] - kind.part_from_hole[2], 1.0, 0.0, 0.0, 0.0])
    guess = Guess(centre, np.full(3, bench.translation), bench.tilt, bench.yaw)
    cameras, true_poses, bias, hidden = _cameras(seed, bench)
    return BenchScene(
        seed=seed,
        bench=bench,
        kind=kind,
        clearance=clearance,
        peg=kind.peg(clearance),
        guess=guess,
        truth=_truth(seed, guess),
        contact=_contact(seed, bench),
        cameras=cameras,
        world_from_cameras=true_poses,
        range_bias=bias,
        hidden_view=hidden,
    )


def simulate_recording(seed: int, **options: Any) -> Recording:
    """The two views of `bench_scene(seed, **options)`: a part that is not yet touched."""
    return bench_scene(seed, **options).look()


def _truth(seed: int, guess: Guess) -> Array:
    prior = SwingTwistPose(
        torch.from_numpy(guess.world_from_part), torch.from_numpy(guess.translation), guess.tilt, guess.yaw
    )
    return np.asarray(draw_pose(prior, int(_generator(seed, _POSE).integers(2**62))).numpy())


def _cameras(seed: int, bench: BenchParameters) -> tuple[list[Camera], Array, Array, int | None]:
    """The cameras as stated, their true poses and range biases, and the one behind the occluder."""
    generator, top = _generator(seed, _CAMERAS), np.array(bench.top)
    heading = generator.uniform(0.0, 2.0 * math.pi)
    spread = bench.camera_error_factor * per_axis(bench.camera_shift, bench.camera_turn)
    cameras, true_poses, bias = [], [], []
    for k in range(2):
        distance, height = generator.uniform(*bench.distance), generator.uniform(*bench.height)
        around = heading + k * bench.around
        flat, up = math.cos(height), math.sin(height)
        eye = top + distance * np.array([flat * math.cos(around), flat * math.sin(around), up])
        pose = looking_at(eye, top)
        size, focal = (bench.width, bench.rows), bench.focal
        middle = (0.5 * (size[0] - 1), 0.5 * (size[1] - 1))
        cameras.append(Camera(f"camera_{k}", *size, focal, focal, *middle, pose, near=0.1, far=2.0))
        error = torch.from_numpy(spread * generator.normal(size=6))
        true_poses.append(poses.retract(torch.from_numpy(pose), error).numpy())
        bias.append(generator.normal(scale=bench.range_bias))
    which = int(generator.integers(2))
    return cameras, np.stack(true_poses), np.array(bias), which if bench.occluder else None


def _contact(seed: int, bench: BenchParameters) -> ContactParameters:
    generator = _generator(seed, _CONTACT)
    friction = generator.uniform(*bench.friction)
    factors = bench.contact_factor ** generator.uniform(-1.0, 1.0, size=2)
    return ContactParameters(
        time_step=bench.time_step,
        friction=float(friction),
        time_constant=bench.time_constant * float(factors[0]),
        damping_ratio=bench.damping_ratio * float(factors[1]),
    )


def _generator(seed: int, *stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, *stream])


@functools.cache
def _table() -> Part:
    """The table's top as a thin slab, 2 m wide, its upper face at z = 0."""
    return block((2.0, 2.0, 0.01), "table")

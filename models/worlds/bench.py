"""The bench of the accuracy benchmark: seven parts, two depth cameras, and an arm that carries out a plan.

Every scene is another: part, clearance, pose, cameras and their errors, friction, stiffness and damping of
contacts. None of it is read by inference except the recording, and no parameter is shared with a model.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import torch

from bcppl import poses
from bcppl.arguments import number_within, seed_number
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.touch import Touch
from bcppl.distributions.poses import SwingTwistPose
from bcppl.geometry.camera import Camera, looking_at
from bcppl.geometry.extrusion import block
from bcppl.geometry.guess import Guess
from bcppl.geometry.parts import Part
from bcppl.models.worlds.bench_parts import PARTS, BenchPart, bench_part
from bcppl.models.worlds.bench_sensors import SensorErrors
from bcppl.models.worlds.guarded_motion import Execution, execute, stamps_of
from bcppl.models.worlds.inserting import InsertionResult, insert, samples_of
from bcppl.models.worlds.occlusion import occluder
from bcppl.rendering.depth_noise import DepthNoise
from bcppl.rendering.scene import SceneRenderer
from bcppl.robot.insertion_plan import InsertionPlan
from bcppl.robot.motion import ProbeWindow
from bcppl.robot.plan import Plan
from bcppl.sensors import DepthImage, Measurement, Recording, View

Array = npt.NDArray[np.float64]

# What is drawn for a scene is drawn apart, so that giving a part or a plan changes nothing else.
_CHOICE, _POSE, _CAMERAS, _CONTACT, _IMAGES = range(5)  # those after are in bench_sensors


@dataclass(frozen=True)
class Bench:
    """What the bench is like: metres, radians, newtons, seconds; standard deviations where nothing is said.

    Attributes:
        clearances: diametral; one is drawn per scene.
        top: (3,) where the centre of the part's top face is thought to be; the table's top is z = 0.
        translation, tilt, yaw: limits of the prior of the part's pose.
        distance, height, around: of a camera: from where the top is thought to be, above the table (from
            there), and between the headings of the two.
        width, rows, focal: of the images, pixels.
        depth_noise: of the depth images.
        camera_shift, camera_turn: how far off the cameras' stated poses are, along and about each axis.
        camera_error_factor: how much farther off they are than that, for cameras worse than they say.
        range_bias: what a camera adds to all its ranges.
        occluder: whether a box that no recording speaks of hides a part of the part from one camera.
        hidden: the share of the part's pixels that it hides.
        force_noise, torque_noise: of each sample of the wrench, N and N m.
        force_bias, torque_bias: of the sensor's zero at the start, N and N m.
        force_drift, torque_drift: how far the zero has walked after `drift_time` (s), N and N m.
        peg_noise, peg_turn: of each sample of the peg's measured pose.
        window: how long (s) a window of a probe is.
        time_step: of the physics.
        friction: limits between which the coefficient is drawn.
        time_constant, damping_ratio: of contacts, in the middle; drawn per scene, uniformly in the logarithm.
        contact_factor: up to this factor either way.
    """

    clearances: tuple[float, ...] = (0.0001, 0.0002, 0.0005, 0.001)
    top: tuple[float, float, float] = (0.5, 0.0, 0.15)
    translation: float = 0.02
    tilt: float = math.radians(10.0)
    yaw: float = math.radians(30.0)
    distance: tuple[float, float] = (0.35, 0.6)
    height: tuple[float, float] = (math.radians(30.0), math.radians(60.0))
    around: float = math.radians(90.0)
    width: int = 160
    rows: int = 120
    focal: float = 160.0
    depth_noise: DepthNoise = field(
        default_factory=lambda: DepthNoise(scale=0.002, step=0.001, dropout=0.05, flying=0.5)
    )
    camera_shift: float = 0.002
    camera_turn: float = math.radians(0.5)
    camera_error_factor: float = 1.0
    range_bias: float = 0.002
    occluder: bool = False
    hidden: float = 1.0 / 3.0
    force_noise: float = 0.1
    torque_noise: float = 0.005
    force_bias: float = 1.0
    torque_bias: float = 0.05
    force_drift: float = 0.3
    torque_drift: float = 0.015
    drift_time: float = 6.0
    peg_noise: float = 0.00005
    peg_turn: float = math.radians(0.02)
    window: float = 0.5
    time_step: float = 0.0005
    friction: tuple[float, float] = (0.1, 0.5)
    time_constant: float = 0.004
    damping_ratio: float = 1.0
    contact_factor: float = 2.0

    def __post_init__(self) -> None:
        number_within("the bench has camera_error_factor {}", self.camera_error_factor, least=0.0)
        number_within("the bench hides a share {} of the part", self.hidden, above=0.0, most=1.0)
        number_within("the bench has windows of {} s", self.window, above=0.0)


@dataclass(frozen=True, eq=False)
class BenchScene:
    """One scene of the bench: all that is true of it, and the recordings that can be made of it.

    Attributes:
        seed: same seed, same scene.
        bench: what it was drawn from.
        kind: the part with its hole's outline and place.
        clearance: of hole and peg, diametral, metres.
        peg: what the arm holds.
        guess: what is known of the part's pose beforehand.
        truth: (7,) true `world_from_part`.
        contact: the world's physics.
        cameras: the two cameras, their poses as stated.
        world_from_cameras: (2, 7) where they truly stand.
        range_bias: (2,) what each adds to its ranges, metres.
        hidden_view: which camera the occluder stands before; None where there is none.
    """

    seed: int
    bench: Bench
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
        """The part that is looked for."""
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
        return self._recording(())

    def probe(self, plan: Plan) -> Recording:
        """The recording of the same two views and of a plan carried out, in windows."""
        return self._recording(self.felt(plan))

    def felt(self, plan: Plan, sensors: SensorErrors | None = None) -> list[Measurement]:
        """The windows of a plan carried out; with the sensors' next errors, or those of their first use."""
        carried, wrench, world_from_peg = self.executed(plan, sensors)
        probe, step = carried.probe, max(1, round(self.bench.window * plan.rate))
        windows = []
        for first in range(0, len(probe.stamps), step):
            rows = slice(first, min(first + step, len(probe.stamps)))
            touch = Touch(probe.stamps[rows], wrench[rows], world_from_peg[rows])
            windows.append(Measurement(ProbeWindow(probe, rows.start, rows.stop), touch))
        return windows

    def executed(self, plan: Plan, sensors: SensorErrors | None = None) -> tuple[Execution, Array, Array]:
        """A plan as it was truly carried out, and the wrench (T, 6) and peg poses (T, 7) measured then."""
        error, wobble = (sensors or self.sensors()).drawn(len(stamps_of(plan)), plan.rate)
        carried = execute(plan, self.part, self.peg, self.contact, self.truth, error)
        there = torch.from_numpy(carried.world_from_peg)
        return carried, carried.wrench + error, poses.retract(there, torch.from_numpy(wobble)).numpy()

    def insert(self, plan: InsertionPlan, sensors: SensorErrors | None = None) -> InsertionResult:
        """An insertion as it truly went."""
        error, wobble = (sensors or self.sensors()).drawn(samples_of(plan), plan.search.rate)
        place = self.kind.part_from_hole
        return insert(plan, self.part, self.peg, self.contact, self.truth, place, error, wobble)

    def sensors(self) -> SensorErrors:
        """What the sensors will add, from the first sample on."""
        return SensorErrors(self.bench, self.seed)

    def _recording(self, windows: Sequence[Measurement]) -> Recording:
        images, background = self._views
        views = [Measurement(View(c), i) for c, i in zip(self.cameras, images, strict=True)]
        return Recording(
            part=self.part,
            guess=self.guess,
            measurements=[*views, *windows],
            peg=self.peg,
            background=background,
            truth=self.truth,
            model="look_and_touch",
            source=f"simulated by bcppl, accuracy bench, seed {self.seed}: {self.name}",
        )

    @functools.cached_property
    def _views(self) -> tuple[list[DepthImage], dict[str, Array]]:
        """What the two cameras read, and what they would see of the table alone from where they say."""
        still, generator = _table(), _drawn(self.seed, _IMAGES)
        images, background = [], {}
        empty = SceneRenderer([still])
        for k, camera in enumerate(self.cameras):
            background[camera.name] = empty.background(camera, poses.identity(1))
            depth = self.true_depth(k) + self.range_bias[k]
            read = self.bench.depth_noise.sample(camera, depth, generator)
            images.append(DepthImage(read.astype(np.float32).astype(np.float64)))
        return images, background

    def true_depth(self, view: int) -> Array:
        """The depth (H, W) in metres from where a camera truly stands, without noise or bias."""
        camera = replace(self.cameras[view], world_from_camera=self.world_from_cameras[view])
        return self.depth_from(camera, hidden=view == self.hidden_view)

    def depth_from(self, camera: Camera, hidden: bool = False) -> Array:
        """The depth (H, W) in metres that a camera would read without error, past the occluder or not."""
        parts, stands = [self.part, _table()], [torch.from_numpy(self.truth), poses.identity()]
        if hidden:
            angle = _drawn(self.seed, _CAMERAS, 1).uniform(0.0, 2.0 * math.pi)
            box, pose = occluder(camera, self.part, self.truth, self.bench.hidden, angle)
            parts.append(box)
            stands.append(torch.from_numpy(pose))
        return SceneRenderer(parts).images(camera, torch.stack(stands))[0]


def bench_scene(
    seed: int, bench: Bench | None = None, part: str | None = None, clearance: float | None = None
) -> BenchScene:
    """One scene of the bench.

    Args:
        seed: same seed, same scene; a part or a clearance that is given changes nothing else of it.
        bench: what it is drawn from; the default one unless given.
        part: a name in `bench_parts.PARTS`; drawn unless given.
        clearance: diametral, metres; drawn unless given.

    Raises:
        InputError: the seed is no whole number from 0, there is no such part, or its hole takes no peg with
            that clearance.
    """
    seed = seed_number(seed)
    bench = Bench() if bench is None else bench
    choice = _drawn(seed, _CHOICE)
    drawn_part, drawn_clearance = choice.integers(len(PARTS)), choice.integers(len(bench.clearances))
    kind = bench_part(list(PARTS)[drawn_part] if part is None else part)
    clearance = bench.clearances[drawn_clearance] if clearance is None else float(clearance)
    centre = np.array([*bench.top[:2], bench.top[2] - kind.part_from_hole[2], 1.0, 0.0, 0.0, 0.0])
    guess = Guess(centre, np.full(3, bench.translation), bench.tilt, bench.yaw)
    cameras, stand, bias, hidden = _cameras(seed, bench)
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
        world_from_cameras=stand,
        range_bias=bias,
        hidden_view=hidden,
    )


def _truth(seed: int, guess: Guess) -> Array:
    prior = SwingTwistPose(
        torch.from_numpy(guess.world_from_part), torch.from_numpy(guess.translation), guess.tilt, guess.yaw
    )
    with torch.random.fork_rng(devices=[]):
        # Inference may well be given the same seed, and must not draw the truth with it.
        torch.manual_seed(int(_drawn(seed, _POSE).integers(2**62)))
        return np.asarray(prior.sample().numpy())


def _cameras(seed: int, bench: Bench) -> tuple[list[Camera], Array, Array, int | None]:
    """The cameras as stated, where they truly stand, their range biases, and which one looks past a box."""
    generator, top = _drawn(seed, _CAMERAS), np.array(bench.top)
    heading = generator.uniform(0.0, 2.0 * math.pi)
    spread = bench.camera_error_factor * _six(bench.camera_shift, bench.camera_turn)
    found, stand, bias = [], [], []
    for k in range(2):
        distance, height = generator.uniform(*bench.distance), generator.uniform(*bench.height)
        around = heading + k * bench.around
        flat, up = math.cos(height), math.sin(height)
        eye = top + distance * np.array([flat * math.cos(around), flat * math.sin(around), up])
        pose = looking_at(eye, top)
        size, focal = (bench.width, bench.rows), bench.focal
        middle = (0.5 * (size[0] - 1), 0.5 * (size[1] - 1))
        found.append(Camera(f"camera_{k}", *size, focal, focal, *middle, pose, near=0.1, far=2.0))
        off = torch.from_numpy(spread * generator.normal(size=6))
        stand.append(poses.retract(torch.from_numpy(pose), off).numpy())
        bias.append(generator.normal(scale=bench.range_bias))
    which = int(generator.integers(2))
    return found, np.stack(stand), np.array(bias), which if bench.occluder else None


def _contact(seed: int, bench: Bench) -> ContactParameters:
    generator = _drawn(seed, _CONTACT)
    friction = generator.uniform(*bench.friction)
    factors = bench.contact_factor ** generator.uniform(-1.0, 1.0, size=2)
    return ContactParameters(
        time_step=bench.time_step,
        friction=float(friction),
        time_constant=bench.time_constant * float(factors[0]),
        damping_ratio=bench.damping_ratio * float(factors[1]),
    )


def _drawn(seed: int, *what: int) -> np.random.Generator:
    return np.random.default_rng([seed, *what])


def _six(along: float, about: float) -> Array:
    return np.array([along] * 3 + [about] * 3)


@functools.cache
def _table() -> Part:
    """The table's top as a thin slab, 2 m wide, its upper face at z = 0."""
    return block((2.0, 2.0, 0.01), "table")

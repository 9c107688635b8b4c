"""Presses on the foreign world with something that no recording states and that the model has not, or not so.

- grasp: the peg sits 0.4 mm and half a degree off in the hand, turned about the grip and not about its frame.
- creep: the peg gives in the hand along the force for as long as it is pressed, 0.3 mm over all touches.
- slide: in the middle of one touch the part slides by 0.3 mm within 10 ms, and turns by half a degree.
- small_slides: at every touch the part is pushed along by 50 to 100 um, within 0.15 s.
- backlash: a force of over half a newton takes up 0.1 mm of play, which the measured pose does not show.
- rough_kinematics: measured poses are off by a smooth field of 0.2 mm and 0.02 degrees, its period 60 mm.
- late_wrench: the wrench arrives 25 ms late.
- grasp_and_slide: the grasp and the slide of the same scene, together.

Contacts are softer, stiffer and nominal in turn, by the scene's seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.sensors.measurements import Recording
from foreign.arm import Log, composed, inverse
from foreign.parts import LENGTH
from foreign.world import TICK, Scene, log_of, recording_of

SINGLE = ("grasp", "creep", "slide", "small_slides", "backlash", "rough_kinematics", "late_wrench")
MECHANISMS = {
    "none": (),
    **{name: (name,) for name in SINGLE},
    "grasp_and_slide": ("grasp", "slide"),
}
RATE = 100  # Hz, at which recordings are read
IN_TURN = ("softer", "stiffer", "nominal")  # of contact, by a seed's remainder
# mm, in the part's frame: the middle of what the peg would be put into, at the height of the face around it.
HOLES = {
    "L-shaped block with a hole": (6.0, -11.0, 0.0),
    "plate with a slot": (8.0, 6.0, 0.0),
    "stepped block with a hole": (-14.0, 3.0, 0.0),
}

FELT, APART = 0.5, 0.15  # N that are contact, and s without them after which contact is another touch
TOUCHES = 7
GRIP = np.array([0.0, 0.0, -0.03])  # m, in the peg's frame: about here it turns in the hand
HELD_OFF, HELD_TURNED = 4e-4, np.radians(0.5)  # m and rad
CREEP, CREEP_TIME, CREEP_FORCE = 3e-4, 0.3, 1.0  # m over all touches; s of a touch's share; N, above which
SLIDE, SLIDE_TURN, SLIDE_TIME = 3e-4, np.radians(0.5), 0.01  # m, rad and s
SMALL_SLIDE, SMALL_SLIDE_TIME, SMALL_SLIDE_AFTER = (5e-5, 1e-4), 0.15, 0.05  # m, s, and s into the touch
PLAY, PLAY_FORCE = 1e-4, 0.5  # m, and N at which three quarters are taken up
PLAY_TIME = 0.0045  # s: time constant with which the play follows the force
FIELD, FIELD_TURN, PERIOD = 2e-4, np.radians(0.02), 0.06  # amplitudes in m and rad, and m
LATE = 25  # ticks


class Trace(NamedTuple):
    """What was so at every tick.

    Attributes:
        force: (T, 3) of the part on the peg, N, in the world.
        stated_from_peg, world_from_part: (T, 7).
    """

    force: Array
    stated_from_peg: Array
    world_from_part: Array


class Reality:
    """Where peg and part really are while a scene is touched, as mechanisms change it (`foreign.arm.Hidden`).

    Attributes:
        stated_from_peg, world_from_part: (7,) as they are now.
        stated: (7,) world_from_stated, as at the last tick.
        force, point: (3,) of the part on the peg, N, and where, m, in the world, as at the last tick.
        touch: the number of the last touch; -1 before the first.
        pressed: s of contact in it.
        middle: (3,) of the part, m, in its frame.
    """

    def __init__(self, scene: Scene, mechanisms: tuple[str, ...]) -> None:
        self.stated_from_peg = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        self.world_from_part = scene.truth.copy()
        self.middle = scene.foreign.part.vertices.mean(axis=0)
        self.force, self.point = np.zeros(3), np.zeros(3)
        self.touch, self.pressed = -1, 0.0
        self._free = np.inf
        self._rows: list[tuple[Array, Array, Array]] = []
        if "grasp" in mechanisms:
            self.stated_from_peg = grasped(generator_of(scene, "grasp"))
        self._changes = [CHANGES[m](generator_of(scene, m)) for m in mechanisms if m in CHANGES]

    @property
    def trace(self) -> Trace:
        """All ticks until now."""
        return Trace(*(np.array(column) for column in zip(*self._rows, strict=True)))

    def felt(self, stated: Array, force: Array, point: Array) -> None:
        """Take note of a tick, and let mechanisms act."""
        self._rows.append((force, self.stated_from_peg, self.world_from_part))
        self.stated, self.force, self.point = stated, force, point
        if np.linalg.norm(force) > FELT:
            if self._free > APART:
                self.touch, self.pressed = self.touch + 1, 0.0
            self.pressed, self._free = self.pressed + TICK, 0.0
        else:
            self._free += TICK
        if self.touch >= 0:
            for change in self._changes:
                change(self)


def generator_of(scene: Scene, mechanism: str) -> np.random.Generator:
    """What a mechanism's sizes and directions are drawn with in a scene."""
    return np.random.default_rng([scene.seed, 5, SINGLE.index(mechanism)])


def turned_about_grip(shift: Array, vector: Array) -> Array:
    """The pose (7,) of a peg that is turned about the grip by a rotation vector (3,), then shifted (3,)."""
    turn = Rotation.from_rotvec(vector)
    return np.append(GRIP - turn.apply(GRIP) + shift, turn.as_quat(scalar_first=True))


def grasped(generator: np.random.Generator) -> Array:
    """How a peg is held (7,) that is off in any direction, and leans."""
    shift, lean = generator.standard_normal(3), generator.standard_normal(2)
    lean *= HELD_TURNED / np.linalg.norm(lean)
    return turned_about_grip(HELD_OFF * shift / np.linalg.norm(shift), np.append(lean, 0.0))


class Creep:
    """The peg gives in the hand along the force, crosswise half by a turn; each touch has its share."""

    def __init__(self, generator: np.random.Generator) -> None:
        shares = generator.uniform(0.5, 1.5, TOUCHES)
        self._left = CREEP * shares / shares.sum()
        self._speed = self._left / CREEP_TIME

    def __call__(self, reality: Reality) -> None:
        """Creep for a tick."""
        force = float(np.linalg.norm(reality.force))
        k = min(reality.touch, TOUCHES - 1)
        if force <= CREEP_FORCE or self._left[k] <= 0.0:
            return
        way = self._speed[k] * TICK
        self._left[k] -= way
        turn = Rotation.from_quat(reality.stated[3:], scalar_first=True).inv()
        along = way * turn.apply(reality.force / force)
        across = np.array([along[0], along[1], 0.0])
        lean = np.cross([0.0, 0.0, -1.0], across) / (LENGTH + GRIP[2])
        given = turned_about_grip(along - 0.5 * across, 0.5 * lean)
        reality.stated_from_peg = composed(given, reality.stated_from_peg)


@dataclass
class Slides:
    """The part slides along the table and turns, at most once in a touch, about where the peg pushes it to.

    Attributes:
        generator: of the directions.
        sizes: (touches,) m, of a slide in each touch.
        turn: rad, about the vertical through the part's middle, the way that the peg pushes.
        seconds: that a slide takes.
        first, after: the next touch with one, and after so many s of contact in it.
        most: slides that are still to come.
    """

    generator: np.random.Generator
    sizes: Array
    turn: float
    seconds: float
    first: int
    after: float
    most: int

    def __post_init__(self) -> None:
        self._ticks, self._left = round(self.seconds / TICK), 0

    def __call__(self, reality: Reality) -> None:
        """Begin a slide where one is due, and slide for a tick of it."""
        if self.most and reality.touch >= self.first and reality.pressed > self.after:
            self.first, self.most, self._left = reality.touch + 1, self.most - 1, self._ticks
            self._begin(reality)
        if self._left:
            self._left -= 1
            place, quaternion = np.split(reality.world_from_part, [3])
            old = Rotation.from_quat(quaternion, scalar_first=True)
            step = Rotation.from_rotvec([0.0, 0.0, self._angle / self._ticks])
            middle = place + old.apply(reality.middle)
            moved = middle + step.apply(place - middle) + self._way / self._ticks
            reality.world_from_part = np.append(moved, (step * old).as_quat(scalar_first=True))

    def _begin(self, reality: Reality) -> None:
        """Choose the way, within 35 degrees of that in which the part is pushed, or any if it is not."""
        push = -reality.force / max(np.linalg.norm(reality.force), 1e-9)
        if np.linalg.norm(push[:2]) > 0.5:
            heading = np.arctan2(push[1], push[0]) + self.generator.uniform(-0.6, 0.6)
            middle = Rotation.from_quat(reality.world_from_part[3:], scalar_first=True).apply(reality.middle)
            arm = reality.point - reality.world_from_part[:3] - middle
            sign = np.sign(arm[0] * push[1] - arm[1] * push[0])
        else:
            heading = self.generator.uniform(-np.pi, np.pi)
            sign = self.generator.choice([-1.0, 1.0])
        size = self.sizes[min(reality.touch, len(self.sizes) - 1)]
        self._way = size * np.array([np.cos(heading), np.sin(heading), 0.0])
        self._angle = sign * self.turn


def sudden_slide(generator: np.random.Generator) -> Slides:
    """One slide, in the second to the sixth touch."""
    first, after = int(generator.integers(1, TOUCHES - 1)), generator.uniform(0.2, 0.35)
    return Slides(generator, np.full(TOUCHES, SLIDE), SLIDE_TURN, SLIDE_TIME, first, after, 1)


def small_slides(generator: np.random.Generator) -> Slides:
    """A slide in every touch, without a turn."""
    sizes = generator.uniform(*SMALL_SLIDE, TOUCHES)
    return Slides(generator, sizes, 0.0, SMALL_SLIDE_TIME, 0, SMALL_SLIDE_AFTER, TOUCHES)


CHANGES: dict[str, Callable[[np.random.Generator], Callable[[Reality], None]]] = {
    "creep": Creep,
    "slide": sudden_slide,
    "small_slides": small_slides,
}


def taken_up(force: Array) -> Array:
    """How far the peg is (T, 3), m, from where it is measured: the way that a force (T, 3), N, pushes it."""
    kept = np.exp(-TICK / PLAY_TIME)
    followed = lfilter([1.0 - kept], [1.0, -kept], force, axis=0)
    length = np.linalg.norm(followed, axis=1, keepdims=True)
    return PLAY * np.tanh(length / PLAY_FORCE) * followed / np.maximum(length, 1e-9)


def rough_kinematics(generator: np.random.Generator) -> Callable[[Array], Array]:
    """A field of errors: from true poses (T, 7) to those that are measured."""
    phases = generator.uniform(0.0, 2.0 * np.pi, 6)
    axes = Rotation.from_rotvec(generator.standard_normal(3))

    def measured(world_from_peg: Array) -> Array:
        x, y, z = 2.0 * np.pi / PERIOD * axes.apply(world_from_peg[:, :3]).T
        waves = np.sin(np.column_stack([y, z, x, z, x, y]) + phases)
        turn = Rotation.from_rotvec(FIELD_TURN * waves[:, 3:])
        rotation = turn * Rotation.from_quat(world_from_peg[:, 3:], scalar_first=True)
        place = world_from_peg[:, :3] + FIELD * axes.inv().apply(waves[:, :3])
        return np.hstack([place, rotation.as_quat(scalar_first=True)])

    return measured


class Made(NamedTuple):
    """A recording and what is true of it.

    Attributes:
        recording: its truth is the part's pose before any touch.
        world_from_peg: (7,) as measured where an insertion would start: the stated peg upright to the part as
            it is after all touches, its tip at the hole.
        apparent: (7,) the part's pose then, for who takes the peg to be where it is measured.
        log: of the peg as stated, measured without errors.
        trace: of peg and part as they were.
    """

    recording: Recording
    world_from_peg: Array
    apparent: Array
    log: Log
    trace: Trace

    @property
    def world_from_true_peg(self) -> Array:
        """Where the peg was (T, 7), as seen from the part, were that where the recording's truth has it."""
        first = self.trace.world_from_part[0]
        return np.array(
            [
                composed(first, composed(inverse(part), composed(stated, held)))
                for stated, held, part in zip(self.log.world_from_peg, *self.trace[1:], strict=True)
            ]
        )


def made(scene: Scene, mechanism: str) -> Made:
    """The presses of a scene with a mechanism of `MECHANISMS`."""
    single, contact = MECHANISMS[mechanism], IN_TURN[scene.seed % len(IN_TURN)]
    reality = Reality(scene, single)
    log = log_of(scene, "presses", contact, reality)
    trace, poses, wrench = reality.trace, log.world_from_peg, log.wrench
    measured: Callable[[Array], Array] = np.copy
    if "backlash" in single:
        poses = np.hstack([poses[:, :3] - taken_up(trace.force), poses[:, 3:]])
    if "rough_kinematics" in single:
        measured = rough_kinematics(generator_of(scene, "rough_kinematics"))
    if "late_wrench" in single:
        wrench = np.concatenate([np.tile(wrench[:1], (LATE, 1)), wrench[:-LATE]])
    sensed = log._replace(world_from_peg=measured(poses), wrench=wrench)
    recording = recording_of(scene, "presses", contact, RATE, sensed)
    source = f"simulated by benchmarks/foreign/mechanisms.py, seed {scene.seed}, {mechanism}, {contact}"
    stated = insertion_start(reality.world_from_part, HOLES[scene.foreign.part.name])
    world_from_peg = measured(stated[None])[0]
    part_from_peg = composed(inverse(reality.world_from_part), composed(stated, reality.stated_from_peg))
    apparent = composed(world_from_peg, inverse(part_from_peg))
    return Made(replace(recording, source=source), world_from_peg, apparent, log, trace)


def insertion_start(world_from_part: Array, hole: tuple[float, float, float]) -> Array:
    """The pose (7,) of a peg turned from the vertical to be upright to the part, its tip at the hole.

    Args:
        world_from_part: (7,).
        hole: mm, in the part's frame.
    """
    turn = Rotation.from_quat(world_from_part[3:], scalar_first=True)
    up = turn.apply([0.0, 0.0, 1.0])
    axis = np.cross([0.0, 0.0, 1.0], up)
    sine = np.linalg.norm(axis)
    lean = Rotation.from_rotvec(np.arctan2(sine, up[2]) / max(sine, 1e-12) * axis)
    tip = world_from_part[:3] + turn.apply(1e-3 * np.array(hole))
    return np.append(tip + LENGTH * up, lean.as_quat(scalar_first=True))

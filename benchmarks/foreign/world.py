"""Recordings of another world than the library's: its parts, arm, contact, planner and cameras are its own.

A scene is a part at a pose within the guess's box and two views. It is touched in two manners, each at 3-2-1
places, aimed from an estimate that is a few millimetres off: "taps" at 100 mm/s, six in 6 s, each with 40 to
60 ms of contact, and "presses" at 12 to 20 mm/s, held at 3 to 8 N for 0.3 s, seven in 12 s. The measured pose
of the peg is true but for the encoders' noise. Manners, rates and contacts of one scene share all else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation, Slerp

from bcppl.arrays import Array
from bcppl.geometry.parts import Guess, Part
from bcppl.recordings import load, save
from bcppl.sensors.measurements import Measurement, Recording
from bcppl.sensors.probe import Probe, ProbeWindow, Touch
from foreign.arm import NOMINAL, Hidden, Log, Mechanics, Motion, carried_out
from foreign.parts import LENGTH, PARTS, ForeignPart, Place, peg
from foreign.views import perturbed, views

MANNERS = {"taps": (6, 6.0), "presses": (7, 12.0)}  # how many, within how many seconds
CONTACTS = {"softer": (-1.0, 0.0), "stiffer": (0.0, 1.0)}  # log10 of a contact's stiffness over the nominal
STIFFNESSES = CONTACTS | {"nominal": (0.0, 0.0)}
RATES = (100, 500)  # Hz
WINDOW = 0.5  # s
TICK = 0.001  # s
STROKE, STANDOFF = 0.012, 0.006  # m: of an approach, and before the place that it aims at
ABOVE = 0.014  # m, of the tip over the part between touches
ERROR, TURN_ERROR = 0.0023, np.radians(1.0)  # root mean square of the estimate from which touches are aimed
ENCODER, ENCODER_TURN = 3e-5, np.radians(0.01)  # standard deviations of the measured pose, m and rad
TRANSLATION, TILT, YAW = 0.02, np.radians(10.0), np.radians(30.0)  # the guess's limits


@dataclass(frozen=True, eq=False)
class Scene:
    """A part, where it is, and the recording's two views of it."""

    seed: int
    foreign: ForeignPart
    peg: Part
    radius: float
    truth: Array
    guess: Guess
    views: Sequence[Measurement]
    background: dict[str, Array]


class Stroke(NamedTuple):
    """An approach: the peg's poses (7,) before it and at its end, its speed (m/s), and where it ends."""

    start: Array
    end: Array
    speed: float
    force: float  # N, at which the approach stops
    steady: int  # ticks for which it must be felt: an impact does not stop a press
    hold: float  # s
    retreat: float  # m/s


def scene_of(seed: int) -> Scene:
    """The scene of a seed."""
    generator = np.random.default_rng([seed, 1])
    foreign = PARTS[sorted(PARTS)[generator.integers(len(PARTS))]]()
    radius = float(generator.uniform(0.004, 0.0055))
    heading = Rotation.from_euler("z", generator.uniform(-np.pi, np.pi))
    guessed = np.append([0.45, 0.0, 0.15], heading.as_quat(scalar_first=True))
    lean, about = TILT * np.sqrt(generator.random()), generator.uniform(-np.pi, np.pi)
    swing = Rotation.from_rotvec(0.98 * lean * np.array([np.cos(about), np.sin(about), 0.0]))
    twist = Rotation.from_euler("z", 0.98 * generator.uniform(-YAW, YAW))
    place = guessed[:3] + generator.uniform(-TRANSLATION, TRANSLATION, 3)
    truth = np.append(place, (heading * swing * twist).as_quat(scalar_first=True))
    guess = Guess(guessed, np.full(3, TRANSLATION), TILT, YAW)
    seen, background = views(foreign.part, truth, guessed[:3], generator)
    return Scene(seed, foreign, peg(radius), radius, truth, guess, seen, background)


def mechanics_of(seed: int, contact: str) -> Mechanics:
    """The arm's and the contact's parameters in a scene; but for the stiffness they are the same for all."""
    generator = np.random.default_rng([seed, 2])
    factor = 10.0 ** generator.uniform(*STIFFNESSES[contact])
    spring, turning = generator.uniform(1500.0, 2500.0), generator.uniform(90.0, 150.0)
    return Mechanics(
        stiffness=factor * NOMINAL,
        restitution=generator.uniform(0.3, 1.0),
        friction=generator.uniform(0.1, 0.6),
        joint_friction=generator.uniform(0.05, 0.25),
        tool_mass=generator.uniform(0.15, 0.35),
        lag=generator.uniform(0.005, 0.02),
        cut_off=generator.uniform(60.0, 150.0),
        spring=np.repeat([spring, turning], 3),
        damper=np.repeat([1.2 * np.sqrt(2.0 * spring), 1.2 * np.sqrt(0.015 * turning)], 3),
    )


def log_of(scene: Scene, manner: str, contact: str, hidden: Hidden | None = None) -> Log:
    """What happens when a scene is touched in a manner, with something that the arm does not know of."""
    generator = np.random.default_rng([scene.seed, 3, sorted(MANNERS).index(manner)])
    count, seconds = MANNERS[manner]
    aimed = perturbed(scene.truth, ERROR, TURN_ERROR, generator)
    strokes = [
        _stroke(place, aimed, scene.radius, manner, generator)
        for place in scene.foreign.places(count, generator)
    ]
    highest = _in_world(aimed, scene.foreign.part.vertices)[:, 2].max() + ABOVE
    mechanics = mechanics_of(scene.seed, contact)
    motion = _touching(strokes, highest, manner)
    return carried_out(motion, seconds, scene.foreign.part, scene.peg, scene.truth, mechanics, hidden)


def recording_of(
    scene: Scene, manner: str, contact: str, rate: int = 500, log: Log | None = None
) -> Recording:
    """The recording of a scene touched in a manner, its contact stiffer or softer than nominal.

    Args:
        scene: what is touched.
        manner: "taps" or "presses".
        contact: "stiffer", "softer" or "nominal".
        rate: stamps per second, a divisor of 1000.
        log: of `log_of`; None to carry the touches out.
    """
    happened = log_of(scene, manner, contact) if log is None else log
    mechanics = mechanics_of(scene.seed, contact)
    rows = slice(None, None, round(1.0 / (TICK * rate)))
    generator = np.random.default_rng([scene.seed, 4, sorted(MANNERS).index(manner)])
    wrench, measured = _sensed(happened, generator)
    probe = Probe(
        manner,
        happened.times[::4],
        happened.command[::4],
        mechanics.spring,
        mechanics.damper,
        happened.times[rows],
    )
    touch = Touch(happened.times[rows], wrench[rows], measured[rows])
    step = round(WINDOW * rate)
    return Recording(
        part=scene.foreign.part,
        guess=scene.guess,
        measurements=[*scene.views, *windows(probe, touch, step)],
        peg=scene.peg,
        background=scene.background,
        truth=scene.truth,
        model="look_and_touch",
        source=f"simulated by benchmarks/foreign/world.py, seed {scene.seed}, {manner}, {contact}",
    )


def windows(probe: Probe, touch: Touch, step: int) -> list[Measurement]:
    """A touch over a whole probe, cut into windows of so many stamps."""
    return [
        Measurement(
            ProbeWindow(probe, first, min(first + step, len(touch.times))),
            Touch(
                *(
                    column[first : first + step]
                    for column in (touch.times, touch.wrench, touch.world_from_peg)
                )
            ),
        )
        for first in range(0, len(touch.times), step)
    ]


def kept(seed: int, manner: str, contact: str, rate: int, folder: Path | None) -> Recording:
    """The recording, from a folder where it lies there, else simulated at every rate and put there."""
    if folder is None:
        return recording_of(scene_of(seed), manner, contact, rate)
    files = {r: folder / f"{seed}_{manner}_{contact}_{r}.h5" for r in RATES}
    if not files[rate].exists():
        folder.mkdir(parents=True, exist_ok=True)
        scene = scene_of(seed)
        log = log_of(scene, manner, contact)
        for r, file in files.items():
            save(recording_of(scene, manner, contact, r, log), file)
    return load(files[rate])


def _sensed(log: Log, generator: np.random.Generator) -> tuple[Array, Array]:
    """Wrenches with zero, drift, noise and quantisation, poses with the encoders' noise, tick by tick."""
    scale, count = np.repeat([1.0, 0.03], 3), len(log.times)
    noise = generator.uniform(0.03, 0.1) * scale * generator.standard_normal((count, 6))
    wander = np.cumsum(generator.standard_normal((count, 6)), axis=0) * np.sqrt(TICK) * 0.03 * scale
    drift = np.outer(log.times, generator.normal(0.0, 0.01, 6) * scale)
    steps = np.repeat([0.02, 0.0005], 3)
    wrench = log.wrench + generator.normal(0.0, 1.0, 6) * scale + wander + drift + noise
    turn = Rotation.from_rotvec(generator.normal(0.0, ENCODER_TURN, (count, 3)))
    rotation = Rotation.from_quat(log.world_from_peg[:, 3:], scalar_first=True) * turn
    place = log.world_from_peg[:, :3] + generator.normal(0.0, ENCODER, (count, 3))
    return np.round(wrench / steps) * steps, np.hstack([place, rotation.as_quat(scalar_first=True)])


def _in_world(pose: Array, points: Array) -> Array:
    return np.asarray(Rotation.from_quat(pose[3:], scalar_first=True).apply(points) + pose[:3])


def _stroke(place: Place, aimed: Array, radius: float, manner: str, generator: np.random.Generator) -> Stroke:
    """The approach to a place on the part at the pose from which it is aimed, the peg nearly upright."""
    normal = Rotation.from_quat(aimed[3:], scalar_first=True).apply(place.normal)
    tip = _in_world(aimed, place.point) + (radius * normal if abs(place.normal[2]) < 0.5 else 0.0)
    lean = Rotation.from_rotvec(
        np.append(generator.normal(0.0, np.radians(2.0), 2), generator.uniform(-0.5, 0.5))
    )
    root = tip + lean.apply([0.0, 0.0, LENGTH])
    start, end = (
        np.append(root + far * normal, lean.as_quat(scalar_first=True))
        for far in (STANDOFF, STANDOFF - STROKE)
    )
    if manner == "taps":
        return Stroke(start, end, 0.1, generator.uniform(2.5, 4.0), 1, generator.uniform(0.006, 0.014), 0.2)
    return Stroke(start, end, generator.uniform(0.012, 0.02), generator.uniform(3.0, 8.0), 20, 0.3, 0.06)


def _touching(strokes: Sequence[Stroke], height: float, manner: str) -> Motion:
    """Commands, tick by tick: a rest, then for each stroke a way there above the part, in, a hold and out."""
    here = strokes[0].start.copy()
    here[2] = height + LENGTH + 0.03
    for _ in range(500):
        yield here
    for stroke in strokes:
        for pose in _way(here, stroke.start, height + LENGTH, 0.42):  # noqa: UP028 (rows are sent nothing)
            yield pose
        here = stroke.start
        for _ in range(30):
            force = yield here
        length, steady = np.linalg.norm(stroke.end[:3] - stroke.start[:3]), 0
        for share in np.arange(1, round(length / stroke.speed / TICK) + 1) * stroke.speed * TICK / length:
            here = stroke.start + share * (stroke.end - stroke.start)
            force = yield here
            steady = steady + 1 if force > stroke.force else 0
            if steady == stroke.steady:
                break
        for _ in range(round(stroke.hold / TICK)):
            yield here
        back = stroke.start - here
        ticks = max(1, round(np.linalg.norm(back[:3]) / stroke.retreat / TICK))
        stopped = here
        for k in range(1, ticks + 1):
            here = stopped + k / ticks * back
            yield here


def _way(start: Array, end: Array, height: float, seconds: float) -> Array:
    """Poses (T, 7) at every tick from rest to rest: up to a height, across and down, corners rounded."""
    corners = np.array([start[:3], [*start[:2], height], [*end[:2], height], end[:3]])
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    time = np.linspace(0.0, 1.0, round(seconds / TICK))
    share = time**3 * (10.0 - 15.0 * time + 6.0 * time**2)
    path = np.column_stack([np.interp(share * lengths[-1], lengths, column) for column in corners.T])
    smoothed = uniform_filter1d(path, 81, axis=0, mode="nearest")
    smoothed[0], smoothed[-1] = start[:3], end[:3]
    turns = Slerp([0.0, 1.0], Rotation.from_quat([start[3:], end[3:]], scalar_first=True))(share)
    return np.hstack([smoothed, turns.as_quat(scalar_first=True)])

"""Arms that touch rigid parts, by their equations of motion, and the two logs they leave on two clocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bcppl.arrays import Array
from bcppl.recordings.streams import Stream

STEP = 2e-4  # s, of the equations of motion
CREEP = 1e-3  # m/s at which friction has reached three quarters of its most
CLEAR, ASIDE = 0.004, 0.01  # m by which a peg is withdrawn from the surface, and then moved anywhere
ASIDE_TIME, LEAST_PAUSE = 0.3, 0.2  # s of that move, and of the pause after it


@dataclass(frozen=True)
class TouchingArm:
    """How an arm moves and touches, and what its sensors say.

    The peg is driven along a line into a surface, until a while after its force has passed a threshold or its
    command has ended; it rests, and is withdrawn. The tip yields like a spring beyond the encoders.

    Attributes:
        late: s by which the force's stamps are late; the filters' delays are added.
        touches: how many, of surfaces that face anywhere.
        seed: of all that is random.
        stiffness: N/m of the arm's impedance, or None for an arm that follows its command whatever it meets.
        mass: kg, of the arm at the peg.
        damping: ratio, of the arm's impedance.
        contact: N/m, of the tip.
        dissipation: s/m, what Hunt and Crossley's contact loses; without it the peg bounces.
        friction: its coefficient.
        oblique: rad, from the surface's normal to the approach.
        sliding: m/s of the command along the surface, from the touch to the retreat.
        speed: m/s of the command at the touch.
        slowed: the share of a minimum-jerk approach's time when it touches, or 0 for one of constant speed.
        approach: s, about how long the approach takes.
        threshold: N, from which a stop is commanded.
        latency: s, from the threshold to the stop.
        braking: m/s², of the command when it stops.
        press: s, after which a stop is commanded in any case.
        rest: s, from the stop to the retreat.
        retreat: s, how long the retreat takes, with minimum jerk.
        tool: kg beyond the force sensor that it feels accelerate.
        force_noise: N, of each of the force's rows and axes.
        force_filter: (how many first-order filters, Hz of each), of the sensor.
        pose_noise: m, of each of the position's rows and axes.
        pose_filter: (how many first-order filters, Hz of each), of the controller's estimate.
        pose_rate: Hz.
        jitter: s, the largest error of the position's stamps, either way.
    """

    late: float = 0.02
    touches: int = 5
    seed: int = 0
    stiffness: float | None = 2000.0
    mass: float = 4.0
    damping: float = 0.7
    contact: float = 1e5
    dissipation: float = 3.0
    friction: float = 0.0
    oblique: float = 0.0
    sliding: float = 0.0
    speed: float = 0.01
    slowed: float = 0.0
    approach: float = 0.5
    threshold: float = 20.0
    latency: float = 0.01
    braking: float = 1.0
    press: float = 0.4
    rest: float = 0.2
    retreat: float = 0.3
    tool: float = 0.0
    force_noise: float = 0.1
    force_filter: tuple[int, float] = (0, 100.0)
    pose_noise: float = 2e-5
    pose_filter: tuple[int, float] = (0, 100.0)
    pose_rate: float = 500.0
    jitter: float = 0.0


def touching(arm: TouchingArm) -> tuple[Stream, Stream, float]:
    """The force on the peg (N, at 1 kHz) and its position (m), and by how many seconds the force is late."""
    rng = np.random.default_rng(arm.seed)
    path, contact, acceleration = _motion(arm, rng)
    path, path_delay = _filtered(path, *arm.pose_filter)
    felt, force_delay = _filtered(contact - arm.tool * acceleration, *arm.force_filter)
    moments = STEP * np.arange(len(path))

    read = np.arange(0.1 + rng.uniform(0.0, 1e-3), moments[-1] - 0.1, 1e-3)
    force = np.stack([np.interp(read, moments, axis) for axis in felt.T], axis=1)
    force += arm.force_noise * rng.normal(size=force.shape)
    seen = np.arange(rng.uniform(0.0, 1.0 / arm.pose_rate), moments[-1], 1.0 / arm.pose_rate)
    position = np.stack([np.interp(seen, moments, axis) for axis in path.T], axis=1)
    position += arm.pose_noise * rng.normal(size=position.shape)
    stamps = np.maximum.accumulate(seen + rng.uniform(-arm.jitter, arm.jitter, len(seen)))
    stamps += 1e-9 * np.arange(len(seen))  # they increase
    late = arm.late + force_delay - path_delay
    return Stream("force", read + arm.late, force), Stream("position", stamps, position), late


def _motion(arm: TouchingArm, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """The peg's position (m), the contact's force (N) and the peg's acceleration (m/s²): (T, 3) every STEP.

    All touches are simulated side by side, each from rest at the origin, and then put one after the other.
    """
    normal = _directions(rng, np.zeros((arm.touches, 3)))
    across = _directions(rng, normal)
    ahead = np.sin(arm.oblique) * across - np.cos(arm.oblique) * normal
    aside = _directions(rng, np.zeros((arm.touches, 3)))
    aside *= ASIDE * np.sign(_dot(aside, normal))  # away from the surface
    lasting = arm.approach * rng.uniform(0.8, 1.2, (arm.touches, 1))
    if arm.slowed:
        length = arm.speed * lasting / _jerk_speed(np.asarray(arm.slowed))
        free = length * _jerk_share(arm.slowed)
    else:
        length, free = np.zeros_like(lasting), arm.speed * lasting

    stiffness = arm.mass * 250.0**2 if arm.stiffness is None else arm.stiffness
    damping = 2.0 * arm.damping * np.sqrt(arm.mass * stiffness)
    longest = 1.25 * lasting.max() + arm.press + arm.latency + arm.rest + arm.retreat + ASIDE_TIME
    settling = 6.0 * arm.mass / damping + LEAST_PAUSE
    steps = int((longest + settling) / STEP)

    place, velocity, command = np.zeros((3, arm.touches, 3))
    pace, along, back = np.zeros((3, *lasting.shape))  # m/s of the command ahead and along, m of the retreat
    stop = np.full_like(lasting, np.inf)  # s, when the command is to stop
    hit, passed = np.zeros_like(lasting, dtype=bool), np.zeros_like(lasting, dtype=bool)
    paths, contacts, accelerations = np.empty((3, steps, arm.touches, 3))
    for row in range(steps):
        now = row * STEP
        depth = -_dot(place, normal) - free * np.cos(arm.oblique)
        inward = -_dot(velocity, normal)
        push = np.maximum(0.0, arm.contact * depth * (1.0 + arm.dissipation * inward)) * (depth > 0.0)
        drift = velocity + inward * normal
        creep = np.sqrt(_dot(drift, drift)) + 1e-12
        rubbing = drift / creep * np.tanh(creep / CREEP)
        reaction = push * (normal - arm.friction * rubbing)

        stop = np.where((depth > 0.0) & ~hit, now + arm.press, stop)
        hit |= depth > 0.0
        stop = np.where((push > arm.threshold) & ~passed, np.minimum(stop, now + arm.latency), stop)
        passed |= push > arm.threshold
        leave = stop + arm.rest
        back = np.where(now < leave, _dot(command, ahead) - free + CLEAR, back)
        going = length / lasting * _jerk_speed(now / lasting) if arm.slowed else arm.speed
        faster = pace + np.minimum(going - pace, 2.0 * STEP)  # at most 2 m/s²
        pace = np.where(now < stop, faster, np.maximum(0.0, pace - arm.braking * STEP))
        wanted = (pace - back / arm.retreat * _jerk_speed((now - leave) / arm.retreat)) * ahead
        wanted += aside / ASIDE_TIME * _jerk_speed((now - leave - arm.retreat) / ASIDE_TIME)
        along += np.clip(arm.sliding * (hit & (now < leave)) - along, -STEP, STEP)  # at 1 m/s²
        wanted += along * across

        driving = stiffness * (command - place) + damping * (wanted - velocity)
        acceleration = (driving + (reaction if arm.stiffness is not None else 0.0)) / arm.mass
        paths[row], contacts[row], accelerations[row] = place, reaction, acceleration
        command = command + STEP * wanted
        velocity = velocity + STEP * acceleration
        place = place + STEP * velocity

    ends = np.cumsum(paths[-1], axis=0) - paths[-1]  # where each touch begins
    return _in_turn(paths + ends), _in_turn(contacts), _in_turn(accelerations)


def _in_turn(values: Array) -> Array:
    """(T, touches, 3) one touch after the other, (touches * T, 3)."""
    return values.swapaxes(0, 1).reshape(-1, 3)


def _jerk_share(time: float) -> float:
    """How much of a minimum-jerk motion is done, at a share of its time."""
    return float(time**3 * (10.0 - 15.0 * time + 6.0 * time**2))


def _jerk_speed(time: Array) -> Array:
    """The speed of a minimum-jerk motion of unit length and time, zero before and after it."""
    within = np.minimum(1.0, np.maximum(0.0, time))
    return np.asarray(30.0 * within**2 * (1.0 - within) ** 2)


def _dot(first: Array, second: Array) -> Array:
    return np.einsum("ij,ij->i", first, second)[:, None]


def _directions(rng: np.random.Generator, normal: Array) -> Array:
    """Unit vectors (T, 3), square to others unless those are zero."""
    free = rng.normal(size=normal.shape)
    free -= _dot(free, normal) * normal
    return np.asarray(free / np.linalg.norm(free, axis=1, keepdims=True))


def _filtered(values: Array, order: int, cut: float) -> tuple[Array, float]:
    """Values (T, 3) through first-order low-pass filters in a row, and how late slow motion is, s."""
    if not order:
        return values, 0.0
    times = STEP * np.arange(int(12.0 * order / (2.0 * np.pi * cut) / STEP))
    kernel = times ** (order - 1) * np.exp(-2.0 * np.pi * cut * times)
    kernel /= kernel.sum()
    passed = [np.convolve(axis - axis[0], kernel)[: len(axis)] + axis[0] for axis in values.T]
    return np.stack(passed, axis=1), float(kernel @ times)

"""An arm that executes a plan: a contact force stops guarded motions, a sinking peg stops searches.

The wrench is monitored as by a robot's program: at the recorded rate, tared, noise and bias included. A
motion is stopped at the sample after two in a row that exceed its force.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.contact.mujoco_model import (
    SENSOR_COLUMNS,
    ContactParameters,
    build_model,
    interpolated_command,
)
from bcppl.contact.stepping import POSE, WRENCH, SimulationState, Stepper
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.models.worlds.bench.reality import BenchReality, held
from bcppl.robot.motion import Probe
from bcppl.robot.plan import Manner, Plan

STEP = 0.005  # s between the command's poses
ROUNDED = 8  # steps over which corners are rounded: 40 ms
TARE = 10  # samples
SUSTAINED = 2  # samples in a row: an impact is shorter


@dataclass(frozen=True, eq=False)
class Execution:
    """The execution of a plan.

    Attributes:
        probe: the command and the stamps.
        stops: (s) when each guarded motion or search was stopped, by its number in the plan.
        wrench: (T, 6) true wrench on the peg at the stamps, N and N m, in the grip's frame.
        world_from_peg: (T, 7) true poses of the peg.
        contact_pose: (7,) as `encoders`, when the last guarded motion was stopped; None where none was.
        state: of the simulation at the last stamp, from which the next motion continues.
        world_from_grip: (T, 7) true poses of the frame that the robot takes for the peg's, at the sensor.
        encoders: (T, 7) what the robot takes them to be, without noise.
        felt: (T, 6) what the wrench sensor reads, without bias and noise: late, for instance.
        world_from_part: (T, 7) true poses of the part.
    """

    probe: Probe
    stops: Mapping[int, float]
    wrench: Array
    world_from_peg: Array
    contact_pose: Array | None
    state: SimulationState
    world_from_grip: Array
    encoders: Array
    felt: Array
    world_from_part: Array


def stamps_of(plan: Plan) -> Array:
    """The times (T,) of a plan's samples, s, up to its last knot and without it."""
    duration = float(plan.times[-1] - plan.times[0])
    return np.asarray(plan.times[0] + np.arange(round(duration * plan.rate)) / plan.rate)


def command_of(plan: Plan, stops: Mapping[int, float]) -> Probe:
    """The command of a plan of which some guarded motions and searches are stopped early.

    Corners are rounded: the command is the mean of the plan's last 40 ms. So it is 20 ms late, stops within
    40 ms, and never depends on later contacts. A corner at which the velocity changes by 100 mm/s takes 0.5 N
    to accelerate the 0.2 kg of the tool; others in proportion.

    Args:
        plan: of the arm.
        stops: when (s) a guarded or searching motion is stopped, by its number in the plan.
    """
    found = False  # the hole: the remaining motions of the search are skipped
    times, ends = [float(plan.times[0])], [plan.world_from_peg[0]]
    shift, turn = np.zeros(3), Rotation.identity()  # of the motions that follow, by the skipped ones
    for k, manner in enumerate(plan.manners):
        if manner == "free":
            shift, turn = np.zeros(3), Rotation.identity()
        planned = plan.world_from_peg[k + 1]
        end = np.concatenate([planned[:3] + shift, _quaternion(_rotation(planned) * turn)])
        found = found and manner == "searching"
        if found:
            end = ends[-1]
            shift, turn = end[:3] - planned[:3], _rotation(planned).inv() * _rotation(end)
        elif k in stops:
            found = manner == "searching"
            path = _path(plan, np.array([times[-1], plan.times[k + 1]]), np.stack([ends[-1], end]))
            end = interpolated_command(path, np.array([stops[k]]))[0][0]
            shift, turn = end[:3] - planned[:3], _rotation(planned).inv() * _rotation(end)
            times.append(stops[k])
            ends.append(end)
        times.append(float(plan.times[k + 1]))
        ends.append(end)
    count = round((plan.times[-1] - plan.times[0]) / STEP)
    fine = plan.times[0] + STEP * np.arange(count + 1)
    led = interpolated_command(_path(plan, np.array(times), np.stack(ends)), fine)[0]
    opposite = np.cumprod(np.sign(np.sum(led[1:, 3:] * led[:-1, 3:], axis=1)))
    led[1:, 3:] *= opposite[:, None]
    late = np.concatenate([np.repeat(led[:1], ROUNDED - 1, axis=0), led])
    mean = np.lib.stride_tricks.sliding_window_view(late, ROUNDED, axis=0).mean(axis=-1)
    mean[:, 3:] /= np.linalg.norm(mean[:, 3:], axis=1, keepdims=True)
    return Probe(plan.name, fine, mean, plan.stiffness, plan.damping, stamps_of(plan))


def execute(
    plan: Plan,
    part: Part,
    peg: Part,
    contact: ContactParameters,
    world_from_part: Array,
    error: Array,
    *,
    stop_at_hole: bool = False,
    after: Execution | None = None,
    tare: Array | None = None,
    reality: BenchReality | None = None,
) -> Execution:
    """Simulate an arm that executes a plan.

    The physics is of the true peg and the true part, and the plan is relative to what the robot takes for
    true: its encoders are driven to the command, and its monitors read its sensors.

    From 10 to 40 mm/s a motion guarded at 4 N ended at 3.0 to 5.9 N (it continues for up to 60 ms and the
    spring is 2500 N/m), at 60 mm/s at 6.7 to 8.4 N; the impact itself peaks at up to 46 N for a sample.

    Args:
        plan: of the arm.
        part: in contact.
        peg: the held peg, truly.
        contact: the world's physics.
        world_from_part: (7,) true pose of the part; not used with a reality.
        error: (T, 6) of the measured wrench at the stamps: bias, drift and noise, N and N m.
        stop_at_hole: whether the execution ends when a search has found its hole.
        after: the execution just before it, whose final position and velocity are the initial ones.
        tare: (3,) N, the sensor's reading without contact; by default the mean of the first ten samples,
            during which no motion is stopped.
        reality: in which the robot is wrong, and whose slips continue; by default it is right.

    Raises:
        InputError: the plan takes less than the eleven samples by which the wrench is tared, or is sampled
            faster than the command can be changed.
    """
    stamps, manners = stamps_of(plan), plan.manners
    if len(stamps) <= TARE or plan.rate * STEP > 1.0 + 1e-9:
        raise InputError(
            f"plan {plan.name!r} has {len(stamps)} samples at {plan.rate:g} Hz; make it longer than "
            f"{TARE} samples, by which the wrench is tared, at {1.0 / STEP:g} Hz or less."
        )
    reality = BenchReality.right(world_from_part) if reality is None else reality
    grip_from_peg = reality.grip_from_peg(float(stamps[0]))
    model = build_model(part, held(peg, grip_from_peg), contact)
    stops: dict[int, float] = {}
    probe = command_of(plan, stops)
    stepper = Stepper(model, reality.driven(probe), contact.time_step)
    state = stepper.at_rest(1) if after is None else after.state
    rows, pegs = np.empty((len(stamps), SENSOR_COLUMNS)), np.empty((len(stamps), 7))
    parts, earlier = np.empty((len(stamps), 7)), None if after is None else after.wrench
    motion = np.clip(np.searchsorted(plan.times, stamps + 1e-9, side="right") - 1, 0, len(manners) - 1)
    count, contact_pose = len(stamps), None
    middle = 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))

    def encoders(first: int, last: int) -> Array:
        return reality.encoders(rows[first:last, POSE], rows[first:last, WRENCH])

    def felt(last: int) -> Array:
        return reality.felt(rows[:last, WRENCH], rows[:last, POSE], plan.rate, earlier)

    for k, of in enumerate(motion):
        now = reality.grip_from_peg(float(stamps[k]))
        if (now is not None and grip_from_peg is not None and (now != grip_from_peg).any()) or (
            (now is None) != (grip_from_peg is None)
        ):
            grip_from_peg = now
            model = build_model(part, held(peg, grip_from_peg), contact)
            stepper = Stepper(model, reality.driven(probe), contact.time_step)
        parts[k] = reality.part_at(float(stamps[k]))
        row, state = stepper.run(state, parts[k : k + 1], {}, k, k + 1)
        rows[k] = row[0, 0]
        pegs[k] = reality.pegs(rows[k : k + 1, POSE], grip_from_peg)[0]
        reality.touched(float(stamps[k]), rows[k, POSE], rows[k, WRENCH], middle)
        if of in stops or k + 1 == len(stamps):
            continue
        if (
            manners[of] == "guarded"
            and stamps[k + 1] < plan.times[of + 1]
            and (k >= TARE or tare is not None)
        ):
            force = felt(k + 1)[:, :3] + error[: k + 1, :3]
            rest = force[:TARE].mean(axis=0) if tare is None else tare
            stopped = bool((np.linalg.norm(force[-SUSTAINED:] - rest, axis=1) > plan.force).all())
            contact_pose = encoders(k, k + 1)[0].copy() if stopped else contact_pose
        else:
            searching = manners[of] == "searching" and not _found_before(manners, stops, int(of))
            depth = _sunk(probe, encoders(k, k + 1)[0], float(stamps[k]), contact_pose) if searching else 0.0
            stopped = searching and depth > plan.sink
            if stopped and stop_at_hole:
                stops[int(of)], count = float(stamps[k]), k + 1
                break
        if stopped and manners[motion[k + 1]] == manners[of]:  # otherwise it ends now
            stops[int(motion[k + 1])] = float(stamps[k + 1])
            probe = _continued(probe, command_of(plan, stops), stamps[k + 1])
            stepper = Stepper(model, reality.driven(probe), contact.time_step)
    rows = rows[:count]
    return Execution(
        probe=replace(probe, stamps=stamps[:count]),
        stops=stops,
        wrench=rows[:, WRENCH].copy(),
        world_from_peg=pegs[:count],
        contact_pose=contact_pose,
        state=state,
        world_from_grip=rows[:, POSE].copy(),
        encoders=encoders(0, count).copy(),
        felt=felt(count).copy(),
        world_from_part=parts[:count],
    )


def _sunk(probe: Probe, world_from_peg: Array, time: float, contact_pose: Array | None) -> float:
    """How far (m) a peg is below its contact with a surface, along the commanded z; infinite without one."""
    if contact_pose is None:
        return float("inf")
    led = interpolated_command(probe, np.array([time]))[0][0]
    return float(_rotation(led).inv().apply(contact_pose[:3] - world_from_peg[:3])[2])


def _found_before(manners: Sequence[Manner], stops: Mapping[int, float], motion: int) -> bool:
    """Whether the search that a motion belongs to has found its hole."""
    while motion >= 0 and manners[motion] == "searching":
        if motion in stops:
            return True
        motion -= 1
    return False


def _continued(before: Probe, after: Probe, time: float) -> Probe:
    """The later of two commands, equal to the earlier one up to a time, to the bit."""
    given = before.command_times <= time + 1e-9
    after.command[given] = before.command[given]
    return after


def _path(plan: Plan, times: Array, world_from_peg: Array) -> Probe:
    """Straight motions between poses (K, 7) at times of which some may coincide."""
    apart = np.append(np.diff(times) > 1e-9, True)
    return Probe(plan.name, times[apart], world_from_peg[apart], plan.stiffness, plan.damping, times[:1])


def _rotation(pose: Array) -> Rotation:
    return Rotation.from_quat(pose[[4, 5, 6, 3]])


def _quaternion(rotation: Rotation) -> Array:
    return np.asarray(rotation.as_quat()[[3, 0, 1, 2]])

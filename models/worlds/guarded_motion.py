"""An arm that executes a plan: a contact force stops guarded motions, a sinking peg stops searches.

The rules are those of `bcppl.robot.execution`, which a real arm executes as well.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bcppl.arrays import Array
from bcppl.contact.mujoco_model import SENSOR_COLUMNS, ContactParameters, build_model
from bcppl.contact.stepping import POSE, WRENCH, SimulationState, Stepper
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.models.worlds.bench.reality import BenchReality, held
from bcppl.robot.execution import Executor
from bcppl.robot.motion import Probe
from bcppl.robot.plan import Plan


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
        encoders: (T, 7) what the robot takes the peg's poses to be, without noise.
        felt: (T, 6) what the wrench sensor reads, without bias and noise: late, for instance.
        world_from_part: (T, 7) true poses of the part.
    """

    probe: Probe
    stops: Mapping[int, float]
    wrench: Array
    world_from_peg: Array
    contact_pose: Array | None
    state: SimulationState
    encoders: Array
    felt: Array
    world_from_part: Array


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
        tare: (3,) N, the sensor's reading without contact; by default the mean of the first ten samples.
        reality: in which the robot is wrong, and whose slips continue; by default it is right.

    Raises:
        InputError: as of `bcppl.robot.execution.Executor`, or the peg is not at rest while it is tared.
    """
    executor = Executor(plan, tare=tare, stop_at_hole=stop_at_hole)
    stamps = executor.probe.stamps
    reality = BenchReality.right(world_from_part) if reality is None else reality
    grip_from_peg = reality.grip_from_peg(float(stamps[0]))
    model = build_model(part, held(peg, grip_from_peg), contact)
    stepper = Stepper(model, reality.driven(executor.probe), contact.time_step)
    state = stepper.at_rest(1) if after is None else after.state
    rows, pegs = np.empty((len(stamps), SENSOR_COLUMNS)), np.empty((len(stamps), 7))
    parts, earlier = np.empty((len(stamps), 7)), None if after is None else after.wrench
    middle = 0.5 * (part.vertices.min(axis=0) + part.vertices.max(axis=0))

    def encoders(first: int, last: int) -> Array:
        return reality.encoders(rows[first:last, POSE], rows[first:last, WRENCH])

    def read(number: int) -> Array:
        pose: Array = encoders(number, number + 1)[0]
        return pose

    def felt(last: int) -> Array:
        return reality.felt(rows[:last, WRENCH], rows[:last, POSE], plan.rate, earlier)

    while executor.state == "moving":
        k = executor.taken
        now = reality.grip_from_peg(float(stamps[k]))
        if (now is not None and grip_from_peg is not None and (now != grip_from_peg).any()) or (
            (now is None) != (grip_from_peg is None)
        ):
            grip_from_peg = now
            model = build_model(part, held(peg, grip_from_peg), contact)
            stepper = Stepper(model, reality.driven(executor.probe), contact.time_step)
        parts[k] = reality.part_at(float(stamps[k]))
        row, state = stepper.run(state, parts[k : k + 1], {}, k, k + 1)
        rows[k] = row[0, 0]
        pegs[k] = reality.pegs(rows[k : k + 1, POSE], grip_from_peg)[0]
        reality.touched(float(stamps[k]), rows[k, POSE], rows[k, WRENCH], middle)
        force = felt(k + 1)[-1, :3] + error[k, :3]
        if executor.sample(force, functools.partial(read, k)):
            stepper = Stepper(model, reality.driven(executor.probe), contact.time_step)
    if executor.state == "aborted":
        raise InputError(executor.reason)
    count = executor.taken
    rows = rows[:count]
    return Execution(
        probe=replace(executor.probe, stamps=stamps[:count]),
        stops=executor.stops,
        wrench=rows[:, WRENCH].copy(),
        world_from_peg=pegs[:count],
        contact_pose=executor.contact_pose,
        state=state,
        encoders=encoders(0, count).copy(),
        felt=felt(count).copy(),
        world_from_part=parts[:count],
    )

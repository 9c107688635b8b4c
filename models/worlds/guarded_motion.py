"""An arm that carries out a plan: guarded motions end where it feels a force, searches where the peg yields.

The wrench is watched as a robot's program would watch it: at the recorded rate, tared, noise and bias
included; a motion that has felt enough twice in a row is stopped at the next sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bcppl.contact.mujoco_model import ContactParameters, build_model, interpolated_command
from bcppl.contact.stepping import POSE, WRENCH, SimulationState, Stepper
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.robot.motion import Probe
from bcppl.robot.plan import Manner, Plan

Array = npt.NDArray[np.float64]

STEP = 0.005  # s between the command's poses
ROUNDED = 8  # steps over which corners are rounded: 40 ms
TARE = 10  # samples
FELT = 2  # samples in a row: an impact, over within one, is no press


@dataclass(frozen=True, eq=False)
class Execution:
    """A plan as it was carried out.

    Attributes:
        probe: the command and the stamps.
        stops: (s) when each guarded motion that felt enough, or search that found its hole, was stopped, by
            its place in the plan.
        wrench: (T, 6) what was truly exerted on the peg at the stamps, N and N m, in the peg's frame.
        world_from_peg: (T, 7) where the peg truly was.
        met: (7,) where the peg was when the last guarded motion was stopped; None where none was.
        state: of the simulation at the last stamp, from which the next motion continues.
    """

    probe: Probe
    stops: Mapping[int, float]
    wrench: Array
    world_from_peg: Array
    met: Array | None
    state: SimulationState


def stamps_of(plan: Plan) -> Array:
    """When a plan's wrench and peg pose are read, s: (T,), up to but without its last knot."""
    duration = float(plan.times[-1] - plan.times[0])
    return np.asarray(plan.times[0] + np.arange(round(duration * plan.rate)) / plan.rate)


def command_of(plan: Plan, stops: Mapping[int, float]) -> Probe:
    """The command of a plan of which some guarded motions and searches are stopped early, and no others.

    Corners are rounded: the command is the mean of the last 40 ms of where the plan leads. So it is 20 ms
    late, stops within 40 ms, and never depends on what is yet to be felt. A corner at which the velocity
    changes by 100 mm/s is felt as 0.5 N by the 0.2 kg of the tool; slower corners as less, in proportion.

    Args:
        plan: what the arm is asked to do.
        stops: when (s) a guarded or searching motion is stopped, by its place in the plan.
    """
    found = False  # what the search was for: the motions it has left stay undone
    times, ends = [float(plan.times[0])], [plan.world_from_peg[0]]
    shift, turn = np.zeros(3), Rotation.identity()  # of what follows, by the ways left undone
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
    until_found: bool = False,
    following: Execution | None = None,
    zero: Array | None = None,
) -> Execution:
    """Simulate an arm that carries out a plan.

    From 10 to 40 mm/s a motion guarded at 4 N ended at 3.0 to 5.9 N (it goes on for up to 60 ms and the
    spring is 2500 N/m), at 60 mm/s at 6.7 to 8.4 N; the impact itself peaks at up to 46 N for a sample.

    Args:
        plan: what the arm is asked to do.
        part: what is touched.
        peg: what is held.
        contact: the world's physics.
        world_from_part: (7,) where the part truly is.
        error: (T, 6) what the sensor adds to the wrench at the stamps: bias, drift and noise, N and N m.
        until_found: it is over when a search has found its hole.
        following: another plan, just carried out: the peg goes on from where it stood, as fast as it was.
        zero: (3,) N that the sensor reads when nothing is touched; unless given the mean of the first ten
            samples, during which nothing stops.

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
    model, pose = build_model(part, peg, contact), np.asarray(world_from_part, dtype=np.float64)[None]
    stops: dict[int, float] = {}
    probe = command_of(plan, stops)
    stepper = Stepper(model, probe, contact.time_step)
    state = stepper.at_rest(1) if following is None else following.state
    rows = np.empty((len(stamps), WRENCH.stop))
    motion = np.clip(np.searchsorted(plan.times, stamps + 1e-9, side="right") - 1, 0, len(manners) - 1)
    done, met = len(stamps), None
    for k, of in enumerate(motion):
        row, state = stepper.run(state, pose, {}, k, k + 1)
        rows[k] = row[0, 0]
        if of in stops or k + 1 == len(stamps):
            continue
        if (
            manners[of] == "guarded"
            and stamps[k + 1] < plan.times[of + 1]
            and (k >= TARE or zero is not None)
        ):
            felt = rows[: k + 1, WRENCH][:, :3] + error[: k + 1, :3]
            rest = felt[:TARE].mean(axis=0) if zero is None else zero
            stopped = bool((np.linalg.norm(felt[-FELT:] - rest, axis=1) > plan.force).all())
            met = rows[k, POSE].copy() if stopped else met
        else:
            searching = manners[of] == "searching" and not _found_before(manners, stops, int(of))
            stopped = searching and _sunk(probe, rows[k, POSE], float(stamps[k]), met) > plan.sink
            if stopped and until_found:
                stops[int(of)], done = float(stamps[k]), k + 1
                break
        if stopped and manners[motion[k + 1]] == manners[of]:  # else it is over anyway
            stops[int(motion[k + 1])] = float(stamps[k + 1])
            probe = _going_on(probe, command_of(plan, stops), stamps[k + 1])
            stepper = Stepper(model, probe, contact.time_step)
    rows = rows[:done]
    probe = replace(probe, stamps=stamps[:done])
    return Execution(probe, stops, rows[:, WRENCH].copy(), rows[:, POSE].copy(), met, state)


def _sunk(probe: Probe, world_from_peg: Array, time: float, met: Array | None) -> float:
    """How far (m) a peg is below where it met a surface, along the commanded z; none met: infinite."""
    if met is None:
        return float("inf")
    led = interpolated_command(probe, np.array([time]))[0][0]
    return float(_rotation(led).inv().apply(met[:3] - world_from_peg[:3])[2])


def _found_before(manners: Sequence[Manner], stops: Mapping[int, float], motion: int) -> bool:
    """Whether the search of which a motion is a part has found its hole."""
    while motion >= 0 and manners[motion] == "searching":
        if motion in stops:
            return True
        motion -= 1
    return False


def _going_on(before: Probe, after: Probe, time: float) -> Probe:
    """The later of two commands, equal to the bit to the earlier one up to a time, as it was commanded."""
    given = before.command_times <= time + 1e-9
    after.command[given] = before.command[given]
    return after


def _path(plan: Plan, times: Array, world_from_peg: Array) -> Probe:
    """Straight motions between poses (K, 7) at times that may fall together."""
    apart = np.append(np.diff(times) > 1e-9, True)
    return Probe(plan.name, times[apart], world_from_peg[apart], plan.stiffness, plan.damping, times[:1])


def _rotation(pose: Array) -> Rotation:
    return Rotation.from_quat(pose[[4, 5, 6, 3]])


def _quaternion(rotation: Rotation) -> Array:
    return np.asarray(rotation.as_quat()[[3, 0, 1, 2]])

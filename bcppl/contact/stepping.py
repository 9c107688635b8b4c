"""Stepping one probe's MuJoCo model for many particles, and its sensors at the probe's stamps."""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import mujoco
import mujoco.rollout
import numpy as np

from bcppl.arrays import Array, ArrayRecord, Mask
from bcppl.contact.grasp_compliance import readings_at_grip
from bcppl.contact.mujoco_model import SENSOR_COLUMNS, rollout_controls, set_controller, steps_around
from bcppl.contact.particle_models import ParticleModels
from bcppl.robot.motion import Probe
from bcppl.threads import thread_count

_CONTROL = int(
    mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)
_CONTROLS = 20  # six forces, then the positions of command and part, then their quaternions
_BLOCK = 32 * 2**20  # bytes that one call of mujoco.rollout may fill
_COPIES = 1024  # models that differ in nuisance parameters, half a megabyte each
POSE, WRENCH, NORMAL = slice(0, 7), slice(7, 13), slice(13, 16)  # columns of a sensor row


@functools.cache
def _pool() -> mujoco.rollout.Rollout:
    return mujoco.rollout.Rollout(nthread=thread_count())


@dataclass(frozen=True, eq=False)
class SimulationState(ArrayRecord):
    """The states of N simulations.

    Attributes:
        state: (N, S) MuJoCo's full physics state: time, position 7, velocity 6.
        tail: (N, 2, 16) the last two sensor rows, between which the next stamp may lie.
    """

    state: Array
    tail: Array


class Stepper:
    """A probe at one time step: its model, its commands, and the steps around its stamps."""

    def __init__(self, model: mujoco.MjModel, probe: Probe, time_step: float) -> None:
        self.model = copy.copy(model)
        self.model.opt.timestep = time_step
        set_controller(self.model, probe)
        self.time_step = time_step
        self._low, self._high, self._weight = steps_around(probe, time_step)
        times = probe.command_times[0] + time_step * np.arange(max(1, self.step_after(len(self._high))))
        self._controls = rollout_controls(probe, times)
        self._models = ParticleModels(self.model)
        self._data = [mujoco.MjData(self.model) for _ in range(thread_count())]

    def step_after(self, stamps: int) -> int:
        """The number of steps after which the first `stamps` stamps are known."""
        return int(self._high[stamps - 1]) + 1 if stamps else 0

    def commanded(self, first: int, last: int) -> Array:
        """Commanded positions (last-first, 3) at stamps `first` to `last` (exclusive), metres."""
        return self._controls[self._low[first:last], 6:9]

    def at_rest(self, particles: int) -> SimulationState:
        """States at rest at the first command."""
        state = np.zeros((particles, mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        state[:, 1:8] = self._controls[0, 6:]
        return SimulationState(state, np.zeros((particles, 2, SENSOR_COLUMNS)))

    def run(
        self,
        begin: SimulationState,
        world_from_part: Array,
        nuisances: Mapping[str, Array],
        first: int,
        last: int,
    ) -> tuple[Array, SimulationState]:
        """Sensor rows (N, last-first, 16) at stamps `first` to `last` (exclusive), and the states after them.

        A row is the peg's pose, the environment's wrench on it, and the contact's normal. The simulations
        begin in the states after `first` stamps, with nuisances (N, ...) from
        `grasp_compliance.springs_in_series`.
        """
        if nuisances and len(begin.state) > _COPIES:
            every = range(0, len(begin.state), _COPIES)
            parts = [
                self.run(begin[k], world_from_part[k], {n: v[k] for n, v in nuisances.items()}, first, last)
                for k in (slice(at, at + _COPIES) for at in every)
            ]
            return np.concatenate([rows for rows, _ in parts]), SimulationState.joined(
                [end for _, end in parts]
            )
        start, stop = self.step_after(first), self.step_after(last)
        sensed = np.empty((len(begin.state), stop - start, SENSOR_COLUMNS))
        state = begin.state
        for low, high, states, rows in self._blocks(state, world_from_part, nuisances, start, stop):
            sensed[:, low - start : high - start] = rows
            state = states[:, -1].copy()
        rows = np.concatenate([begin.tail, sensed], axis=1)
        readings = self._at_stamps(rows, 2 - start, first, last)
        if "grasp_compliance" in nuisances:
            readings = readings_at_grip(readings, nuisances["grasp_compliance"])
        return readings, SimulationState(state, rows[:, -2:].copy())

    def trajectory(self, world_from_part: Array, stamps: int) -> tuple[Array, SimulationState, Array]:
        """One simulation from the beginning, for a pose (1, 7) of the part.

        Sensor rows (stamps, 16), the states after 0, 1, ... `stamps` stamps, and the peg's poses (S, 7) at
        all steps.
        """
        begin, stop = self.at_rest(1), self.step_after(stamps)
        states, sensed = [begin.state], [begin.tail[0]]
        for *_, state, rows in self._blocks(begin.state, world_from_part, {}, 0, stop):
            states.append(state[0])
            sensed.append(rows[0])
        every, rows = np.concatenate(states), np.concatenate(sensed)
        after = np.array([self.step_after(count) for count in range(stamps + 1)])
        tails = np.stack([rows[after], rows[after + 1]], axis=1)
        path = rows[2:, POSE].copy()
        return self._at_stamps(rows[None], 2, 0, stamps)[0], SimulationState(every[after], tails), path

    def on_time(self, reached: SimulationState, stamps: int) -> Mask:
        """Whether states (N,) are finite and of the expected time: MuJoCo stops those that diverge."""
        expected = self.time_step * self.step_after(stamps)
        with np.errstate(invalid="ignore"):
            timely = np.abs(reached.state[:, 0] - expected) < 0.5 * self.time_step
        return timely & np.isfinite(reached.state).all(axis=1)

    def _at_stamps(self, rows: Array, shift: int, first: int, last: int) -> Array:
        """Sensor rows (N, last-first, 16) at stamps, from rows of which row k is of step k - shift."""
        low, weight = rows[:, self._low[first:last] + shift], self._weight[first:last, None]
        if weight.any():
            high = rows[:, self._high[first:last] + shift]
            # q and -q are the same rotation: interpolate between two on the same side.
            opposite = np.sum(low[..., 3:7] * high[..., 3:7], axis=-1) < 0
            high[opposite, 3:7] *= -1.0
            low += weight * (high - low)
            # A stamp on a step is unchanged, whichever others are interpolated with it.
            between = weight[:, 0] > 0
            low[:, between, 3:7] /= np.linalg.norm(low[:, between, 3:7], axis=-1, keepdims=True)
        # The sensors report the flange's wrench on the peg.
        low[..., WRENCH] *= -1.0
        return low

    def _blocks(
        self, state: Array, world_from_part: Array, nuisances: Mapping[str, Array], first: int, last: int
    ) -> Iterator[tuple[int, int, Array, Array]]:
        """Steps `first` to `last` (exclusive) in blocks.

        Of each: its first step and the one after its last, the states (N, steps, S) after each step, and the
        raw sensor rows (N, steps, 16). A sensor row describes the state before its step: row k is at time
        k * time_step.
        """
        particles = len(state)
        models = self._models.given(nuisances)
        block = max(1, _BLOCK // (8 * max(1, particles) * (_CONTROLS + SENSOR_COLUMNS + state.shape[1])))
        for start in range(first, last, block):
            stop = min(last, start + block)
            control = np.empty((particles, stop - start, _CONTROLS))
            control[..., :9] = self._controls[start:stop, :9]
            if "damping" in nuisances:
                control[..., :6] *= nuisances["damping"][:, None]
            control[..., 9:12] = world_from_part[:, None, :3]
            control[..., 12:16] = self._controls[start:stop, 9:]
            control[..., 16:] = world_from_part[:, None, 3:]
            states, rows = _pool().rollout(
                models, self._data, np.ascontiguousarray(state), control, control_spec=_CONTROL
            )
            yield start, stop, states, rows
            state = states[:, -1]

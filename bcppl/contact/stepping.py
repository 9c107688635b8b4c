"""Running one probe's MuJoCo model for many particles, and reading it at the probe's stamps."""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import mujoco
import mujoco.rollout
import numpy as np
import numpy.typing as npt

from bcppl.contact.grasp import as_gripped
from bcppl.contact.model_copies import ModelCopies
from bcppl.contact.peg_model import SENSED, controls, hold, steps_of
from bcppl.robot.motion import Probe
from bcppl.threads import thread_count

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64] | npt.NDArray[np.bool_] | slice

_CONTROL = int(
    mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_MOCAP_POS | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)
_CONTROLS = 20  # six forces, then the positions of command and part, then their quaternions
_BLOCK = 32 * 2**20  # bytes that one call of mujoco.rollout may fill
POSE, WRENCH = slice(0, 7), slice(7, 13)  # places in a sensor row


@functools.cache
def _pool() -> mujoco.rollout.Rollout:
    return mujoco.rollout.Rollout(nthread=thread_count())


@dataclass(frozen=True, eq=False)
class Standing:
    """Where simulations stand.

    Attributes:
        state: (N, S) MuJoCo's full physics state: time, position 7, velocity 6.
        tail: (N, 2, 13) the last two sensor rows, which a stamp between two steps may still need.
    """

    state: Array
    tail: Array

    def __getitem__(self, rows: Rows) -> Standing:
        """The same for some of the particles."""
        return Standing(self.state[rows], self.tail[rows])

    def put(self, rows: Rows, other: Standing) -> Standing:
        """The same with some particles' rows replaced."""
        state, tail = self.state.copy(), self.tail.copy()
        state[rows], tail[rows] = other.state, other.tail
        return Standing(state, tail)


class Clock:
    """A probe at one time step: its model, its commands, and between which steps its stamps lie."""

    def __init__(self, model: mujoco.MjModel, probe: Probe, time_step: float) -> None:
        self.model = copy.copy(model)
        self.model.opt.timestep = time_step
        hold(self.model, probe)
        self.time_step = time_step
        self._low, self._high, self._weight = steps_of(probe, time_step)
        steps = self.step_after(len(self._high))
        self._controls = controls(probe, probe.command_times[0] + time_step * np.arange(max(1, steps)))
        self._copies = ModelCopies(self.model)
        self._data = [mujoco.MjData(self.model) for _ in range(thread_count())]

    def step_after(self, stamps: int) -> int:
        """The step at which a simulation stands once its first `stamps` stamps have been read."""
        return int(self._high[stamps - 1]) + 1 if stamps else 0

    def commanded(self, first: int, last: int) -> Array:
        """Where the command stands at stamps `first` to `last` (exclusive): (last-first, 3), metres."""
        return self._controls[self._low[first:last], 6:9]

    def beginning(self, particles: int) -> Standing:
        """At rest at the first command."""
        state = np.zeros((particles, mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        state[:, 1:8] = self._controls[0, 6:]
        return Standing(state, np.zeros((particles, 2, SENSED)))

    def read(
        self, standing: Standing, world_from_part: Array, unknowns: Mapping[str, Array], first: int, last: int
    ) -> tuple[Array, Standing]:
        """Run on from where stamps before `first` have been read, up to stamp `last` (exclusive).

        Args:
            standing: of N particles, `first` stamps read.
            world_from_part: (N, 7).
            unknowns: what else differs between the particles, from `grasp.in_series`.
            first: the next stamp.
            last: where to stop.

        Returns:
            Sensor rows (N, last-first, 13) at the stamps: the peg's pose, and the wrench that the environment
            exerts on it; and where the simulations stand now.
        """
        start, stop = self.step_after(first), self.step_after(last)
        sensed = np.empty((len(standing.state), stop - start, SENSED))
        state = standing.state
        for begin, end, states, rows in self._blocks(state, world_from_part, unknowns, start, stop):
            sensed[:, begin - start : end - start] = rows
            state = states[:, -1].copy()
        rows = np.concatenate([standing.tail, sensed], axis=1)
        read = self._at_stamps(rows, 2 - start, first, last)
        if "grasp_compliance" in unknowns:
            read = as_gripped(read, unknowns["grasp_compliance"])
        return read, Standing(state, rows[:, -2:].copy())

    def followed(self, world_from_part: Array, stamps: int) -> tuple[Array, Standing, Array]:
        """One simulation from the beginning, for a pose (1, 7) of the part.

        Returns:
            Rows (stamps, 13), where it stands after 0, 1, ... `stamps` stamps, and the peg's poses (S, 7) at
            all steps.
        """
        begin, stop = self.beginning(1), self.step_after(stamps)
        states, sensed = [begin.state], [begin.tail[0]]
        for *_, state, rows in self._blocks(begin.state, world_from_part, {}, 0, stop):
            states.append(state[0])
            sensed.append(rows[0])
        every, rows = np.concatenate(states), np.concatenate(sensed)
        after = np.array([self.step_after(count) for count in range(stamps + 1)])
        tails = np.stack([rows[after], rows[after + 1]], axis=1)
        path = rows[2:, POSE].copy()
        return self._at_stamps(rows[None], 2, 0, stamps)[0], Standing(every[after], tails), path

    def on_time(self, standing: Standing, stamps: int) -> npt.NDArray[np.bool_]:
        """Which particles (N,) are finite and as far as they should be: MuJoCo stops those that diverge."""
        expected = self.time_step * self.step_after(stamps)
        with np.errstate(invalid="ignore"):
            timely = np.abs(standing.state[:, 0] - expected) < 0.5 * self.time_step
        return timely & np.isfinite(standing.state).all(axis=1)

    def _at_stamps(self, rows: Array, shift: int, first: int, last: int) -> Array:
        """Sensor rows (N, last-first, 13) at stamps, of rows of which number k is that of step k - shift."""
        low, weight = rows[:, self._low[first:last] + shift], self._weight[first:last, None]
        if weight.any():
            high = rows[:, self._high[first:last] + shift]
            # q and -q are the same rotation: interpolate between two on the same side.
            opposite = np.sum(low[..., 3:7] * high[..., 3:7], axis=-1) < 0
            high[opposite, 3:7] *= -1.0
            low += weight * (high - low)
            # A stamp on a step is read as it is, whichever others are read with it.
            between = weight[:, 0] > 0
            low[:, between, 3:7] /= np.linalg.norm(low[:, between, 3:7], axis=-1, keepdims=True)
        # The sensors report what the flange exerts on the peg.
        low[..., WRENCH] *= -1.0
        return low

    def _blocks(
        self, state: Array, world_from_part: Array, unknowns: Mapping[str, Array], first: int, last: int
    ) -> Iterator[tuple[int, int, Array, Array]]:
        """Steps `first` to `last` (exclusive) in blocks.

        Of each: where it begins and ends, the states (N, steps, S) after each step, and the raw sensor rows
        (N, steps, 13). A sensor row describes the state before its step: row k is the time k * time_step.
        """
        particles = len(state)
        models = self._copies.of(unknowns)
        block = max(1, _BLOCK // (8 * max(1, particles) * (_CONTROLS + SENSED + state.shape[1])))
        for start in range(first, last, block):
            stop = min(last, start + block)
            control = np.empty((particles, stop - start, _CONTROLS))
            control[..., :9] = self._controls[start:stop, :9]
            if "damping" in unknowns:
                control[..., :6] *= unknowns["damping"][:, None]
            control[..., 9:12] = world_from_part[:, None, :3]
            control[..., 12:16] = self._controls[start:stop, 9:]
            control[..., 16:] = world_from_part[:, None, 3:]
            states, rows = _pool().rollout(
                models, self._data, np.ascontiguousarray(state), control, control_spec=_CONTROL
            )
            yield start, stop, states, rows
            state = states[:, -1]

"""Contact physics: a held peg follows a command and touches a part, for many poses of the part at once."""

from __future__ import annotations

import functools
import itertools
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl.arrays import Array, ArrayRecord, Indices, Mask
from bcppl.contact.free_motion import FreeMotion, first_possible_contact, simulate_free_motion
from bcppl.contact.grasp_compliance import springs_in_series
from bcppl.contact.mujoco_model import SENSOR_COLUMNS, ContactParameters, build_model, check_probe
from bcppl.contact.nuisances import CONTACT_ONLY, Nuisances
from bcppl.contact.stepping import NORMAL, POSE, WRENCH, SimulationState, Stepper
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.poses import as_pose
from bcppl.robot.motion import Probe

Selection = Tensor | Indices | Mask | slice

_FARTHEST = 1.0  # m: a peg farther than this from its command has diverged
_FULL, _HALVED, _DIVERGED = 0, 1, 2


class PegPhysics:
    """A peg held by a Cartesian spring-damper, and a fixed part, in MuJoCo.

    The spring pulls the peg's origin (where it is held) to the commanded one; stiffness and damping are the
    probe's, along and about the commanded peg's axes; the damping acts on the velocity relative to the
    command's. Gravity is compensated. Everything is at rest before the first command.

    Attributes:
        part, peg: the solids; the peg's frame has its origin where it is held, about which
            wrenches are simulated.
        parameters: of the contact and of the arm.
        share_free_motion: whether the motion before contact is simulated once for all particles; the results
            are the same to the bit.
        effort: the cost so far: items are rollouts, amount is simulated seconds.

    Raises:
        InputError: the part or the peg has no convex pieces and is not convex.
    """

    __caches__ = ("_simulations",)  # of the other attributes

    def __init__(
        self,
        part: Part,
        peg: Part,
        parameters: ContactParameters | None = None,
        share_free_motion: bool = True,
    ) -> None:
        self.part, self.peg, self.share_free_motion = part, peg, share_free_motion
        self.parameters = ContactParameters() if parameters is None else parameters
        self.model = build_model(part, peg, self.parameters)
        self.effort = Effort()
        self._simulations: WeakKeyDictionary[Probe, ProbeSimulation] = WeakKeyDictionary()

    def start(
        self, world_from_part: Tensor | Array, probe: Probe, nuisances: Nuisances | None = None
    ) -> Rollout:
        """Rollouts of a probe before the first stamp, for poses (N, 7) of the part.

        The free motion is simulated once for all particles unless the controller or the grasp's compliance
        differs between them.

        Raises:
            InputError: the poses are not (N, 7), finite and with unit quaternions, the probe cannot be
                simulated, or a nuisance parameter does not fit or is physically impossible.
        """
        poses = torch.as_tensor(world_from_part).detach().cpu().numpy().astype(np.float64)
        as_pose(poses, "the part's pose")
        if poses.ndim != 2:
            raise InputError(f"the part's poses have shape {poses.shape}; give (N, 7).")
        given = {} if nuisances is None else nuisances.rows(len(poses))
        if probe not in self._simulations:
            self._simulations[probe] = ProbeSimulation(self, probe)
        simulation = self._simulations[probe]
        return Rollout.at_rest(simulation, poses, springs_in_series(given, np.asarray(probe.stiffness)))


class ProbeSimulation:
    """The steppers, at the full and half the time step, and the free motion, of all rollouts of a probe."""

    def __init__(self, physics: PegPhysics, probe: Probe) -> None:
        check_probe(probe)
        self.part, self.peg, self.effort = physics.part, physics.peg, physics.effort
        self.share_free_motion = physics.share_free_motion
        self.name, self.stamps = probe.name, np.asarray(probe.stamps, dtype=np.float64)
        self.steppers = [Stepper(physics.model, probe, physics.parameters.time_step / k) for k in (1, 2)]

    @functools.cached_property
    def free_motion(self) -> FreeMotion:
        """The whole probe with the part out of reach."""
        return simulate_free_motion(self.steppers[0], len(self.stamps))


@dataclass(frozen=True, eq=False)
class _Particles(ArrayRecord):
    """The state of N rollouts: poses (N, 7), nuisances (N, ...), and sensor rows (N, count, 16) so far.

    `free` (N,) counts stamps of shared free motion; `level` (N,) is `_FULL`, `_HALVED` or `_DIVERGED`.
    """

    world_from_part: Array
    nuisances: Mapping[str, Array]
    rows: Array
    state: SimulationState
    free: Indices
    level: Indices


class Rollout:
    """One probe simulated for N poses of the part, as far as it was asked for; indexing copies.

    Many rollouts are copies of few where moves are screened, and most of them are never asked for anything:
    they are made when the first is.
    """

    def __init__(
        self, simulation: ProbeSimulation, particles: _Particles, copies: Indices | None = None
    ) -> None:
        self.simulation, self._kept, self._copies = simulation, particles, copies

    @classmethod
    def at_rest(
        cls, simulation: ProbeSimulation, world_from_part: Array, nuisances: Mapping[str, Array]
    ) -> Rollout:
        """Before the first stamp."""
        count = len(world_from_part)
        free, level = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        rows, state = np.empty((count, 0, SENSOR_COLUMNS)), simulation.steppers[0].at_rest(count)
        return cls(simulation, _Particles(world_from_part, nuisances, rows, state, free, level))

    @property
    def _particles(self) -> _Particles:
        if self._copies is not None:
            self._kept, self._copies = self._kept[self._copies], None
        return self._kept

    def __len__(self) -> int:
        return len(self._kept.world_from_part if self._copies is None else self._copies)

    @property
    def count(self) -> int:
        """The number of stamps that have been simulated."""
        return int(self._kept.rows.shape[1])

    @property
    def nuisances(self) -> Mapping[str, Array]:
        """Parameters that differ between the particles, by name (N, ...)."""
        return self._particles.nuisances

    @property
    def wrench(self) -> Array:
        """(N, count, 6) force (N) and torque (N m) of the environment on the peg at the stamps.

        In the peg's frame about its origin, as a wrist sensor measures them; NaN after divergence.
        """
        return self._particles.rows[..., WRENCH]

    @property
    def normals(self) -> Array:
        """(N, count, 3) the normal of the contact with the largest force, from the part into the peg.

        In the world; of a stamp between two steps the mean of both; 0 without contact, NaN after divergence.
        """
        return self._particles.rows[..., NORMAL]

    @property
    def world_from_peg(self) -> Array:
        """(N, count, 7); NaN after divergence."""
        return self._particles.rows[..., POSE]

    @property
    def diverged(self) -> Mask:
        """(N,) simulations that diverged even at half the time step."""
        return np.asarray(self._particles.level == _DIVERGED)

    def named(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays of all that has been simulated, by name."""
        return self._particles.named()

    def renamed(self, named: Mapping[str, npt.NDArray[Any]]) -> Rollout:
        """The rollouts of the same particles with all that had been simulated.

        Raises:
            InputError: an array is missing, or has another type or shape.
        """
        particles = self._particles.renamed(named)
        if not ((particles.level >= _FULL) & (particles.level <= _DIVERGED) & (particles.free >= 0)).all():
            raise InputError("a rollout's stamps or levels are out of range.")
        return Rollout(self.simulation, particles)

    def __getitem__(self, index: Selection) -> Rollout:
        """Rollouts of some particles, in the order of an index tensor, a mask or a slice."""
        every = np.arange(len(self)) if self._copies is None else self._copies
        rows = every[rows_of(index)]
        if len(rows) > len(self._kept.world_from_part):
            return Rollout(self.simulation, self._kept, rows)
        return Rollout(self.simulation, self._kept[rows])

    def where(self, mask: Selection, other: Rollout) -> Rollout:
        """This rollout's particles where a mask (N,) is true, the other's elsewhere, both run equally far.

        Raises:
            ValueError: the other is of another physics or probe, or has other nuisance parameters.
        """
        if other.simulation is not self.simulation or other.nuisances.keys() != self.nuisances.keys():
            raise ValueError(f"rollouts of probe {self.simulation.name!r} of two programs cannot be merged.")
        count = max(self.count, other.count)
        rows = np.flatnonzero(~np.asarray(rows_of(mask), dtype=bool))
        theirs = other.advance(count)._particles[rows]
        return Rollout(self.simulation, self.advance(count)._particles.put(rows, theirs))

    def advance(self, count: int) -> Rollout:
        """Simulate the first `count` stamps, from the last one so far; returns itself.

        A particle that diverges is run again from the start at half the time step; its rows so far are kept.
        One that diverges again is NaN from there on.
        """
        done = self.count
        if count <= done:
            return self
        fresh = np.full((len(self), count - done, SENSOR_COLUMNS), np.nan)
        if len(self):
            with self.simulation.effort.measure(items=len(self) if done == 0 else 0):
                if done == 0 and self._shares_free_motion:
                    self._skip_free_motion()
                full, halved = (np.flatnonzero(self._particles.level == level) for level in (_FULL, _HALVED))
                self._run(_FULL, full, done, count, fresh)
                self._run(_HALVED, halved, done, count, fresh)
                self._run_again(full[~self._sound(_FULL, full, done, count, fresh)], done, count, fresh)
                self._lose(halved[~self._sound(_HALVED, halved, done, count, fresh)], fresh)
        self._update(rows=np.concatenate([self._particles.rows, fresh], axis=1))
        return self

    def _update(self, **changes: Any) -> None:
        self._kept = replace(self._particles, **changes)

    @property
    def _shares_free_motion(self) -> bool:
        return self.simulation.share_free_motion and self.nuisances.keys() <= CONTACT_ONLY

    def _skip_free_motion(self) -> None:
        """Begin each simulation at the last stamp of its free motion."""
        shared, part, peg = self.simulation.free_motion, self.simulation.part, self.simulation.peg
        held = self.nuisances.get("grip_from_peg")
        free = first_possible_contact(shared, part, peg, self._particles.world_from_part, held)
        self._update(free=free, state=shared.states[free])

    def _run(self, level: int, members: Indices, first: int, last: int, fresh: Array) -> None:
        """Write stamps `first` to `last` of some particles into `fresh`, from the end of free motion on."""
        if len(members) == 0:
            return
        particles, stepper = self._particles, self.simulation.steppers[level]
        free, state = particles.free[members], particles.state
        if level == _FULL and self._shares_free_motion:
            fresh[members] = self.simulation.free_motion.rows[first:last]
        cuts = [first, *sorted({int(f) for f in free if first < f < last}), last]
        for start, stop in itertools.pairwise(cuts):
            moving = members[free <= start]
            if len(moving) == 0:
                continue
            nuisances = {name: value[moving] for name, value in self.nuisances.items()}
            rows, reached = stepper.run(
                state[moving], particles.world_from_part[moving], nuisances, start, stop
            )
            fresh[moving, start - first : stop - first] = rows
            state = state.put(moving, reached)
            steps = stepper.step_after(stop) - stepper.step_after(start)
            self.simulation.effort.amount += len(moving) * stepper.time_step * steps
        self._update(state=state)

    def _sound(self, level: int, members: Indices, first: int, last: int, fresh: Array) -> Mask:
        """Members (M,) that did not diverge."""
        moving = self._particles.free[members] < last
        rows, command = fresh[members], self.simulation.steppers[0].commanded(first, last)
        with np.errstate(invalid="ignore"):
            near = (np.linalg.norm(rows[..., :3] - command, axis=-1) < _FARTHEST).all(axis=1)
        finite = np.isfinite(rows).all(axis=(1, 2))
        timely = self.simulation.steppers[level].on_time(self._particles.state[members], last)
        return np.asarray(near & finite & (timely | ~moving))

    def _run_again(self, members: Indices, first: int, last: int, fresh: Array) -> None:
        """Run some particles from the start at half the time step."""
        if len(members) == 0:
            return
        level, free = self._particles.level.copy(), self._particles.free.copy()
        level[members], free[members] = _HALVED, 0
        rest = self.simulation.steppers[_HALVED].at_rest(len(members))
        self._update(level=level, free=free, state=self._particles.state.put(members, rest))
        whole = np.full((len(self), last, SENSOR_COLUMNS), np.nan)
        self._run(_HALVED, members, 0, last, whole)
        fresh[members] = whole[members, first:]
        self._lose(members[~self._sound(_HALVED, members, 0, last, whole)], fresh)

    def _lose(self, members: Indices, fresh: Array) -> None:
        """Mark particles as diverged, and warn."""
        if len(members) == 0:
            return
        level = self._particles.level.copy()
        level[members] = _DIVERGED
        self._update(level=level)
        fresh[members] = np.nan
        warnings.warn(
            f"{len(members)} of {len(self)} rollouts of probe {self.simulation.name!r} diverged, also at "
            "half the time step; they count as impossible.",
            RuntimeWarning,
            stacklevel=3,
        )


def rows_of(index: Selection) -> Indices | Mask | slice:
    """An index tensor, a mask or a slice as numpy takes it."""
    return index.detach().cpu().numpy() if isinstance(index, Tensor) else index

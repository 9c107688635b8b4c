"""Contact physics: a held peg follows a command and touches a part, for many poses of the part at once."""

from __future__ import annotations

import functools
import itertools
import warnings
from collections.abc import Mapping
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl.contact.approach import Approach, first_possible_touch, free_approach
from bcppl.contact.grasp import in_series
from bcppl.contact.peg_model import SENSED, ContactParameters, build_model, check_probe
from bcppl.contact.stepping import POSE, WRENCH, Clock, Standing
from bcppl.contact.unknowns import FELT_IN_CONTACT_ONLY, Unknowns
from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.geometry.parts import Part
from bcppl.poses import as_pose
from bcppl.robot.motion import Probe

Array = npt.NDArray[np.float64]
Selection = Tensor | npt.NDArray[np.int64] | npt.NDArray[np.bool_] | slice

_FARTHEST = (
    1.0  # m: a peg that is farther than this from where it would be in free motion has been flung away
)
_FULL, _HALVED, _DIVERGED = 0, 1, 2


class PegPhysics:
    """A peg held by a Cartesian spring-damper, beside a fixed part, in MuJoCo.

    The spring pulls the peg's origin (the wrench sensor) to the commanded one; stiffness and damping are the
    probe's, along and about the commanded peg's axes; the damping acts on the velocity relative to the
    command's. Gravity is compensated. Everything is at rest before the first command.

    Attributes:
        effort: what has been spent: items are rollouts begun, amount is seconds simulated.
    """

    def __init__(
        self, part: Part, peg: Part, parameters: ContactParameters | None = None, skip: bool = True
    ) -> None:
        """Build the model.

        Args:
            part: what is touched.
            peg: what is held, its frame's origin at the wrench sensor.
            parameters: of the contact and of the arm.
            skip: simulate the free approach once for all particles; results are the same to the bit.

        Raises:
            InputError: the part or the peg has no convex pieces and is not convex.
        """
        self.part, self.peg, self.skip = part, peg, skip
        self.parameters = ContactParameters() if parameters is None else parameters
        self.model = build_model(part, peg, self.parameters)
        self.effort = Effort()
        self._sessions: WeakKeyDictionary[Probe, Session] = WeakKeyDictionary()

    def start(
        self, world_from_part: Tensor | Array, probe: Probe, unknowns: Unknowns | None = None
    ) -> Rollout:
        """Rollouts of a probe, not yet run, for poses (N, 7) of the part.

        Where friction, a contact's settling or the peg's place in the hand is unknown, the free approach is
        still simulated once for all; where the controller or the grasp's compliance is, each particle comes
        near in its own way, and nothing is skipped.

        Args:
            world_from_part: (N, 7).
            probe: what the arm does.
            unknowns: what else differs between the particles; None for nothing.

        Raises:
            InputError: the poses are not (N, 7), finite and with unit quaternions, the probe cannot be
                simulated, or an unknown does not fit or is physically impossible.
        """
        poses = torch.as_tensor(world_from_part).detach().cpu().numpy().astype(np.float64)
        if poses.ndim != 2 or poses.shape[1] != 7 or not np.isfinite(poses).all():
            raise InputError(
                f"the part's poses have shape {poses.shape} or are not finite; "
                "give (N, 7) numbers x y z qw qx qy qz."
            )
        as_pose(poses, "the part's pose")
        rows = {} if unknowns is None else unknowns.rows(len(poses))
        if probe not in self._sessions:
            self._sessions[probe] = Session(self, probe)
        return Rollout.at_rest(self._sessions[probe], poses, in_series(rows, np.asarray(probe.stiffness)))


class Session:
    """What all rollouts of one probe share: clocks at the full and half the time step, the free approach."""

    def __init__(self, physics: PegPhysics, probe: Probe) -> None:
        check_probe(probe)
        self.part, self.peg, self.skip, self.effort = physics.part, physics.peg, physics.skip, physics.effort
        self.name, self.stamps = probe.name, np.asarray(probe.stamps, dtype=np.float64)
        self.clocks = [Clock(physics.model, probe, physics.parameters.time_step / k) for k in (1, 2)]

    @functools.cached_property
    def approach(self) -> Approach:
        """The whole probe with the part out of reach."""
        return free_approach(self.clocks[0], len(self.stamps))


class Rollout:
    """One probe simulated for N poses of the part, as far as it was asked for; indexing copies.

    Attributes:
        world_from_part: (N, 7).
        unknowns: what else differs between the particles, by name (N, ...).
        wrench: (N, count, 6) what the environment exerts on the peg at the stamps: force (N), torque (N m),
            in the peg's frame about its origin, as a wrist sensor reads it; NaN once diverged.
        world_from_peg: (N, count, 7).
        count: the number of stamps that have been simulated.
        diverged: (N,) simulations that failed even at half the time step.
    """

    def __init__(
        self,
        session: Session,
        world_from_part: Array,
        unknowns: Mapping[str, Array],
        rows: Array,
        standing: Standing,
        free: npt.NDArray[np.int64],
        level: npt.NDArray[np.int64],
    ) -> None:
        self.session, self.world_from_part, self.unknowns = session, world_from_part, unknowns
        self._rows, self._standing, self._free, self._level = rows, standing, free, level

    @classmethod
    def at_rest(cls, session: Session, world_from_part: Array, unknowns: Mapping[str, Array]) -> Rollout:
        """Before the first stamp."""
        particles = len(world_from_part)
        free, level = np.zeros(particles, dtype=np.int64), np.zeros(particles, dtype=np.int64)
        standing = session.clocks[0].beginning(particles)
        none = np.empty((particles, 0, SENSED))
        return cls(session, world_from_part, unknowns, none, standing, free, level)

    @property
    def _skips(self) -> bool:
        """Whether the free approach is the same for all particles, and simulated once."""
        return self.session.skip and self.unknowns.keys() <= FELT_IN_CONTACT_ONLY

    def _skip_approach(self) -> None:
        """Begin each simulation at the last stamp of its free approach."""
        session = self.session
        self._free = first_possible_touch(
            session.approach,
            session.part,
            session.peg,
            self.world_from_part,
            self.unknowns.get("grip_from_peg"),
        )
        self._standing = session.approach.standing[self._free]

    def __len__(self) -> int:
        return len(self.world_from_part)

    @property
    def count(self) -> int:
        """The number of stamps that have been simulated."""
        return int(self._rows.shape[1])

    @property
    def wrench(self) -> Array:
        """(N, count, 6) force and torque on the peg, in the peg's frame about its origin."""
        return self._rows[..., WRENCH]

    @property
    def world_from_peg(self) -> Array:
        """(N, count, 7)."""
        return self._rows[..., POSE]

    @property
    def diverged(self) -> npt.NDArray[np.bool_]:
        """(N,) simulations that failed even at half the time step."""
        return np.asarray(self._level == _DIVERGED)

    def __getitem__(self, index: Selection) -> Rollout:
        """Rollouts of some particles, in the order of an index tensor, a mask or a slice."""
        rows = rows_of(index)
        return Rollout(
            self.session,
            self.world_from_part[rows].copy(),
            {name: value[rows].copy() for name, value in self.unknowns.items()},
            self._rows[rows].copy(),
            self._standing[rows],
            self._free[rows],
            self._level[rows],
        )

    def where(self, mask: Selection, other: Rollout) -> Rollout:
        """For each particle this rollout where a mask (N,) is true, else the other; both are run equally far.

        Raises:
            InputError: the other is of another probe or another number of particles, or leaves something
                else open.
        """
        alike = other.session is self.session and other.unknowns.keys() == self.unknowns.keys()
        if not alike or len(other) != len(self):
            raise InputError(
                f"rollouts of {len(self)} particles of probe {self.session.name!r} cannot be merged with "
                f"{len(other)} of {other.session.name!r}; both must be of one physics, probe and "
                "population, with the same things unknown."
            )
        count = max(self.count, other.count)
        taken = np.flatnonzero(~np.asarray(rows_of(mask), dtype=bool))
        mine = self.advance(count)[:]
        theirs = other.advance(count)[taken]
        mine.world_from_part[taken], mine._rows[taken] = theirs.world_from_part, theirs._rows
        for name, value in mine.unknowns.items():
            value[taken] = theirs.unknowns[name]
        mine._free, mine._level = mine._free.copy(), mine._level.copy()
        mine._free[taken], mine._level[taken] = theirs._free, theirs._level
        mine._standing = mine._standing.put(taken, theirs._standing)
        return mine

    def advance(self, count: int) -> Rollout:
        """Run until the first `count` stamps are known, from where it stopped; returns itself.

        A particle that diverges is run again from the start at half the time step; what was read of it
        before stays. One that diverges again is NaN from there on.

        Raises:
            InputError: the probe has fewer stamps.
        """
        if count > len(self.session.stamps):
            raise InputError(
                f"{count} stamps are asked of probe {self.session.name!r}, which has "
                f"{len(self.session.stamps)}; ask for no more."
            )
        done = self.count
        if count <= done or len(self) == 0:
            return self if count <= done else self._extended(np.empty((0, count - done, SENSED)))
        with self.session.effort.measure(items=len(self) if done == 0 else 0):
            if done == 0 and self._skips:
                self._skip_approach()
            fresh = np.full((len(self), count - done, SENSED), np.nan)
            full = np.flatnonzero(self._level == _FULL)
            halved = np.flatnonzero(self._level == _HALVED)
            self._run(0, full, done, count, fresh)
            self._run(1, halved, done, count, fresh)
            again = full[~self._sound(0, full, done, count, fresh)]
            self._again(again, done, count, fresh)
            lost = halved[~self._sound(1, halved, done, count, fresh)]
            self._lose(lost, fresh)
        return self._extended(fresh)

    def _extended(self, fresh: Array) -> Rollout:
        self._rows = np.concatenate([self._rows, fresh], axis=1)
        return self

    def _run(self, level: int, members: npt.NDArray[np.int64], first: int, last: int, fresh: Array) -> None:
        """Read stamps `first` to `last` of some particles into `fresh`, from where their free motion ends."""
        if len(members) == 0:
            return
        clock, free = self.session.clocks[level], self._free[members]
        if level == _FULL and self._skips:
            fresh[members] = self.session.approach.rows[first:last]
        cuts = [first, *sorted({int(f) for f in free if first < f < last}), last]
        standing = self._standing
        for start, stop in itertools.pairwise(cuts):
            moving = members[free <= start]
            if len(moving) == 0:
                continue
            unknowns = {name: value[moving] for name, value in self.unknowns.items()}
            rows, moved = clock.read(standing[moving], self.world_from_part[moving], unknowns, start, stop)
            fresh[moving, start - first : stop - first] = rows
            standing = standing.put(moving, moved)
            self.session.effort.amount += (
                len(moving) * clock.time_step * (clock.step_after(stop) - clock.step_after(start))
            )
        self._standing = standing

    def _sound(
        self, level: int, members: npt.NDArray[np.int64], first: int, last: int, fresh: Array
    ) -> npt.NDArray[np.bool_]:
        """Which members (M,) did not diverge."""
        if len(members) == 0:
            return np.zeros(0, dtype=bool)
        moving = self._free[members] < last
        rows = fresh[members]
        held = self.session.clocks[0].commanded(first, last)
        with np.errstate(invalid="ignore"):
            near = (np.linalg.norm(rows[..., :3] - held, axis=-1) < _FARTHEST).all(axis=1)
        finite = np.isfinite(rows).all(axis=(1, 2))
        timely = self.session.clocks[level].on_time(self._standing[members], last)
        sound: npt.NDArray[np.bool_] = near & finite & (timely | ~moving)
        return sound

    def _again(self, members: npt.NDArray[np.int64], first: int, last: int, fresh: Array) -> None:
        """Run some particles from the start at half the time step."""
        if len(members) == 0:
            return
        self._level, self._free = self._level.copy(), self._free.copy()
        self._level[members], self._free[members] = _HALVED, 0
        self._standing = self._standing.put(members, self.session.clocks[1].beginning(len(members)))
        whole = np.full((len(self), last, SENSED), np.nan)
        self._run(1, members, 0, last, whole)
        fresh[members] = whole[members, first:]
        self._lose(members[~self._sound(1, members, 0, last, whole)], fresh)

    def _lose(self, members: npt.NDArray[np.int64], fresh: Array) -> None:
        """Mark particles as diverged, and say so."""
        if len(members) == 0:
            return
        self._level = self._level.copy()
        self._level[members] = _DIVERGED
        fresh[members] = np.nan
        warnings.warn(
            f"{len(members)} of {len(self)} rollouts of probe {self.session.name!r} diverged, also at half "
            "the time step; they count as impossible.",
            RuntimeWarning,
            stacklevel=3,
        )


def rows_of(index: Selection) -> npt.NDArray[np.int64] | npt.NDArray[np.bool_] | slice:
    """An index tensor, a mask or a slice as numpy takes it."""
    return index.detach().cpu().numpy() if isinstance(index, Tensor) else index

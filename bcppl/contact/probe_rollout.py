"""Rollouts of a probe with contact sensing, run together and only as far as asked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl.arrays import Array, ArrayRecord
from bcppl.contact.nuisances import Nuisances
from bcppl.contact.physics import PegPhysics, Rollout, Selection, rows_of
from bcppl.contact.sensing.location import ContactSensing, SensingState
from bcppl.errors import InputError
from bcppl.robot.motion import Probe


@dataclass(frozen=True, eq=False)
class _Sensed(ArrayRecord):
    """The state of contact sensing, and contact locations (N, count, 3) so far."""

    state: SensingState
    contacts: Array


class ProbeRollout:
    """Contact locations, wrenches and peg poses along one probe, for N poses of the part; indexing copies.

    Attributes:
        rollout: the physics.
        sensing: of contact locations from the wrench.
        inputs: the tensors that it depends on: the poses (N, 7) of the part, and nuisance parameters.
    """

    def __init__(
        self, rollout: Rollout, sensing: ContactSensing, inputs: tuple[Tensor, ...], sensed: _Sensed
    ) -> None:
        self.rollout, self.sensing, self.inputs, self._sensed = rollout, sensing, inputs, sensed

    @classmethod
    def start(
        cls,
        physics: PegPhysics,
        sensing: ContactSensing,
        world_from_part: Tensor,
        probe: Probe,
        nuisances: Nuisances | None = None,
    ) -> ProbeRollout:
        """Before the first stamp, for poses (N, 7) of the part.

        Poses and wrenches are of the grip, and contact is located on a nominally grasped peg, whatever
        `nuisances.grip_from_peg` is, as in a measured recording.

        Raises:
            InputError: the poses are not (N, 7) and finite, the probe cannot be simulated, its stamps are
                not at sensing's rate, or a nuisance parameter does not fit or is physically impossible.
        """
        sensing.check_rate(probe.stamps, f"probe {probe.name!r}")
        rollout = physics.start(world_from_part, probe, nuisances)
        inputs = (world_from_part, *(() if nuisances is None else nuisances.tensors))
        state, contacts = sensing.start(len(rollout)), np.empty((len(rollout), 0, 3))
        return cls(rollout, sensing, inputs, _Sensed(state, contacts))

    def __len__(self) -> int:
        return len(self.rollout)

    @property
    def count(self) -> int:
        """The number of stamps that have been simulated."""
        return int(self._sensed.contacts.shape[1])

    @property
    def diverged(self) -> Tensor:
        """(N,) particles whose physics diverged; their poses are NaN."""
        return torch.from_numpy(self.rollout.diverged)

    def advance(self, count: int) -> ProbeRollout:
        """Simulate the first `count` stamps, from the last one so far; returns itself."""
        done = self.count
        if count > done:
            self.rollout.advance(count)
            wrench, sensed = self.rollout.wrench[:, done:count], self._sensed
            fresh, state = self.sensing.contacts(wrench, sensed.state)
            self._sensed = _Sensed(state, np.concatenate([sensed.contacts, fresh], axis=1))
        return self

    def window(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Contacts and poses at stamps `first` to `last` (exclusive), simulated where they have not been yet.

        Returns:
            Contact locations (N, last-first, 3) in the peg's frame, NaN where there is none, and its poses
            (N, last-first, 7), NaN where the physics diverged.
        """
        self.advance(last)
        pose = torch.from_numpy(self.rollout.world_from_peg[:, first:last].copy())
        return torch.from_numpy(self._sensed.contacts[:, first:last].copy()), pose

    def wrench(self, first: int, last: int) -> Tensor:
        """The wrench at a wrist sensor without noise or offset, at stamps `first` to `last` (exclusive).

        Simulated where it has not been yet; neither tared nor filtered.

        Returns:
            (N, last-first, 6) force (N) and torque (N m) of the environment on the peg, in the peg's frame
            about its origin, the sensor; NaN where the physics diverged.
        """
        self.advance(last)
        return torch.from_numpy(self.rollout.wrench[:, first:last].copy())

    def contact_normals(self, first: int, last: int) -> Tensor:
        """Unit normals (N, last-first, 3), in the world, of the contact with the largest force.

        From the part into the peg; NaN where there is no contact, or the physics diverged.
        """
        self.advance(last)
        normal = torch.from_numpy(self.rollout.normals[:, first:last].copy())
        size = normal.norm(dim=-1, keepdim=True)
        return torch.where(size > 0.0, normal / size, torch.nan)

    def stored(self) -> dict[str, npt.NDArray[Any]]:
        """The numbers of all that has been simulated, by name (`bcppl.traces.carried.Storable`)."""
        return {
            **{f"rollout.{name}": array for name, array in self.rollout.named().items()},
            **{f"sensed.{name}": array for name, array in self._sensed.named().items()},
        }

    def restored(self, numbers: Mapping[str, npt.NDArray[Any]]) -> ProbeRollout:
        """The rollouts of the same particles with all that had been simulated.

        Raises:
            InputError: the numbers are those of other particles, or of another probe.
        """
        physics, sensed = (
            {n.removeprefix(begin): each for n, each in numbers.items() if n.startswith(begin)}
            for begin in ("rollout.", "sensed.")
        )
        rollout, record = self.rollout.renamed(physics), self._sensed.renamed(sensed)
        if rollout.count != record.contacts.shape[1]:
            raise InputError("a rollout's physics and contacts are of different lengths.")
        return ProbeRollout(rollout, self.sensing, self.inputs, record)

    def __getitem__(self, index: Selection) -> ProbeRollout:
        """The rollouts of some particles, in the order of an index tensor, a mask or a slice."""
        rows = rows_of(index)
        chosen = index if isinstance(index, slice) else torch.as_tensor(rows)
        inputs = tuple(each[chosen] for each in self.inputs)
        return ProbeRollout(self.rollout[rows], self.sensing, inputs, self._sensed[rows])

    def where(self, mask: Tensor, other: ProbeRollout) -> ProbeRollout:
        """This rollout's particles where a mask (N,) is true, the other's elsewhere."""
        count, rows = max(self.count, other.count), np.flatnonzero(~mask.cpu().numpy())
        sensed = self.advance(count)._sensed.put(rows, other.advance(count)._sensed[rows])
        inputs = tuple(
            torch.where(mask.reshape(-1, *[1] * (mine.ndim - 1)), mine, theirs)
            for mine, theirs in zip(self.inputs, other.inputs, strict=True)
        )
        return ProbeRollout(self.rollout.where(mask, other.rollout), self.sensing, inputs, sensed)

"""A probe as its particles feel it: contact physics and sensing, run together and only as far as asked."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bcppl import poses
from bcppl.contact.physics import PegPhysics, Rollout, Selection, rows_of
from bcppl.contact.unknowns import Unknowns
from bcppl.contact.wrench import Sensing, SensingState
from bcppl.robot.motion import Probe

Array = npt.NDArray[np.float64]


class ContactTrack:
    """Contact locations and peg poses along one probe, for N poses of the part; indexing copies.

    Attributes:
        rollout: the physics.
        sensing: how contacts are read from the wrench.
        inputs: what the track hangs on: the poses (N, 7) of the part, and what else is unknown.
    """

    def __init__(
        self,
        rollout: Rollout,
        sensing: Sensing,
        inputs: tuple[Tensor, ...],
        state: SensingState,
        contacts: Array,
    ) -> None:
        self.rollout, self.sensing, self.inputs = rollout, sensing, inputs
        self._state, self._contacts = state, contacts

    @classmethod
    def start(
        cls,
        physics: PegPhysics,
        sensing: Sensing,
        world_from_part: Tensor,
        probe: Probe,
        unknowns: Unknowns | None = None,
    ) -> ContactTrack:
        """Before the first stamp, for poses (N, 7) of the part.

        Poses and wrenches are of the grip, and contact is located on a peg that is held as planned, whatever
        `unknowns.grip_from_peg` is: what is measured is read in the same way.

        Raises:
            InputError: the poses are not (N, 7) and finite, the probe cannot be simulated, its stamps are
                not at sensing's rate, or an unknown does not fit or is physically impossible.
        """
        sensing.check_rate(probe.stamps, f"probe {probe.name!r}")
        rollout = physics.start(world_from_part, probe, unknowns)
        inputs = (world_from_part, *(() if unknowns is None else unknowns.tensors))
        particles = len(rollout)
        return cls(rollout, sensing, inputs, sensing.start(particles), np.empty((particles, 0, 3)))

    def __len__(self) -> int:
        return len(self.rollout)

    @property
    def count(self) -> int:
        """The number of stamps that are known already."""
        return int(self._contacts.shape[1])

    @property
    def diverged(self) -> Tensor:
        """(N,) particles whose physics failed; their poses are NaN."""
        return torch.from_numpy(self.rollout.diverged)

    def advance(self, count: int) -> ContactTrack:
        """Know the first `count` stamps; returns itself."""
        done = self.count
        if count > done:
            self.rollout.advance(count)
            fresh, self._state = self.sensing.contacts(self.rollout.wrench[:, done:count], self._state)
            self._contacts = np.concatenate([self._contacts, fresh], axis=1)
        return self

    def window(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Stamps `first` to `last` (exclusive), simulated only if they are not known yet.

        Returns:
            Contact locations (N, last-first, 3) in the peg's frame, NaN where there is none, and its poses
            (N, last-first, 7), NaN where the physics diverged.
        """
        self.advance(last)
        pose = torch.from_numpy(self.rollout.world_from_peg[:, first:last].copy())
        return torch.from_numpy(self._contacts[:, first:last].copy()), pose

    def wrench(self, first: int, last: int) -> Tensor:
        """What a wrist sensor without noise or offset reads at stamps `first` to `last` (exclusive).

        Simulated only if it is not known yet; not tared and not filtered.

        Returns:
            (N, last-first, 6) force (N) and torque (N m) that the environment exerts on the peg, in the
            peg's frame about its origin, the sensor; NaN where the physics diverged.
        """
        self.advance(last)
        return torch.from_numpy(self.rollout.wrench[:, first:last].copy())

    def pushes(self, first: int, last: int) -> Tensor:
        """Unit directions (N, last-first, 3), in the world, of the force that the part exerts on the peg.

        NaN where there is none, or the physics diverged.
        """
        self.advance(last)
        pose = torch.from_numpy(self.rollout.world_from_peg[:, first:last].copy())
        force = torch.from_numpy(self.rollout.wrench[:, first:last, :3].copy())
        size = force.norm(dim=-1, keepdim=True)
        lost = torch.isnan(pose).any(dim=-1, keepdim=True)
        turn = poses.rotation_matrix(torch.where(lost, poses.identity(), pose))
        pushed = (turn @ force[..., None])[..., 0] / size
        return torch.where(lost | (size == 0.0), torch.nan, pushed)

    def __getitem__(self, index: Selection) -> ContactTrack:
        """The tracks of some particles, in the order of an index tensor, a mask or a slice."""
        rows = rows_of(index)
        chosen = index if isinstance(index, slice) else torch.as_tensor(rows)
        kept = tuple(each[chosen] for each in self.inputs)
        return ContactTrack(
            self.rollout[rows], self.sensing, kept, self._state[rows], self._contacts[rows].copy()
        )

    def where(self, mask: Tensor, other: ContactTrack) -> ContactTrack:
        """For each particle this track where a mask (N,) is true, else the other; both are run as far."""
        count = max(self.count, other.count)
        self.advance(count)
        other.advance(count)
        rollout = self.rollout.where(mask, other.rollout)
        taken = np.flatnonzero(~mask.cpu().numpy())
        contacts = self._contacts.copy()
        contacts[taken] = other._contacts[taken]
        inputs = tuple(
            torch.where(mask.reshape(-1, *[1] * (mine.ndim - 1)), mine, theirs)
            for mine, theirs in zip(self.inputs, other.inputs, strict=True)
        )
        return ContactTrack(
            rollout, self.sensing, inputs, self._state.put(taken, other._state[taken]), contacts
        )

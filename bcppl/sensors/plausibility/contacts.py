"""What a probe felt and where its peg was: stamps in contact, and how well they agree with the part."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from bcppl import poses
from bcppl.arrays import Array, Indices, Mask
from bcppl.geometry.gap import PegGap
from bcppl.geometry.parts import Guess, Part
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.sensors.measurements import Measurement
from bcppl.sensors.plausibility.search import Found, best_pose

ZERO = 10  # rows at a probe's start whose mean is the sensor's zero
LEAST = 2.0  # N, and
SHARE = 0.1  # of the largest force: the peg is in contact from there on
ROWS = 24  # of contact, and of none, at which gaps are evaluated in a search
NEAR = 0.003  # m: scale of a gap in contact, of the search too
OUTLIERS = 0.1
SPAN = 0.1  # m, over which a gap may lie that is of no contact with the part
FULL = math.log(OUTLIERS + (1.0 - OUTLIERS) * SPAN / (2.0 * NEAR))
FARTHEST = 0.05  # m: a larger gap says no more
DIRECTED = 2.0  # nats of a contact whose force is along the part's normal
REACH = np.array(
    [0.012] * 3 + [0.1, 0.1, 0.3]
)  # m and rad from where images show the part to where it is felt
DEEP = -0.002  # m: a free peg is in the part


@dataclass(frozen=True, eq=False)
class Felt:
    """One probe, all its windows together.

    Attributes:
        probe: its action.
        times: (T,) s.
        wrench: (T, 6) tared, in the peg's frame.
        pose: (T, 7) world_from_peg.
        zero: (6,) that it is tared by.
        noise: (6,) standard deviations of the rows of which the zero is the mean.
    """

    probe: Probe
    times: Array
    wrench: Array
    pose: Array
    zero: Array
    noise: Array

    def scaled(self, force: float, torque: float) -> Felt:
        """The same in other units."""
        factors = np.repeat([force, torque], 3)
        return replace(self, **{name: factors * getattr(self, name) for name in ("wrench", "zero", "noise")})

    @property
    def size(self) -> Array:
        """Forces (T,), N."""
        return np.asarray(np.linalg.norm(self.wrench[:, :3], axis=1))

    @property
    def contact(self) -> Mask:
        """Whether (T,) the peg is in contact, by its force."""
        size = self.size
        return np.asarray(size > max(LEAST, SHARE * float(np.quantile(size, 0.98))))

    @property
    def force(self) -> Array:
        """Forces (T, 3) in the world's axes, N."""
        turn = poses.rotation_matrix(torch.from_numpy(self.pose)).numpy()
        return np.asarray(np.einsum("tij,tj->ti", turn, self.wrench[:, :3]))


def felt_by(windows: Sequence[Measurement]) -> list[Felt]:
    """The probes of some windows, in order; those with hardly any rows are left out."""
    by_name: dict[str, list[Measurement]] = {}
    for each in windows:
        if isinstance(each.action, ProbeWindow):
            by_name.setdefault(each.action.probe.name, []).append(each)
    probes = []
    for several in by_name.values():
        times, wrench, pose = (
            np.concatenate([np.asarray(getattr(m.observation, column), dtype=float) for m in several])
            for column in ("times", "wrench", "world_from_peg")
        )
        if len(times) > 2 * ZERO:
            first = wrench[:ZERO]
            zero, noise = first.mean(axis=0), first.std(axis=0)
            probes.append(Felt(several[0].action.probe, times, wrench - zero, pose, zero, noise))
    return probes


def evenly(where: Mask, most: int) -> Indices:
    """At most so many of the indices at which a condition holds, evenly chosen."""
    indices = np.flatnonzero(where)
    return indices[np.unique(np.linspace(0, len(indices) - 1, min(most, len(indices))).astype(int))]


@dataclass(frozen=True)
class Met:
    """How well contacts agree with the part at a pose.

    Attributes:
        found: the pose.
        share: of the largest score: 1 where each contact is at the surface and no free peg in the part.
        gap: (T,) of all stamps of all probes there, m.
        normal: (T, 3) of the part, in the world's axes.
        place: (T, 3) of the part that is closest to the peg, in the peg's frame, m.
    """

    found: Found
    share: float
    gap: Array
    normal: Array
    place: Array


class Contacts:
    """Scores the part's pose by the gaps of a peg, where contact is felt and where none is."""

    def __init__(self, part: Part, peg: Part, guess: Guess) -> None:
        self.guess = guess
        self._gap = PegGap(part, peg)

    def score(self, probes: Sequence[Felt], pose: Array, directed: bool = True) -> Array:
        """Scores (N,) at poses (N, 7) of the part, nats: of gaps, if `directed` of forces' directions too."""
        total, turn = np.zeros(len(pose)), poses.rotation_matrix(torch.from_numpy(pose)).numpy()
        for felt in probes:
            touching, free = evenly(felt.contact, ROWS), evenly(felt.size < 0.5 * LEAST, ROWS)
            rows = np.concatenate([touching, free])
            found = self._gap(torch.from_numpy(pose), torch.from_numpy(felt.pose[rows]))
            gap, count = found.distance.numpy(), len(touching)
            near = np.exp(-np.abs(gap[:, :count]) / NEAR)
            total += np.log(OUTLIERS + (1.0 - OUTLIERS) * SPAN / (2.0 * NEAR) * near).sum(axis=1)
            total -= np.minimum(np.maximum(DEEP - gap[:, count:], 0.0) / NEAR, FULL).sum(axis=1)
            if directed:
                force = felt.force[touching] / felt.size[touching, None]
                normal = found.normal[:, :count].numpy() @ turn.transpose(0, 2, 1)
                total += DIRECTED * (near * (normal * force).sum(axis=2)).sum(axis=1)
        return total

    def most(self, probes: Sequence[Felt]) -> float:
        """The largest score, nats."""
        return FULL * sum(len(evenly(felt.contact, ROWS)) for felt in probes)

    def distance(self, probes: Sequence[Felt], start: Found | None, along: float) -> float:
        """The mean distance of contacts from the part, m, with the peg farther along its axis.

        The part is where the search begins, and a contact far away counts no more than one at `FARTHEST`.
        """
        part = torch.from_numpy(start.pose if start is not None else np.asarray(self.guess.world_from_part))
        off = []
        for felt in probes:
            rows = evenly(felt.contact, ROWS)
            moved = along_axis(felt, along).pose[rows]
            off.append(self._gap(part[None], torch.from_numpy(moved)).distance[0].abs().numpy())
        return float(np.minimum(np.concatenate(off), FARTHEST).mean())

    def fit(self, probes: Sequence[Felt], start: Found | None = None) -> Met:
        """The pose that contacts fit best, from a place or from all over the prior."""
        wide = start is None
        found = best_pose(
            lambda pose: self.score(probes, pose),
            self.guess,
            start,
            rounds=6 if wide else 4,
            draws=96 if wide else 32,
            reach=REACH,
        )
        pose = torch.from_numpy(np.concatenate([felt.pose for felt in probes]))
        gap = self._gap(torch.from_numpy(found.pose)[None], pose)
        part = torch.from_numpy(found.pose)
        turn = poses.rotation_matrix(part).numpy()
        place = poses.transform(poses.compose(poses.inverse(pose), part), gap.witness[0][:, None])[:, 0]
        score = float(self.score(probes, found.pose[None], directed=False)[0])
        share = score / max(self.most(probes), 1e-9)
        return Met(found, share, gap.distance[0].numpy(), gap.normal[0].numpy() @ turn.T, place.numpy())


def along_axis(felt: Felt, metres: float) -> Felt:
    """The probe with its peg farther along the peg's own z axis."""
    turn = poses.rotation_matrix(torch.from_numpy(felt.pose)).numpy()
    moved = np.hstack([felt.pose[:, :3] + metres * turn[:, :, 2], felt.pose[:, 3:]])
    return replace(felt, pose=moved)

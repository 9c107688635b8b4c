"""What wrenches say of where a peg is touched: weighted nodes on its surface, and candidates made of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bcppl.arguments import number_within, whole_number
from bcppl.errors import InputError

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

FACE, EDGE, CORNER = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Nodes:
    """Places on a peg's surface where a contact may be, Q in all, for several wrenches.

    Attributes:
        row: (Q,) which wrench.
        kind: (Q,) `FACE`, `EDGE` or `CORNER`.
        group: (Q,) which smooth surface, smooth curve or corner it lies on, numbered within its kind.
        point: (Q, 3) in the peg's frame.
        normal: (Q, 3) outward, of the friction cone in which the force stands best.
        along: (Q,) how far along the wrench's force it lies, metres.
        gap: (Q,) how much farther along the next node of the same stretch of surface may lie, metres.
        score: (Q,) log-likelihood of a contact there.
        log_weight: (Q,) that, with the prior probability of what the node stands for.
    """

    row: Indices
    kind: Indices
    group: Indices
    point: Array
    normal: Array
    along: Array
    gap: Array
    score: Array
    log_weight: Array

    def __len__(self) -> int:
        return len(self.row)

    def __getitem__(self, chosen: npt.NDArray[np.bool_] | Indices) -> Nodes:
        """Some of them."""
        return Nodes(**{name: values[chosen] for name, values in self.__dict__.items()})

    @staticmethod
    def joined(parts: list[Nodes]) -> Nodes:
        """Several as one."""
        return Nodes(
            **{name: np.concatenate([getattr(p, name) for p in parts]) for name in parts[0].__dict__}
        )


@dataclass(frozen=True, eq=False)
class Candidates:
    """Stretches of surface where each of M wrenches may come from, at most K, the likeliest first.

    Attributes:
        location: (M, K, 3) posterior mean on that stretch, in the peg's frame, metres; NaN where there are
            fewer.
        covariance: (M, K, 3, 3) of the location within that stretch, m^2: of rank 2 on a plane face, 1 on a
            straight edge, 0 at a corner.
        normal: (M, K, 3) outward normal there.
        probability: (M, K) that the contact is on that stretch; 0 where there are fewer.
        kind: (M, K) `FACE`, `EDGE` or `CORNER`; -1 where there are fewer.
        group: (M, K) which smooth surface, curve or corner, numbered within its kind; -1 where fewer.
    """

    location: Array
    covariance: Array
    normal: Array
    probability: Array
    kind: Indices
    group: Indices

    @property
    def count(self) -> Indices:
        """(M,) how many there are of each wrench."""
        return np.asarray((self.probability > 0).sum(axis=1), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class SurfacePosterior:
    """Where a peg is touched, given each of M wrenches that one contact made.

    Attributes:
        nodes: places on the surface, sorted by wrench.
        mass: (Q,) posterior probability of each; those of one wrench sum to 1.
        log_evidence: (M,) log-density of the wrench if one contact made it, up to a constant that is the same
            for all wrenches of one peg and noise; -inf where no node explains it.
    """

    nodes: Nodes
    mass: Array
    log_evidence: Array

    @staticmethod
    def of(nodes: Nodes, wrenches: int) -> SurfacePosterior:
        """The posterior of M wrenches on unsorted nodes; those that hold next to no mass are left out."""
        highest = np.full(wrenches, -np.inf)
        np.maximum.at(highest, nodes.row, nodes.log_weight)
        nodes = nodes[np.isfinite(nodes.log_weight) & (nodes.log_weight > highest[nodes.row] - 16.0)]
        nodes = nodes[np.lexsort((nodes.along, nodes.group, nodes.kind, nodes.row))]
        mass = np.exp(nodes.log_weight - highest[nodes.row])
        total = np.bincount(nodes.row, mass, wrenches)
        with np.errstate(divide="ignore"):
            evidence = np.where(total > 0, highest + np.log(total), -np.inf)
        return SurfacePosterior(nodes, mass / total[nodes.row], evidence)

    def __len__(self) -> int:
        return len(self.log_evidence)

    def mass_above(self, score: Array) -> Array:
        """The mass (M,) on places that are likelier than a log-likelihood (M,): a credible level.

        The region of level L holds the places at which this is below L, and has probability L or, for
        there are only so many nodes, little more.
        """
        above = self.nodes.score > score[self.nodes.row]
        mass = np.bincount(self.nodes.row[above], self.mass[above], len(self))
        return np.asarray(mass, dtype=np.float64)

    def region(self, level: float) -> npt.NDArray[np.bool_]:
        """Which nodes (Q,) are in the credible region: the likeliest places that hold this much mass.

        Raises:
            InputError: the level is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise InputError(f"a credible region of level {level!r} is asked for; give one between 0 and 1.")
        order = np.lexsort((-self.nodes.score, self.nodes.row))
        running = np.cumsum(self.mass[order])
        before = running - self.mass[order]
        first = np.searchsorted(self.nodes.row[order], np.arange(len(self)))
        begun = np.append(before, 0.0)[first][self.nodes.row[order]]
        inside = np.empty(len(order), dtype=bool)
        inside[order] = before - begun < level
        return inside

    def candidates(self, most: int = 8, least: float = 0.005) -> Candidates:
        """The stretches of surface that hold the mass.

        A stretch is what is smooth (a plane, a cylinder, an edge, a rim) and near: where a line enters one
        surface twice, these are two.

        Args:
            most: K, how many are kept.
            least: probability below which a stretch is left out.

        Raises:
            InputError: `most` is no whole number above 0, or `least` no probability below 1.
        """
        most = whole_number("candidates are asked for with most = {}", most)
        least = number_within("candidates are asked for with least = {}", least, least=0.0, below=1.0)
        nodes, mass, rows = self.nodes, self.mass, len(self)
        empty = Candidates(
            np.full((rows, most, 3), np.nan),
            np.full((rows, most, 3, 3), np.nan),
            np.full((rows, most, 3), np.nan),
            np.zeros((rows, most)),
            np.full((rows, most), -1, dtype=np.int64),
            np.full((rows, most), -1, dtype=np.int64),
        )
        if len(nodes) == 0:
            return empty
        new = np.ones(len(nodes), dtype=bool)
        same = (np.diff(nodes.row) == 0) & (np.diff(nodes.kind) == 0) & (np.diff(nodes.group) == 0)
        new[1:] = ~same | (np.diff(nodes.along) > nodes.gap[1:])
        stretch = np.cumsum(new) - 1
        first = np.flatnonzero(new)
        probability = np.bincount(stretch, mass)

        def mean(values: Array) -> Array:
            flat = values.reshape(len(mass), -1)
            total = np.stack([np.bincount(stretch, mass * column) for column in flat.T], axis=1)
            return (total / probability[:, None]).reshape(-1, *values.shape[1:])

        middle = mean(nodes.point)
        apart = nodes.point - middle[stretch]
        covariance = mean(apart[:, :, None] * apart[:, None, :])
        # On a curved surface the mean lies beneath it: it goes to the plane of the node nearest to it.
        order = np.lexsort((np.square(apart).sum(axis=1), stretch))
        near = order[np.searchsorted(stretch[order], np.arange(len(first)))]
        on_face = (nodes.kind[first] == FACE)[:, None]
        off = np.sum((nodes.point[near] - middle) * nodes.normal[near], axis=1, keepdims=True)
        location = middle + np.where(on_face, off * nodes.normal[near], 0.0)
        row = nodes.row[first]
        order = np.lexsort((-probability, row))
        rank = np.empty(len(first), dtype=np.int64)
        rank[order] = np.arange(len(first)) - np.searchsorted(row[order], row[order])
        kept = (probability >= least) & (rank < most)
        at = row[kept], rank[kept]
        empty.location[at], empty.covariance[at] = location[kept], covariance[kept]
        empty.normal[at], empty.probability[at] = nodes.normal[near][kept], probability[kept]
        empty.kind[at], empty.group[at] = nodes.kind[first][kept], nodes.group[first][kept]
        return empty

"""Posteriors of contact locations: weighted nodes on a peg's surface, and candidates clustered from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bcppl.arguments import number_within, whole_number
from bcppl.arrays import Array, ArrayRecord, Indices, Mask

FACE, EDGE, CORNER = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Nodes(ArrayRecord):
    """Quadrature nodes on a peg's surface, Q in all, for several wrenches.

    Attributes:
        row: (Q,) index of the wrench.
        kind: (Q,) `FACE`, `EDGE` or `CORNER`.
        group: (Q,) index of its smooth surface, smooth curve or corner, within its kind.
        point: (Q, 3) in the peg's frame.
        normal: (Q, 3) outward, of the friction cone in which the force is most central.
        along: (Q,) its coordinate along the wrench's force, metres.
        gap: (Q,) bound of the distance along the force to the next node of the same cluster, metres.
        score: (Q,) log-likelihood of a contact there.
        log_weight: (Q,) the same, plus the log prior probability that the node represents.
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


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate contact locations of M wrenches, at most K each, the most probable first.

    Attributes:
        location: (M, K, 3) posterior mean in the cluster, in the peg's frame, metres; NaN where there are
            fewer.
        covariance: (M, K, 3, 3) of the location in the cluster, m^2: of rank 2 on a plane face, 1 on a
            straight edge, 0 at a corner.
        normal: (M, K, 3) outward normal there.
        probability: (M, K) that the contact is in the cluster; 0 where there are fewer.
        kind: (M, K) `FACE`, `EDGE` or `CORNER`; -1 where there are fewer.
        group: (M, K) index of the smooth surface, curve or corner within its kind; -1 where there are fewer.
    """

    location: Array
    covariance: Array
    normal: Array
    probability: Array
    kind: Indices
    group: Indices

    @property
    def count(self) -> Indices:
        """(M,) the number of candidates."""
        return np.asarray((self.probability > 0).sum(axis=1), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class SurfacePosterior:
    """Posteriors of the contact location on a peg, given each of M wrenches of a single contact.

    Attributes:
        nodes: on the surface, sorted by wrench.
        mass: (Q,) posterior probability of each; those of one wrench sum to 1.
        log_evidence: (M,) log-density of the wrench given a single contact, up to a constant that all
            wrenches of one peg and noise share; -inf where no node explains it.
    """

    nodes: Nodes
    mass: Array
    log_evidence: Array

    @staticmethod
    def of(nodes: Nodes, wrenches: int) -> SurfacePosterior:
        """The posteriors of M wrenches on unsorted nodes; those of negligible mass are left out."""
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
        """The mass (M,) of nodes with more than a log-likelihood (M,): a credible level.

        The region of level L holds the points at which this is below L; its probability is L or, because the
        nodes are discrete, little more.
        """
        above = self.nodes.score > score[self.nodes.row]
        mass = np.bincount(self.nodes.row[above], self.mass[above], len(self))
        return np.asarray(mass, dtype=np.float64)

    def region(self, level: float) -> Mask:
        """Mask (Q,) of the nodes in the credible region: those of the highest likelihood with this mass.

        Raises:
            InputError: the level is not between 0 and 1.
        """
        number_within("a credible region has level {}", level, above=0.0, below=1.0)
        order = np.lexsort((-self.nodes.score, self.nodes.row))
        running = np.cumsum(self.mass[order])
        before = running - self.mass[order]
        first = np.searchsorted(self.nodes.row[order], np.arange(len(self)))
        begun = np.append(before, 0.0)[first][self.nodes.row[order]]
        inside = np.empty(len(order), dtype=bool)
        inside[order] = before - begun < level
        return inside

    def candidates(self, most: int = 8, least: float = 0.005) -> Candidates:
        """Clusters of the nodes.

        A cluster is smooth (of one plane, cylinder, edge or rim) and connected: where a line enters one
        surface twice, there are two.

        Args:
            most: K.
            least: probability below which a cluster is left out.

        Raises:
            InputError: `most` is no whole number above 0, or `least` no probability below 1.
        """
        most = whole_number("candidates are given most = {}", most)
        least = number_within("candidates are given least = {}", least, least=0.0, below=1.0)
        nodes, mass, rows = self.nodes, self.mass, len(self)
        shape = (rows, most)
        candidates = Candidates(
            np.full((*shape, 3), np.nan),
            np.full((*shape, 3, 3), np.nan),
            np.full((*shape, 3), np.nan),
            np.zeros(shape),
            np.full(shape, -1, dtype=np.int64),
            np.full(shape, -1, dtype=np.int64),
        )
        if len(nodes) == 0:
            return candidates
        new = np.ones(len(nodes), dtype=bool)
        same = (np.diff(nodes.row) == 0) & (np.diff(nodes.kind) == 0) & (np.diff(nodes.group) == 0)
        new[1:] = ~same | (np.diff(nodes.along) > nodes.gap[1:])
        cluster = np.cumsum(new) - 1
        first = np.flatnonzero(new)
        probability = np.bincount(cluster, mass)

        def mean(values: Array) -> Array:
            flat = values.reshape(len(mass), -1)
            total = np.stack([np.bincount(cluster, mass * column) for column in flat.T], axis=1)
            return (total / probability[:, None]).reshape(-1, *values.shape[1:])

        middle = mean(nodes.point)
        apart = nodes.point - middle[cluster]
        covariance = mean(apart[:, :, None] * apart[:, None, :])
        # On a curved surface the mean lies beneath it: it is projected onto the plane of the nearest node.
        order = np.lexsort((np.square(apart).sum(axis=1), cluster))
        near = order[np.searchsorted(cluster[order], np.arange(len(first)))]
        on_face = (nodes.kind[first] == FACE)[:, None]
        off = np.sum((nodes.point[near] - middle) * nodes.normal[near], axis=1, keepdims=True)
        location = middle + np.where(on_face, off * nodes.normal[near], 0.0)
        row = nodes.row[first]
        order = np.lexsort((-probability, row))
        rank = np.empty(len(first), dtype=np.int64)
        rank[order] = np.arange(len(first)) - np.searchsorted(row[order], row[order])
        kept = (probability >= least) & (rank < most)
        at = row[kept], rank[kept]
        candidates.location[at], candidates.covariance[at] = location[kept], covariance[kept]
        candidates.normal[at], candidates.probability[at] = nodes.normal[near][kept], probability[kept]
        candidates.kind[at], candidates.group[at] = nodes.kind[first][kept], nodes.group[first][kept]
        return candidates

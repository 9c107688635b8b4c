"""Intrinsic contact sensing: the posterior of a contact's location on a peg, given its wrench.

A single contact at r that only pushes exerts a wrench (f, tau) with r x f = tau: r lies on the wrench's line
of action, where that enters the peg with f inside the friction cone (Bicchi, Salisbury and Brock 1993,
"Contact sensing from force measurements", IJRR 12(3), section 3). With noise of covariance S on the wrench
and a flat prior of the force, which is integrated out, the likelihood of r is

    p(wrench | r) ~ |V(r)|^(-1/2) exp(-e' V(r)^-1 e / 2),
    e = tau - r x f,   V(r) = [-[r]x, I] S [-[r]x, I]',

times the probability that the force lies in a friction cone at r. The posterior over the surface is computed
on nodes: where a bundle of lines parallel to the measured one enters the peg, and on sharp edges and corners
near it. Only the friction cone's margin is linearised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from bcppl.arguments import number_within
from bcppl.arrays import Array, Indices
from bcppl.cached import cached_property
from bcppl.contact.sensing.load import refuse_millimetres
from bcppl.contact.sensing.noise import WrenchNoise, covariance_of
from bcppl.contact.sensing.surface import PegSurface
from bcppl.contact.sensing.surface_posterior import CORNER, EDGE, FACE, Candidates, Nodes, SurfacePosterior
from bcppl.geometry.parts import Part

WIDTH = 3.2  # half width of the bundle, in standard deviations (of their bound along the line)
ACROSS = 19  # lines across the bundle
ALONG = 21  # nodes on a segment of an edge
_BATCH = 400  # wrenches whose bundles are cast at once
_FLATTEST = 0.05  # lower bound of the cosine between force and normal
_WEAKEST = 5.0  # lower bound of a force, in standard deviations: a weaker one has no direction
_UNLIKELY = -18.0  # lower bound of the likelihood's exponent: six standard deviations


@dataclass(frozen=True, eq=False)
class IntrinsicSensing:
    """Posteriors of contact locations on a peg from wrenches.

    A priori a contact is on a face, a sharp edge or a corner with the probabilities `shares`, uniformly on
    each, and its force anywhere in the friction cone. The cones of an edge or a corner are those of all
    normals between its faces'.

    Attributes:
        peg: the held peg; wrenches and locations are in its frame.
        friction: upper bound of the friction coefficient.
        shares: prior probabilities of faces, sharp edges and corners.

    Raises:
        InputError: the peg's mesh is empty, open, not finite or in millimetres, or friction is out of range.
    """

    peg: Part
    friction: float = 1.0
    shares: tuple[float, float, float] = (0.6, 0.3, 0.1)

    def __post_init__(self) -> None:
        number_within("a contact's friction is {}", self.friction, above=0.0, most=10.0)
        _ = self.surface

    @cached_property
    def surface(self) -> PegSurface:
        """The peg's surface."""
        return PegSurface(self.peg)

    def candidates(
        self, wrench: Array, covariance: Array | WrenchNoise, most: int = 8, least: float = 0.005
    ) -> Candidates:
        """Candidate contact locations; see `posterior` and `SurfacePosterior.candidates`."""
        return self.posterior(wrench, covariance).candidates(most, least)

    def posterior(self, wrench: Array, covariance: Array | WrenchNoise) -> SurfacePosterior:
        """Posteriors of the contact location, one for each wrench.

        Args:
            wrench: (M, 6) force (N) and torque (N m) on the peg, in its frame about its origin: tared,
                gravity compensated, averaged or filtered.
            covariance: (6, 6), or (M, 6, 6), of their noise: `WrenchNoise.covariance`. A `WrenchNoise` itself
                is for wrenches that are single samples, neither averaged nor filtered.

        Returns:
            The posteriors. There are no nodes for a wrench that is not finite, or whose force is below five
            standard deviations; nor for one that no single contact explains within six: a line of action that
            misses the peg, a force outside of every friction cone (is `friction` large enough?), a torque
            about the line that only several contacts can exert.

        Raises:
            InputError: torques are in N mm.
            numpy.linalg.LinAlgError: a covariance is not positive definite.
        """
        wrench = np.asarray(wrench, dtype=np.float64)
        covariance = covariance_of(covariance)
        rows = np.flatnonzero(np.isfinite(wrench).all(axis=1))
        noise = np.linalg.eigvalsh(_of_rows(covariance, rows)[..., :3, :3])[..., -1]
        clear = np.linalg.norm(wrench[rows, :3], axis=1) > _WEAKEST * np.sqrt(noise)
        rows = rows[clear]
        refuse_millimetres(wrench[rows], self.surface.radius + float(np.linalg.norm(self.surface.center)))
        nodes = [_NO_NODES]
        for first in range(0, len(rows), _BATCH):
            chosen = rows[first : first + _BATCH]
            bundle = _Bundle.around(wrench[chosen], _of_rows(covariance, chosen), self.surface)
            for places in (self._on_faces(bundle), self._on_edges(bundle), self._on_corners(bundle)):
                nodes.append(self._scored(places, chosen, wrench, covariance))
        return SurfacePosterior.of(Nodes.joined(nodes), len(wrench))

    def credible_level(
        self,
        posterior: SurfacePosterior,
        wrench: Array,
        covariance: Array | WrenchNoise,
        point: Array,
        normals: Array,
    ) -> Array:
        """The level (M,) of the smallest credible region that holds a point (M, 3) on the surface.

        Args:
            posterior: of these wrenches.
            wrench: (M, 6).
            covariance: (6, 6) or (M, 6, 6), or a `WrenchNoise`.
            point: (M, 3) in the peg's frame.
            normals: (M, K, 3) outward, of the face there, or of all faces that meet there and between.
        """
        covariance = covariance_of(covariance)
        score, *_ = self._log_likelihood(wrench, covariance, point, normals)
        level = posterior.mass_above(score)
        return np.where(np.isfinite(posterior.log_evidence), level, 1.0)

    def _on_faces(self, bundle: _Bundle) -> _Places:
        """Points where each bundle of lines enters the peg, and the share of its area of each line."""
        grid, step = _disc(ACROSS)
        offset = np.einsum("mxi,mij,gj->mgx", bundle.side, bundle.root, grid)
        lines = (bundle.point[:, None] + offset).reshape(-1, 3)
        crossing = self.surface.entries(lines, np.repeat(bundle.direction, len(grid), axis=0))
        row, normal = crossing.line // len(grid), self.surface.normals[crossing.face]
        cosine = -np.sum(bundle.direction[row] * normal, axis=1)
        kept = cosine > _FLATTEST
        row, normal, cosine = row[kept], normal[kept], cosine[kept]
        cell = step**2 * np.abs(np.linalg.det(bundle.root))
        # Bound of the difference in depth of neighbouring lines on a surface with the force in its cone.
        gap = 2.0 * step * np.linalg.norm(bundle.root, axis=(1, 2)) * max(self.friction, 0.3) + 1e-6
        group = self.surface.patch[crossing.face[kept]]
        size = cell[row] / cosine / self.surface.area
        return _Places(FACE, row, group, crossing.point[kept], normal[:, None], size, gap[row])

    def _on_edges(self, bundle: _Bundle) -> _Places:
        """Points on the segments of sharp edges near each line, and their shares of the total length."""
        edges = self.surface.edges
        begin = bundle.whitened(edges.start)
        extent = bundle.whitened(edges.start + edges.extent) - begin
        length = np.maximum(np.sum(extent * extent, axis=-1), 1e-30)
        nearest = -np.sum(begin * extent, axis=-1) / length
        reach = WIDTH / np.sqrt(length)
        low, high = np.clip(nearest - reach, 0.0, 1.0), np.clip(nearest + reach, 0.0, 1.0)
        away = np.linalg.norm(begin + np.clip(nearest, 0.0, 1.0)[..., None] * extent, axis=-1)
        row, edge = np.nonzero((away < WIDTH) & (high > low))
        segment = (high - low)[row, edge]
        share = low[row, edge][:, None] + segment[:, None] * (np.arange(ALONG) + 0.5) / ALONG
        point = edges.start[edge][:, None] + share[..., None] * edges.extent[edge][:, None]
        metres = segment * np.linalg.norm(edges.extent[edge], axis=1) / ALONG
        many = np.repeat(np.arange(len(row)), ALONG)
        size = metres[many] / max(self.surface.length, 1e-30)
        far = np.full(len(many), np.inf)
        chain, normals = edges.chain[edge][many], edges.normals[edge][many]
        return _Places(EDGE, row[many], chain, point.reshape(-1, 3), normals, size, far)

    def _on_corners(self, bundle: _Bundle) -> _Places:
        """The corners near each line."""
        point, normals = self.surface.corners
        away = np.linalg.norm(bundle.whitened(point), axis=-1)
        row, corner = np.nonzero(away < WIDTH)
        size = np.full(len(row), 1.0 / max(len(point), 1))
        return _Places(CORNER, row, corner, point[corner], normals[corner], size, np.full(len(row), np.inf))

    def _scored(self, places: _Places, chosen: Indices, wrench: Array, covariance: Array) -> Nodes:
        row = chosen[places.row]
        share = self.shares[places.kind] / sum(self.shares)
        given = wrench[row], _of_rows(covariance, row)
        score, fit, normal = self._log_likelihood(*given, places.point, places.normals)
        with np.errstate(divide="ignore"):
            log_weight = np.where(fit > _UNLIKELY, score + np.log(places.size * share), -np.inf)
        force = wrench[row, :3]
        along = np.sum(places.point * force, axis=1) / np.linalg.norm(force, axis=1)
        kind = np.full(len(row), places.kind)
        return Nodes(row, kind, places.group, places.point, normal, along, places.gap, score, log_weight)

    def _log_likelihood(
        self, wrench: Array, covariance: Array, point: Array, normals: Array
    ) -> tuple[Array, Array, Array]:
        """Log p (Q,) of wrenches (Q, 6) given contacts at points (Q, 3), its exponent, the normals.

        The covariance is (6, 6) or (Q, 6, 6); the normals (Q, K, 3) are all that a contact there may have.
        """
        force = wrench[:, :3]
        error = wrench[:, 3:] - np.cross(point, force)
        residual = _of_residual(point, covariance)
        fit = -0.5 * np.sum(error * np.linalg.solve(residual, error[..., None])[..., 0], axis=1)
        components = -np.einsum("qx,qkx->qk", force, normals)
        best = components.argmax(axis=1) if len(force) else np.empty(0, dtype=np.int64)
        normal = normals[np.arange(len(best)), best]
        pressing = components[np.arange(len(best)), best]
        tangential = force + pressing[:, None] * normal
        size = np.linalg.norm(tangential, axis=1)
        gradient = self.friction * normal + tangential / np.maximum(size, 1e-12)[:, None]
        variance = np.sum((gradient[:, None] @ covariance[..., :3, :3])[:, 0] * gradient, axis=1)
        fit = fit + log_ndtr((self.friction * pressing - size) / np.sqrt(variance))
        return fit - 0.5 * np.linalg.slogdet(residual)[1], fit, normal


@dataclass(frozen=True, eq=False)
class _Places:
    """Points of one kind, Q in all; `size` is each one's share of that kind's surface."""

    kind: int
    row: Indices
    group: Indices
    point: Array
    normals: Array
    size: Array
    gap: Array


@dataclass(frozen=True, eq=False)
class _Bundle:
    """The lines of action of M wrenches: unit directions, and the points nearest to the peg's middle.

    `side` (M, 3, 2) are unit vectors across them, `root` (M, 2, 2) a square root (m) of a bound of the
    covariance across.
    """

    direction: Array
    point: Array
    side: Array
    root: Array

    def whitened(self, place: Array) -> Array:
        """Offsets (M, E, 2) of points (E, 3) from each line, in standard deviations."""
        whiten = np.linalg.inv(self.root) @ np.swapaxes(self.side, 1, 2)
        return np.asarray(whiten @ place.T - whiten @ self.point[..., None]).swapaxes(1, 2)

    @staticmethod
    def around(wrench: Array, covariance: Array, surface: PegSurface) -> _Bundle:
        """The bundles of wrenches (M, 6)."""
        force, torque = wrench[:, :3], wrench[:, 3:]
        size = np.linalg.norm(force, axis=1, keepdims=True)
        direction = force / size
        point = np.cross(direction, torque / size)
        point = point + np.sum((surface.center - point) * direction, axis=1, keepdims=True) * direction
        side = np.linalg.svd(direction[:, None, :])[2][:, 1:].swapaxes(1, 2)
        # An error e of the torque about a point moves the line by f x e / |f|^2 there.
        moved = np.swapaxes(side, 1, 2) @ _cross_matrix(direction) / size[..., None]

        def bounded(first: Array, last: Array) -> Array:
            # The covariance is convex along the line, so the sum of those at both ends bounds it.
            bound = np.zeros((len(wrench), 2, 2))
            for along in (first, last):
                there = _of_residual(point + along[:, None] * direction, covariance)
                bound += moved @ there @ np.swapaxes(moved, 1, 2)
            return np.asarray(np.linalg.cholesky(bound), dtype=np.float64)

        radius = np.full(len(wrench), surface.radius)
        root = bounded(-radius, radius)
        # The range of the entries of a few lines gives a closer bound.
        grid, _ = _disc(7)
        lines = (point[:, None] + np.einsum("mxi,mij,gj->mgx", side, root, grid)).reshape(-1, 3)
        crossing = surface.entries(lines, np.repeat(direction, len(grid), axis=0))
        row = crossing.line // len(grid)
        along = np.sum((crossing.point - point[row]) * direction[row], axis=1)
        first, last = np.full(len(wrench), np.inf), np.full(len(wrench), -np.inf)
        np.minimum.at(first, row, along)
        np.maximum.at(last, row, along)
        met = first <= last
        return _Bundle(
            direction, point, side, bounded(np.where(met, first, -radius), np.where(met, last, radius))
        )


def _disc(across: int) -> tuple[Array, float]:
    """Points (G, 2) of a square grid within `WIDTH`, `across` from side to side, and their spacing."""
    step = 2.0 * WIDTH / across
    axis = step * (np.arange(across) - 0.5 * (across - 1))
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return grid[np.linalg.norm(grid, axis=1) <= WIDTH], step


def _cross_matrix(vector: Array) -> Array:
    """[v]x (Q, 3, 3) of vectors (Q, 3)."""
    matrix = np.zeros((len(vector), 3, 3))
    matrix[:, [2, 0, 1], [1, 2, 0]] = vector
    matrix[:, [1, 2, 0], [2, 0, 1]] = -vector
    return matrix


def _of_residual(point: Array, covariance: Array) -> Array:
    """The covariance (Q, 3, 3) of tau - r x f at points r (Q, 3), for one (6, 6) or each (Q, 6, 6)."""
    lever = _cross_matrix(point)
    force, mixed, torque = covariance[..., :3, :3], covariance[..., :3, 3:], covariance[..., 3:, 3:]
    moved = lever @ mixed
    # The transpose of a cross matrix is its negative.
    return np.asarray(torque - moved - np.swapaxes(moved, 1, 2) - lever @ force @ lever)


def _of_rows(covariance: Array, rows: Indices) -> Array:
    return covariance if covariance.ndim == 2 else covariance[rows]


_NO_NODES = Nodes(*np.empty((3, 0), dtype=np.int64), *np.empty((2, 0, 3)), *np.empty((4, 0)))

"""Intrinsic contact sensing: where on a peg a measured wrench says that it is touched, and how surely.

A single contact at r that only pushes exerts a wrench (f, tau) with r x f = tau: r lies on the wrench's line
of action, where that enters the peg with f inside the friction cone (Bicchi, Salisbury and Brock 1993,
"Contact sensing from force measurements", IJRR 12(3), section 3). With noise of covariance S on the wrench,
and nothing known of the force, the likelihood of r is, the force integrated out,

    p(wrench | r) ~ |V(r)|^(-1/2) exp(-e' V(r)^-1 e / 2),
    e = tau - r x f,   V(r) = [-[r]x, I] S [-[r]x, I]',

times the probability that the force lies in a friction cone at r. The posterior over the surface is computed
on nodes: everywhere that a bundle of lines parallel to the measured one enters the peg, and on sharp edges
and corners near it. Nothing is linearised but the friction cone's margin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.special import log_ndtr

from bcppl.contact.sensing.candidates import CORNER, EDGE, FACE, Candidates, Nodes, SurfacePosterior
from bcppl.contact.sensing.noise import WrenchNoise, checked_covariance
from bcppl.contact.sensing.surface import PegSurface
from bcppl.contact.sensing.units import refuse_millimetres
from bcppl.errors import InputError
from bcppl.geometry.parts import Part

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

WIDTH = 3.2  # how many deviations the bundle reaches to each side, of a bound of them along the line
ACROSS = 19  # lines across the bundle
ALONG = 21  # nodes on the stretch of an edge
_BATCH = 400  # wrenches whose bundles are cast at once
_FLATTEST = 0.05  # cosine between force and normal below which a surface is not pushed
_WEAKEST = 5.0  # deviations of a force below which it has no direction to speak of
_UNLIKELY = -18.0  # exponent of the likelihood below which a wrench is not explained: six deviations


@dataclass(frozen=True, eq=False)
class IntrinsicSensing:
    """Contact locations on a peg from wrenches: all candidates, and their uncertainty.

    Beforehand a contact is on a face, a sharp edge or a corner with the probabilities `shares`, anywhere on
    them evenly, and its force anywhere in the friction cone. An edge's and a corner's cone are those of all
    normals between its faces'.

    Attributes:
        peg: the held peg; wrenches and locations are in its frame.
        friction: the coefficient of the steepest cone that a contact may have.
        shares: of contacts on faces, sharp edges and corners.

    Raises:
        InputError: the peg's mesh is empty, open, not finite or in millimetres, or a setting is out of range.
    """

    peg: Part
    friction: float = 1.0
    shares: tuple[float, float, float] = (0.6, 0.3, 0.1)

    def __post_init__(self) -> None:
        if not 0 < self.friction <= 10:
            raise InputError(f"a contact's friction is {self.friction!r}; give a coefficient from 0 to 10.")
        if len(self.shares) != 3 or not min(self.shares) >= 0 or not 0 < sum(self.shares) < np.inf:
            raise InputError(
                f"contacts are on faces, edges, corners with shares {self.shares!r}; give three, 0 or more."
            )
        _ = self.surface

    @cached_property
    def surface(self) -> PegSurface:
        """The peg's, prepared."""
        return PegSurface(self.peg)

    def candidates(
        self, wrench: Array, covariance: Array | WrenchNoise, most: int = 8, least: float = 0.005
    ) -> Candidates:
        """The candidates of wrenches (M, 6): see `posterior` and `SurfacePosterior.candidates`."""
        return self.posterior(wrench, covariance).candidates(most, least)

    def posterior(self, wrench: Array, covariance: Array | WrenchNoise) -> SurfacePosterior:
        """What wrenches say of where the peg is touched.

        Args:
            wrench: (M, 6) force (N) and torque (N m) on the peg, in its frame about its origin: tared, free
                of the tool's weight, averaged or filtered.
            covariance: (6, 6), or (M, 6, 6), of their noise: `WrenchNoise.covariance`. A `WrenchNoise` itself
                is that of wrenches that are single samples, neither averaged nor filtered.

        Returns:
            The posterior of each wrench. It has no nodes for a wrench that is not finite, or whose force is
            below five deviations; and for one that no single contact explains within six deviations: a line
            of action that passes beside the peg, a force that leaves every friction cone (is `friction` large
            enough?), a torque about the line that only several contacts can make.

        Raises:
            InputError: shapes do not fit, a covariance is not symmetric and positive definite, or torques are
                in N mm.
        """
        wrench = np.asarray(wrench, dtype=np.float64)
        if wrench.ndim != 2 or wrench.shape[1] != 6:
            raise InputError(f"wrenches have shape {wrench.shape}; give (wrenches, 6).")
        covariance = checked_covariance(covariance, len(wrench))
        rows = np.flatnonzero(np.isfinite(wrench).all(axis=1))
        noise = np.linalg.eigvalsh(_of_rows(covariance, rows)[..., :3, :3])[..., -1]
        clear = np.linalg.norm(wrench[rows, :3], axis=1) > _WEAKEST * np.sqrt(noise)
        rows = rows[clear]
        refuse_millimetres(wrench[rows], self.surface.radius + float(np.linalg.norm(self.surface.center)))
        parts = [_NONE]
        for first in range(0, len(rows), _BATCH):
            chosen = rows[first : first + _BATCH]
            bundle = _Bundle.around(wrench[chosen], _of_rows(covariance, chosen), self.surface)
            for found in (self._on_faces(bundle), self._on_edges(bundle), self._on_corners(bundle)):
                parts.append(self._scored(found, chosen, wrench, covariance))
        return SurfacePosterior.of(Nodes.joined(parts), len(wrench))

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
            normals: (M, K, 3) outward, of the face there, or of those that meet there and between.
        """
        covariance = checked_covariance(covariance, len(wrench))
        score, *_ = self._log_likelihood(wrench, covariance, point, normals)
        level = posterior.mass_above(score)
        return np.where(np.isfinite(posterior.log_evidence), level, 1.0)

    def _on_faces(self, bundle: _Bundle) -> _Found:
        """Where each bundle of lines enters the peg, and what share of its area every line stands for."""
        grid, step = _disc(ACROSS)
        offset = np.einsum("mxi,mij,gj->mgx", bundle.side, bundle.root, grid)
        lines = (bundle.point[:, None] + offset).reshape(-1, 3)
        crossing = self.surface.entered(lines, np.repeat(bundle.direction, len(grid), axis=0))
        row, normal = crossing.line // len(grid), self.surface.normals[crossing.face]
        slope = -np.sum(bundle.direction[row] * normal, axis=1)
        kept = slope > _FLATTEST
        row, normal, slope = row[kept], normal[kept], slope[kept]
        cell = step**2 * np.abs(np.linalg.det(bundle.root))
        # Neighbouring lines meet a surface that the force may push at depths that differ by this at most.
        gap = 2.0 * step * np.linalg.norm(bundle.root, axis=(1, 2)) * max(self.friction, 0.3) + 1e-6
        group = self.surface.patch[crossing.face[kept]]
        size = cell[row] / slope / self.surface.area
        return _Found(FACE, row, group, crossing.point[kept], normal[:, None], size, gap[row])

    def _on_edges(self, bundle: _Bundle) -> _Found:
        """Nodes on the stretches of sharp edges that each line passes near, and their share of all length."""
        edges = self.surface.edges
        begin = bundle.whitened(edges.start)
        extent = bundle.whitened(edges.start + edges.extent) - begin
        length = np.maximum(np.sum(extent * extent, axis=-1), 1e-30)
        nearest = -np.sum(begin * extent, axis=-1) / length
        reach = WIDTH / np.sqrt(length)
        low, high = np.clip(nearest - reach, 0.0, 1.0), np.clip(nearest + reach, 0.0, 1.0)
        away = np.linalg.norm(begin + np.clip(nearest, 0.0, 1.0)[..., None] * extent, axis=-1)
        row, edge = np.nonzero((away < WIDTH) & (high > low))
        stretch = (high - low)[row, edge]
        share = low[row, edge][:, None] + stretch[:, None] * (np.arange(ALONG) + 0.5) / ALONG
        point = edges.start[edge][:, None] + share[..., None] * edges.extent[edge][:, None]
        metres = stretch * np.linalg.norm(edges.extent[edge], axis=1) / ALONG
        many = np.repeat(np.arange(len(row)), ALONG)
        size = metres[many] / max(self.surface.length, 1e-30)
        far = np.full(len(many), np.inf)
        return _Found(
            EDGE,
            row[many],
            edges.chain[edge][many],
            point.reshape(-1, 3),
            edges.normals[edge][many],
            size,
            far,
        )

    def _on_corners(self, bundle: _Bundle) -> _Found:
        """The corners that each line passes near."""
        point, normals = self.surface.corners
        away = np.linalg.norm(bundle.whitened(point), axis=-1)
        row, corner = np.nonzero(away < WIDTH)
        size = np.full(len(row), 1.0 / max(len(point), 1))
        return _Found(CORNER, row, corner, point[corner], normals[corner], size, np.full(len(row), np.inf))

    def _scored(self, found: _Found, chosen: Indices, wrench: Array, covariance: Array) -> Nodes:
        row = chosen[found.row]
        share = self.shares[found.kind] / sum(self.shares)
        given = wrench[row], _of_rows(covariance, row)
        score, fit, normal = self._log_likelihood(*given, found.point, found.normals)
        with np.errstate(divide="ignore"):
            log_weight = np.where(fit > _UNLIKELY, score + np.log(found.size * share), -np.inf)
        force = wrench[row, :3]
        along = np.sum(found.point * force, axis=1) / np.linalg.norm(force, axis=1)
        kind = np.full(len(row), found.kind)
        return Nodes(row, kind, found.group, found.point, normal, along, found.gap, score, log_weight)

    def _log_likelihood(
        self, wrench: Array, covariance: Array, point: Array, normals: Array
    ) -> tuple[Array, Array, Array]:
        """Log p (Q,) of wrenches (Q, 6) of contacts at points (Q, 3), its exponent, the normals pushed.

        The covariance is (6, 6) or (Q, 6, 6); the normals (Q, K, 3) are all that a contact may have there.
        """
        force = wrench[:, :3]
        error = wrench[:, 3:] - np.cross(point, force)
        spread = _of_residual(point, covariance)
        fit = -0.5 * np.sum(error * np.linalg.solve(spread, error[..., None])[..., 0], axis=1)
        squarely = -np.einsum("qx,qkx->qk", force, normals)
        best = squarely.argmax(axis=1) if len(force) else np.empty(0, dtype=np.int64)
        normal = normals[np.arange(len(best)), best]
        pressed = squarely[np.arange(len(best)), best]
        sliding = force + pressed[:, None] * normal
        size = np.linalg.norm(sliding, axis=1)
        gradient = self.friction * normal + sliding / np.maximum(size, 1e-12)[:, None]
        variance = np.sum((gradient[:, None] @ covariance[..., :3, :3])[:, 0] * gradient, axis=1)
        fit = fit + log_ndtr((self.friction * pressed - size) / np.sqrt(variance))
        return fit - 0.5 * np.linalg.slogdet(spread)[1], fit, normal


@dataclass(frozen=True, eq=False)
class _Found:
    """Nodes of one kind, Q in all; `size` is the share of that kind's surface that each stands for."""

    kind: int
    row: Indices
    group: Indices
    point: Array
    normals: Array
    size: Array
    gap: Array


@dataclass(frozen=True, eq=False)
class _Bundle:
    """The lines of action of M wrenches and how far off they may be.

    Attributes:
        direction: (M, 3) unit vectors along the forces.
        point: (M, 3) the lines' points nearest to the peg's middle.
        side: (M, 3, 2) unit vectors across.
        root: (M, 2, 2) a root of a bound of the covariance of the line's place across, m.
    """

    direction: Array
    point: Array
    side: Array
    root: Array

    def whitened(self, place: Array) -> Array:
        """How far places (E, 3) lie beside each line, in deviations along two axes: (M, E, 2)."""
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
            spread = np.zeros((len(wrench), 2, 2))
            for along in (first, last):
                there = _of_residual(point + along[:, None] * direction, covariance)
                spread += moved @ there @ np.swapaxes(moved, 1, 2)
            return np.asarray(np.linalg.cholesky(spread), dtype=np.float64)

        radius = np.full(len(wrench), surface.radius)
        root = bounded(-radius, radius)
        # A few lines tell where along it a peg is entered at all; from there to there is a closer bound.
        grid, _ = _disc(7)
        lines = (point[:, None] + np.einsum("mxi,mij,gj->mgx", side, root, grid)).reshape(-1, 3)
        crossing = surface.entered(lines, np.repeat(direction, len(grid), axis=0))
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
    """Points (G, 2) of a square grid within `WIDTH`, so many from side to side, and their distance."""
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


_EMPTY, _NO_POINTS = np.empty(0), np.empty((0, 3))
_NO_INDICES = np.empty(0, dtype=np.int64)
_NONE = Nodes(_NO_INDICES, _NO_INDICES, _NO_INDICES, _NO_POINTS, _NO_POINTS, _EMPTY, _EMPTY, _EMPTY, _EMPTY)

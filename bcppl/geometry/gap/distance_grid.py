"""Signed distances at the nodes of a grid around a part, and how far off interpolation may be."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from bcppl.arrays import Array, Indices, Mask
from bcppl.compiled import compiled
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.parts import Part

SPACING = 0.001  # m, of a grid
_INEXACT = 0.9  # spacings by which interpolation is off where no single plane is closest, at most
_LEAST = 1e-7  # m by which it is taken to be off where no single plane is closest, at least
_MOST = 2_000_000  # nodes of a grid
_WORTH = 8.0  # exact distances that take as long as to measure one cell

# By corner of a cell (0 or 1 along each axis), the distances there.
Corners = Mapping[tuple[int, int, int], npt.NDArray[np.float32]]


class DistanceGrid(NamedTuple):
    """Signed distances (X, Y, Z), m, at the nodes of a grid in the part's frame, of which `low` is first.

    `inexact` (X - 1, Y - 1, Z - 1) is how far interpolation may be off in each cell, m: 0 where a single
    plane is closest all over it.
    """

    low: Array
    spacing: float
    distance: npt.NDArray[np.float32]
    inexact: npt.NDArray[np.float32]


def distance_grid(part: Part, signed: SignedDistance, margin: float) -> DistanceGrid:
    """The grid over a part's bounding box and `margin` metres around it.

    Trilinear interpolation is exact where one plane is closest, and within 0.9 spacings elsewhere, since the
    distance has Lipschitz constant 1. A large part has a wider spacing than 1 mm.
    """
    low, high = part.vertices.min(axis=0) - margin, part.vertices.max(axis=0) + margin
    spacing = max(SPACING, float((np.prod(high - low) / _MOST) ** (1.0 / 3.0)))
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    axes = [low[axis] + spacing * np.arange(counts[axis]) for axis in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distance = signed(torch.from_numpy(nodes.reshape(-1, 3))).distance.numpy()
    distance = distance.reshape(*counts).astype(np.float32)
    inexact = np.where(_planar(_corners(distance), spacing), 0.0, _INEXACT * spacing).astype(np.float32)
    return DistanceGrid(low, spacing, distance, inexact)


class RefinedGrid:
    """A grid that measures how far off its interpolation is, once that pays.

    Where a grid is not known to be exact, exact distances are searched for. For few poses these take less
    time than to measure, for many they take more: it is measured when they have taken about as much. That
    changes no distance.

    Attributes:
        grid: as it is now.
    """

    def __init__(self, grid: DistanceGrid, signed: SignedDistance, near: float) -> None:
        self.grid = grid
        self._signed, self._searched = signed, 0
        closest = np.min([np.abs(each) for each in _corners(grid.distance).values()], axis=0)
        self._cells = np.argwhere((grid.inexact > 0.0) & (closest < near + grid.spacing))

    def refine(self, searched: int) -> None:
        """Note that so many more exact distances were searched for."""
        self._searched += searched
        if 0 < len(self._cells) * _WORTH <= self._searched:
            self.measure()

    def measure(self) -> None:
        """Measure how far off interpolation is, in cells within `near` metres of the surface.

        Amid each cell's corners, edges and faces: nowhere in it is it off by twice as much, be it round or at
        an edge (450 000 points in each of four parts: by 1.9 times).
        """
        cells, grid = self._cells, self.grid
        corner = {at: each[tuple(cells.T)] for at, each in _corners(grid.distance).items()}
        off = _measured(cells, corner, grid.low, grid.spacing, self._signed)
        inexact = grid.inexact.copy()
        inexact[tuple(cells.T)] = np.minimum(2.0 * off + _LEAST, _INEXACT * grid.spacing)
        self.grid, self._cells = grid._replace(inexact=inexact), cells[:0]


def _measured(cells: Indices, corner: Corners, low: Array, spacing: float, signed: SignedDistance) -> Array:
    """How far off interpolation is at most amid the corners, edges and faces of cells (C, 3)."""
    halves = [half for half in product((0, 1, 2), repeat=3) if 1 in half]
    index = 2 * cells[:, None] + np.array(halves)  # (C, 19, 3) on a lattice of half the spacing
    size = index.max(axis=(0, 1)) + 1
    # Neighbours share most of these points. A table of the whole lattice finds them without sorting.
    place = np.ravel_multi_index(index.reshape(-1, 3).T, size)
    table = np.zeros(np.prod(size), np.int32)
    table[place] = 1
    first = np.flatnonzero(table)
    table[first] = np.arange(len(first))
    points = np.stack(np.unravel_index(first, size), axis=-1)
    exact = signed(torch.from_numpy(low + 0.5 * spacing * points)).distance.numpy()[table[place]]
    off = np.zeros(len(cells))
    for half, here in zip(halves, exact.reshape(len(cells), -1).T, strict=True):
        between = [
            each
            for at, each in corner.items()
            if all(h == 1 or 2 * a == h for h, a in zip(half, at, strict=True))
        ]
        off = np.maximum(off, np.abs(np.mean(between, axis=0) - here))
    return off


def _corners(distance: npt.NDArray[np.float32]) -> Corners:
    x, y, z = (count - 1 for count in distance.shape)
    return {(a, b, c): distance[a : a + x, b : b + y, c : c + z] for a, b, c in product((0, 1), repeat=3)}


def _planar(corner: Corners, spacing: float) -> Mask:
    first = corner[0, 0, 0]
    along = [corner[tuple(axis)] - first for axis in np.eye(3, dtype=int).tolist()]
    planar = np.abs(np.sqrt(sum(each**2 for each in along)) / spacing - 1.0) < 1e-3
    for (a, b, c), here in corner.items():
        planar &= np.abs(here - (first + a * along[0] + b * along[1] + c * along[2])) < 1e-6
    return planar


@compiled
def interpolated(x: float, y: float, z: float, grid: DistanceGrid) -> float:
    """The interpolated distance at a point; outside the grid its boundary's plus the L1 distance to it."""
    low, spacing, distance, _ = grid
    count_x, count_y, count_z = distance.shape
    u, v, w = (x - low[0]) / spacing, (y - low[1]) / spacing, (z - low[2]) / spacing
    inside_u = min(max(u, 0.0), count_x - 1.000001)
    inside_v = min(max(v, 0.0), count_y - 1.000001)
    inside_w = min(max(w, 0.0), count_z - 1.000001)
    beyond = abs(u - inside_u) + abs(v - inside_v) + abs(w - inside_w)
    i, j, k = int(inside_u), int(inside_v), int(inside_w)
    a, b, c = inside_u - i, inside_v - j, inside_w - k
    near = (distance[i, j, k] * (1 - c) + distance[i, j, k + 1] * c) * (1 - b) + (
        distance[i, j + 1, k] * (1 - c) + distance[i, j + 1, k + 1] * c
    ) * b
    far = (distance[i + 1, j, k] * (1 - c) + distance[i + 1, j, k + 1] * c) * (1 - b) + (
        distance[i + 1, j + 1, k] * (1 - c) + distance[i + 1, j + 1, k + 1] * c
    ) * b
    result: float = near * (1 - a) + far * a + beyond * spacing
    return result


@compiled
def inexact(x: float, y: float, z: float, grid: DistanceGrid) -> float:
    """How far off the interpolated distance at a point may be, m."""
    count_x, count_y, count_z = grid.inexact.shape
    i = int(min(max((x - grid.low[0]) / grid.spacing, 0.0), count_x - 1.0))
    j = int(min(max((y - grid.low[1]) / grid.spacing, 0.0), count_y - 1.0))
    k = int(min(max((z - grid.low[2]) / grid.spacing, 0.0), count_z - 1.0))
    return float(grid.inexact[i, j, k])


@compiled
def set_gradient(point: Array, grid: DistanceGrid, gradient: Array) -> None:
    """Set `gradient` (3,) to the unit gradient of the interpolated distance at a point (3,)."""
    low, spacing, distance, _ = grid
    i, u = _cell(point[0], low[0], spacing, distance.shape[0])
    j, v = _cell(point[1], low[1], spacing, distance.shape[1])
    k, w = _cell(point[2], low[2], spacing, distance.shape[2])
    along_x, along_y, along_z = 0.0, 0.0, 0.0
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        here = distance[i + a, j + b, k + c]
        wa = u if a else 1.0 - u
        wb = v if b else 1.0 - v
        wc = w if c else 1.0 - w
        along_x += (2 * a - 1) * wb * wc * here
        along_y += (2 * b - 1) * wa * wc * here
        along_z += (2 * c - 1) * wa * wb * here
    length = np.sqrt(along_x * along_x + along_y * along_y + along_z * along_z)
    scale = 1.0 / length if length > 0.0 else 1.0
    gradient[0], gradient[1], gradient[2] = along_x * scale, along_y * scale, along_z * scale


@compiled
def _cell(at: float, low: float, spacing: float, count: int) -> tuple[int, float]:
    """The cell of a coordinate on an axis of the grid, and the share of it that lies below."""
    inside = min(max((at - low) / spacing, 0.0), count - 1.000001)
    return int(inside), inside - int(inside)

"""The signed distance to a part sampled on a grid and interpolated, where exact distances are too slow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from bcppl.arrays import Array
from bcppl.compiled import compiled
from bcppl.geometry.distance import SignedDistance
from bcppl.geometry.parts import Part

SPACING = 0.001  # m
_MOST = 2_000_000  # nodes of a grid


class DistanceGrid(NamedTuple):
    """Signed distances at the nodes of a grid in the part's frame.

    Attributes:
        low: (3,) the first node, metres.
        spacing: between nodes, metres.
        distance: (X, Y, Z) metres, positive outside.
    """

    low: Array
    spacing: float
    distance: npt.NDArray[np.float32]


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
    return DistanceGrid(low, spacing, distance.reshape(*counts).astype(np.float32))


@compiled
def interpolated(x: float, y: float, z: float, grid: DistanceGrid) -> float:
    """The interpolated distance at a point; outside the grid its boundary's plus the L1 distance to it."""
    low, spacing, distance = grid
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
def plane_gradient(point: Array, grid: DistanceGrid, gradient: Array) -> bool:
    """Whether a single plane is closest around a point; `gradient` (3,) is set to the unit gradient there."""
    low, spacing, distance = grid
    cell, share = np.empty(3, np.int64), np.empty(3)
    for axis in range(3):
        at = min(max((point[axis] - low[axis]) / spacing, 0.0), distance.shape[axis] - 1.000001)
        cell[axis] = int(at)
        share[axis] = at - cell[axis]
    i, j, k = cell
    gradient[:] = 0.0
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        here = distance[i + a, j + b, k + c]
        wa = share[0] if a else 1.0 - share[0]
        wb = share[1] if b else 1.0 - share[1]
        wc = share[2] if c else 1.0 - share[2]
        gradient[0] += (2 * a - 1) * wb * wc * here
        gradient[1] += (2 * b - 1) * wa * wc * here
        gradient[2] += (2 * c - 1) * wa * wb * here
    plane = True
    first = distance[i, j, k]
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        expected = first + a * gradient[0] + b * gradient[1] + c * gradient[2]
        plane = plane and abs(distance[i + a, j + b, k + c] - expected) < 1e-6
    length = np.sqrt((gradient * gradient).sum())
    plane = plane and abs(length / spacing - 1.0) < 1e-3
    if length > 0.0:
        gradient /= length
    return plane

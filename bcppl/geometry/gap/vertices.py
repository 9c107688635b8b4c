"""The distances of a peg's vertices to a part, exactly where they may be the closest."""

from __future__ import annotations

import numpy as np

from bcppl.arrays import Array
from bcppl.compiled import compiled
from bcppl.geometry.distance import Surface, signed_at
from bcppl.geometry.gap.distance_grid import DistanceGrid, inexact, interpolated, set_gradient
from bcppl.geometry.gap.frames import Frames, placed, relative
from bcppl.geometry.gap.solids import Solids

# m: edges are evaluated, and distances exactly where the grid is inexact, below NEAR. Above FADING
# edges count for less and less, so that the gap is continuous.
FADING, NEAR = 0.003, 0.004
_STEEPEST = 3.0**0.5  # slope of a distance that is interpolated axis by axis, at most


@compiled
def _interpolate(
    points: Array,
    first: int,
    last: int,
    turn: Array,
    shift: Array,
    grid: DistanceGrid,
    distance: Array,
    slack: Array,
) -> None:
    """Set `distance` to interpolated ones at points (P, 3) of the peg's frame, from `first` to `last`.

    `slack` is set to how far off each may be.
    """
    # The rotation is looked up once: arrays given to a function for each point take longer than all of it.
    ax, ay, az = turn[0, 0], turn[0, 1], turn[0, 2]
    bx, by, bz = turn[1, 0], turn[1, 1], turn[1, 2]
    cx, cy, cz = turn[2, 0], turn[2, 1], turn[2, 2]
    for p in range(first, last):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        u = ax * x + ay * y + az * z + shift[0]
        v = bx * x + by * y + bz * z + shift[1]
        w = cx * x + cy * y + cz * z + shift[2]
        distance[p], slack[p] = interpolated(u, v, w, grid), inexact(u, v, w, grid)


@compiled
def by_vertices(
    first: int,
    last: int,
    part: Frames,
    peg: Frames,
    grid: DistanceGrid,
    surface: Surface,
    solids: Solids,
    distance: Array,
    witness: Array,
    normal: Array,
) -> int:
    """Set the distances of the peg's vertices to the part, their witness points (3,) and normals (3,).

    Returns:
        how many exact distances were searched for, where the grid was not known to be exact enough.
    """
    searched = 0
    corners, stops, spheres = solids.corners, solids.stops, solids.spheres
    bound, here, slack = np.empty((2, len(spheres))), np.empty(len(corners)), np.empty(len(corners))
    turn, shift = np.empty((3, 3)), np.empty(3)
    point, on_part, gradient = np.empty(3), np.empty(3), np.empty(3)
    # The triangle of the part that was closest to a vertex at the pose before.
    triangle = np.zeros(len(corners), np.int64)
    inexact_ones = np.empty(len(corners), np.int64)
    for n in range(first, last):
        own = n if len(peg.rotation) > 1 else 0
        for t in range(peg.rotation.shape[1]):
            relative(part, n, peg, own, t, turn, shift)
            first_group = 0
            _interpolate(spheres, 0, len(spheres), turn, shift, grid, bound[0], bound[1])
            for g in range(len(spheres)):
                bound[0, g] -= _STEEPEST * spheres[g, 3]
                if bound[0, g] < bound[0, first_group]:
                    first_group = g
            # `most` is the least of what the vertices' distances are at most.
            least, closest, most, exact = np.inf, 0, np.inf, -1
            for k in range(-1, len(spheres)):
                g = first_group if k < 0 else k
                # The closest group comes first, so that hardly any other has to be looked into.
                if k == first_group:
                    continue
                begin = stops[g - 1] if g else 0
                if bound[0, g] > least and (least >= NEAR or bound[0, g] - grid.spacing >= most):
                    here[begin : stops[g]] = np.inf
                    continue
                _interpolate(corners, begin, stops[g], turn, shift, grid, here, slack)
                for c in range(begin, stops[g]):
                    if here[c] < least:
                        least, closest = here[c], c
                    most = min(most, here[c] + slack[c])
                    if slack[c] == 0.0 and (exact < 0 or here[c] < here[exact]):
                        exact = c
            left = 0
            if abs(least) < NEAR:
                closest = exact
                for c in range(len(corners)):
                    if here[c] - slack[c] < most and slack[c] > 0.0:
                        inexact_ones[left] = c
                        left += 1
            if closest >= 0:
                distance[n, t] = here[closest]
                placed(corners[closest], turn, shift, witness[n, t])
                set_gradient(witness[n, t], grid, normal[n, t])
            else:
                distance[n, t] = np.inf
            while left:
                # That which may be the closest comes first: few others are left after it.
                nearest = 0
                for k in range(1, left):
                    c, other = inexact_ones[k], inexact_ones[nearest]
                    if here[c] - slack[c] < here[other] - slack[other]:
                        nearest = k
                c, left = inexact_ones[nearest], left - 1
                inexact_ones[nearest] = inexact_ones[left]
                if here[c] - slack[c] >= distance[n, t]:
                    break
                searched += 1
                placed(corners[c], turn, shift, point)
                away, triangle[c] = signed_at(point, surface, triangle[c], on_part, gradient)
                if away < distance[n, t]:
                    distance[n, t], witness[n, t], normal[n, t] = away, point, gradient
    return searched

"""The distances of a peg's vertices to a part, exactly where they may be the closest."""

from __future__ import annotations

import numpy as np

from bcppl.arrays import Array, Indices
from bcppl.compiled import compiled
from bcppl.geometry.distance import INEXACT, DistanceGrid, interpolated, is_planar, set_gradient
from bcppl.geometry.gap.frames import Frames, placed, relative
from bcppl.geometry.gap.solids import Solids

NEAR = 0.002  # m: below this gap edges are evaluated, and distances exactly where the grid is inexact
_STEEPEST = 3.0**0.5  # slope of a distance that is interpolated axis by axis, at most


@compiled
def _interpolate(
    points: Array, first: int, last: int, turn: Array, shift: Array, grid: DistanceGrid, distance: Array
) -> None:
    """Set `distance` from `first` to `last` to interpolated ones, at points (P, 3) of the peg's frame."""
    # The rotation is looked up once: arrays given to a function for each point take longer than all of it.
    ax, ay, az = turn[0, 0], turn[0, 1], turn[0, 2]
    bx, by, bz = turn[1, 0], turn[1, 1], turn[1, 2]
    cx, cy, cz = turn[2, 0], turn[2, 1], turn[2, 2]
    for p in range(first, last):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        distance[p] = interpolated(
            ax * x + ay * y + az * z + shift[0],
            bx * x + by * y + bz * z + shift[1],
            cx * x + cy * y + cz * z + shift[2],
            grid,
        )


@compiled
def _look_up(
    turn: Array, shift: Array, grid: DistanceGrid, solids: Solids, bound: Array, here: Array, point: Array
) -> tuple[float, int, float]:
    """Set `here` (V,) to the vertices' interpolated distances, of those that can be closest.

    `bound` (G,) and `point` (3,) are room.

    Returns:
        the least distance; the index of the closest vertex around which one plane is closest, -1 if it has
        none; a bound of the exact least distance, below which others may be: infinite where all are far.
    """
    corners, stops, spheres = solids.corners, solids.stops, solids.spheres
    inexact, first_group = INEXACT * grid.spacing, 0
    _interpolate(spheres, 0, len(spheres), turn, shift, grid, bound)
    for g in range(len(spheres)):
        bound[g] -= _STEEPEST * spheres[g, 3]
        if bound[g] < bound[first_group]:
            first_group = g
    least, closest = np.inf, 0
    for k in range(-1, len(spheres)):
        g = first_group if k < 0 else k
        # The closest group comes first, so that hardly any other has to be looked into.
        if k == first_group:
            continue
        begin = stops[g - 1] if g else 0
        if bound[g] > least + (2.0 * inexact if least < NEAR else 0.0):
            here[begin : stops[g]] = np.inf
            continue
        _interpolate(corners, begin, stops[g], turn, shift, grid, here)
        for c in range(begin, stops[g]):
            if here[c] < least:
                least, closest = here[c], c
    if abs(least) >= NEAR:
        return least, closest, np.inf
    planar, most = -1, np.inf
    for c in range(len(corners)):
        if here[c] > least + 2.0 * inexact:
            continue
        placed(corners[c], turn, shift, point)
        if not is_planar(point, grid):
            most = min(most, here[c] + inexact)
        elif planar < 0 or here[c] < here[planar]:
            planar, most = c, min(most, here[c])
    return least, planar, most


@compiled
def _is_uncertain(
    c: int,
    most: float,
    turn: Array,
    shift: Array,
    grid: DistanceGrid,
    solids: Solids,
    here: Array,
    point: Array,
) -> bool:
    """Whether a vertex may be the closest one, and its distance is inexact; sets `point` (3,) to it."""
    if here[c] - INEXACT * grid.spacing >= most:
        return False
    placed(solids.corners[c], turn, shift, point)
    return not is_planar(point, grid)


@compiled
def by_vertices(
    first: int,
    last: int,
    part: Frames,
    peg: Frames,
    grid: DistanceGrid,
    solids: Solids,
    distance: Array,
    witness: Array,
    normal: Array,
    several: Indices,
) -> None:
    """The distances of the peg's vertices to the part, and how many vertices are to be looked at exactly."""
    bound, here, point = np.empty(len(solids.spheres)), np.empty(len(solids.corners)), np.empty(3)
    turn, shift = np.empty((3, 3)), np.empty(3)
    for n in range(first, last):
        own = n if len(peg.rotation) > 1 else 0
        for t in range(peg.rotation.shape[1]):
            relative(part, n, peg, own, t, turn, shift)
            _, closest, most = _look_up(turn, shift, grid, solids, bound, here, point)
            if most < np.inf:
                for c in range(len(solids.corners)):
                    several[n, t] += _is_uncertain(c, most, turn, shift, grid, solids, here, point)
            if closest < 0:
                distance[n, t] = np.inf
                continue
            distance[n, t] = here[closest]
            placed(solids.corners[closest], turn, shift, witness[n, t])
            set_gradient(witness[n, t], grid, normal[n, t])


@compiled
def collect(
    which: Indices,
    ends: Indices,
    part: Frames,
    peg: Frames,
    grid: DistanceGrid,
    solids: Solids,
    points: Array,
) -> None:
    """Set `points` to the uncertain vertices of pairs (K, 2), in the part's frame; `ends` (K,) are theirs."""
    bound, here, point = np.empty(len(solids.spheres)), np.empty(len(solids.corners)), np.empty(3)
    turn, shift = np.empty((3, 3)), np.empty(3)
    for k in range(len(which)):
        n, t = which[k]
        relative(part, n, peg, n if len(peg.rotation) > 1 else 0, t, turn, shift)
        most = _look_up(turn, shift, grid, solids, bound, here, point)[2]
        place = ends[k - 1] if k else 0
        for c in range(len(solids.corners)):
            if _is_uncertain(c, most, turn, shift, grid, solids, here, point):
                points[place] = point
                place += 1


@compiled
def take(
    which: Indices,
    ends: Indices,
    points: Array,
    exact: Array,
    gradient: Array,
    distance: Array,
    witness: Array,
    normal: Array,
) -> None:
    """Take the exact distances of points where these are closer."""
    for k in range(len(which)):
        n, t = which[k]
        for p in range(ends[k - 1] if k else 0, ends[k]):
            if exact[p] < distance[n, t]:
                distance[n, t], witness[n, t], normal[n, t] = exact[p], points[p], gradient[p]

"""Convex covers of polygonal regions: a convex partition, each cell expanded into its neighbours.

Convex pieces that share only their boundaries have faces inside the solid on which a sliding body can catch.
Pieces that overlap along the region's own edges have no such face on the walls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from bcppl.arrays import Array

_TIGHT = 1e-11  # m by which expansion may exceed a region; MuJoCo's single precision resolves 1e-9 m
_STRAIGHT = 1e-9  # sine of the turning angle below which a vertex counts as collinear
_ROUNDED = 8  # vertices from which on a hole is enclosed in a box


@dataclass(frozen=True, eq=False)
class Cell:
    """One convex polygon of a cover: its core (C, 2), counter-clockwise, and an expansion (G, 2) of it.

    The cores of a cover partition the region; an expansion is convex and lies within the region.
    """

    core: Array
    grown: Array


def convex_cells(region: shapely.Polygon | shapely.MultiPolygon, reach: float) -> list[Cell]:
    """Convex cells whose cores partition a region, expanded into one another where the region allows it.

    The partition is a constrained Delaunay triangulation whose diagonals are removed, longest first, while
    cells stay convex: at most four times as many cells as the minimum (Hertel and Mehlhorn 1983). A hole with
    many vertices is enclosed in a box first, so that the small cells along its sides stay near it. A cell
    expands across a diagonal by `reach` metres at most.
    """
    cells: list[Cell] = []
    for polygon in polygons_of(region):
        cores = [core for part in _boxed(polygon) for core in _partition(part)]
        cells += map(Cell, cores, grown_in(polygon, cores, reach))
    return cells


def grown_in(region: shapely.Polygon | shapely.MultiPolygon, cores: list[Array], reach: float) -> list[Array]:
    """Convex polygons (G, 2) within a region: cores (C, 2) whose inner sides are offset by up to `reach`."""
    shapely.prepare(allowed := region.buffer(_TIGHT, join_style="mitre"))
    shapely.prepare(boundary := region.boundary)
    convex: dict[tuple[float, float], list[Array]] = {}
    for polygon in polygons_of(region):
        convex |= _corner_normals(polygon)
    return [_grown(core, boundary, allowed, reach, convex) for core in cores]


def polygons_of(region: shapely.Geometry) -> list[shapely.Polygon]:
    """The polygons of a region with positive area, wound counter-clockwise."""
    polygons = [p for p in shapely.get_parts(region) if isinstance(p, shapely.Polygon) and p.area > 0]
    return [shapely.orient_polygons(polygon) for polygon in polygons]


def _boxed(polygon: shapely.Polygon) -> list[shapely.Polygon]:
    """The polygon cut along boxes around its rounded holes where such boxes fit."""
    outline, rest = shapely.Polygon(polygon.exterior), polygon
    cut: list[shapely.Polygon] = []
    for ring in polygon.interiors:
        hole = shapely.Polygon(ring)
        low, high = np.reshape(hole.bounds, (2, 2))
        margin = 0.1 * (high - low)
        box = shapely.box(*(low - margin), *(high + margin))
        others = shapely.union_all([shapely.Polygon(r) for r in polygon.interiors if r is not ring])
        alone = (
            outline.contains(box) and not box.intersects(others) and all(not box.intersects(b) for b in cut)
        )
        if len(ring.coords) - 1 >= _ROUNDED and alone:
            cut.append(box)
            rest = shapely.difference(rest, box)
    rings = [shapely.difference(box, shapely.difference(outline, polygon)) for box in cut]
    return [p for part in (rest, *rings) for p in polygons_of(part)]


def _partition(polygon: shapely.Polygon) -> list[Array]:
    """Vertices (C, 2), counter-clockwise, of the cells of a convex partition."""
    triangles = [
        np.asarray(t.exterior.coords)[:-1]
        for t in polygons_of(shapely.constrained_delaunay_triangles(polygon))
    ]
    points, index = np.unique(np.concatenate(triangles), axis=0, return_inverse=True)
    tiles = dict(enumerate(index.reshape(-1, 3).tolist()))
    sides = {(c[j], c[(j + 1) % 3]): k for k, c in tiles.items() for j in range(3)}
    diagonals = sorted(
        (s for s in sides if s[0] < s[1] and s[::-1] in sides),
        key=lambda s: -float(np.linalg.norm(points[s[0]] - points[s[1]])),
    )
    for a, b in diagonals:
        first, second = sides[a, b], sides[b, a]
        if first == second:
            continue
        merged = _joined(tiles[first], tiles[second], a, b)
        if _convex_at(points, merged, a) and _convex_at(points, merged, b):
            for j, corner in enumerate(tiles[second]):
                sides[corner, tiles[second][(j + 1) % len(tiles[second])]] = first
            tiles[first] = merged
            del tiles[second]
    return [straightened(points[corners]) for corners in tiles.values()]


def _joined(first: list[int], second: list[int], a: int, b: int) -> list[int]:
    """Vertices of the union of two counter-clockwise cells across the side from `a` to `b` of the first."""
    i, j = first.index(a), second.index(b)
    return [*first[i + 1 :], *first[: i + 1], *(second[j + 1 :] + second[:j])[1:]]


def _convex_at(points: Array, corners: list[int], corner: int) -> bool:
    k = corners.index(corner)
    before, here, after = (points[corners[(k + d) % len(corners)]] for d in (-1, 0, 1))
    return _turn(here - before, after - here) > -_STRAIGHT


def _turn(a: Array, b: Array) -> float:
    """The sine of the angle between two directions, positive counter-clockwise."""
    return float((a[0] * b[1] - a[1] * b[0]) / (np.linalg.norm(a) * np.linalg.norm(b)))


def straightened(corners: Array) -> Array:
    """A polygon's vertices (C, 2) without those collinear with their neighbours."""
    kept = corners[np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) > 0]
    before, after = kept - np.roll(kept, 1, axis=0), np.roll(kept, -1, axis=0) - kept
    sharp = [abs(_turn(a, b)) > _STRAIGHT for a, b in zip(before, after, strict=True)]
    return np.asarray(kept[sharp])


def _outward(corners: Array) -> Array:
    """Unit normals (C, 2) to the right of a ring's sides: outward where it is counter-clockwise."""
    side = np.roll(corners, -1, axis=0) - corners
    normal = np.stack([side[:, 1], -side[:, 0]], axis=1)
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _corner_normals(polygon: shapely.Polygon) -> dict[tuple[float, float], list[Array]]:
    """Outward normals of the two sides at each convex vertex of a polygon."""
    normals = {}
    for ring in (polygon.exterior, *polygon.interiors):
        corners = np.asarray(ring.coords)[:-1]
        corners = corners[np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) > 0]
        normal = _outward(corners)
        for corner, before, after in zip(corners, np.roll(normal, 1, axis=0), normal, strict=True):
            if _turn(before, after) > 0:
                normals[tuple(corner.tolist())] = [before, after]
    return normals


def _grown(
    core: Array,
    boundary: shapely.Geometry,
    allowed: shapely.Geometry,
    reach: float,
    convex: dict[tuple[float, float], list[Array]],
) -> Array:
    """A convex polygon around a core: its inner sides offset as far as the region allows."""
    if len(straightened(core)) < 3:  # a chamfer may end in an edge
        return core
    normal = _outward(core)
    level = np.sum(normal * core, axis=1)
    middle = shapely.points(0.5 * (core + np.roll(core, -1, axis=0)))
    inner = np.flatnonzero(shapely.distance(middle, boundary) > 1e-9)
    # Where a diagonal ends at a convex vertex of the region, the vertex's two sides bound the cell, too.
    for corner in core:
        for n in convex.get(tuple(corner.tolist()), []):
            if (core @ n).max() <= corner @ n + 1e-12:
                normal, level = np.vstack([normal, n]), np.append(level, corner @ n)
    frame, center = 4.0 * (np.ptp(core, axis=0).max() + reach), core.mean(axis=0)
    start = level.copy()
    for moved in (inner, *inner[:, None]):  # all at once, then each that can be offset farther alone
        for distance in reach * 0.5 ** np.arange(6):
            wider = level.copy()
            wider[moved] = np.maximum(level[moved], start[moved] + distance)
            if allowed.covers(shapely.Polygon(_cut(center, frame, normal, wider))):
                level = wider
                break
    return _cut(center, frame, normal, level)


def _cut(center: Array, frame: float, normal: Array, level: Array) -> Array:
    """The intersection of a square of half width `frame` about a centre with half planes n . x <= level."""
    corners = center + frame * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    for n, d in zip(normal, level, strict=True):
        height = corners @ n - d
        if (height <= 0).all():
            continue
        following, beyond = np.roll(corners, -1, axis=0), np.roll(height, -1)
        crossed = height * beyond < 0
        share = height[crossed] / (height[crossed] - beyond[crossed])
        kept = np.concatenate([np.flatnonzero(height <= 0), np.flatnonzero(crossed) + 0.5])
        crossing = corners[crossed] + share[:, None] * (following[crossed] - corners[crossed])
        corners = np.concatenate([corners[height <= 0], crossing])[np.argsort(kept)]
    return corners

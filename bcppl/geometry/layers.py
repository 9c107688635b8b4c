"""Convex prisms from the cross sections of a mesh: walls along one axis, faces across it, and chamfers."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import shapely
import trimesh
from scipy.spatial import cKDTree

from bcppl.arguments import number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.convex.cover import Cell, convex_cells, grown_in, polygons_of, straightened
from bcppl.geometry.convex.hausdorff import hausdorff_error
from bcppl.geometry.extrusion import BEVEL, OVERLAP
from bcppl.geometry.parts import Part, Piece

_LEVEL = 2e-6  # m: vertices closer in height than this lie on one level; files round to 1e-6
_FLAT = 2e-3  # radians: faces that differ by less are coplanar, or vertical: rounding again
_MANY = 256  # vertices from which on a convex part, too, is rebuilt from its sections
_ROTATIONS = {"x": np.roll(np.eye(3), 2, axis=0), "y": np.roll(np.eye(3), 1, axis=0), "z": np.eye(3)}


@dataclass(frozen=True, eq=False)
class Layer:
    """A slab of a solid between two heights (m): a prism, or tapered linearly from one section to another.

    The section at the top is vertex by vertex that at the bottom, moved; of a prism it is the same object.
    """

    bottom: float
    top: float
    low: shapely.MultiPolygon
    high: shapely.MultiPolygon

    @property
    def upright(self) -> bool:
        """Whether its walls are parallel to the axis."""
        return self.low is self.high


def prismatic(part: Part, axis: str = "z", tolerance: float = 5e-6) -> Part:
    """The part with convex prisms as its pieces, constructed from the cross sections of its mesh.

    Between two levels the mesh's walls are parallel to the axis, or taper linearly as a chamfer does.
    Vertices of an outline within the tolerance of a straight line are dropped. Prisms extend through other
    levels as far as the solid does, so that a continuous wall has no seam.

    Args:
        part: with a closed mesh.
        axis: of the prisms, "x", "y" or "z".
        tolerance: largest deviation of an outline, metres. At 5 um a bore of 9 mm has 72 sides.

    Raises:
        InputError: the mesh is empty, open, inside out, in millimetres, or has faces that are neither
            walls, levels nor chamfers, so that the Hausdorff error of the pieces exceeds twice the tolerance;
            or the tolerance is not above 0.
    """
    part.check()
    number_within(f"part {part.name!r} is decomposed into prisms with tolerance {{}}", tolerance, above=0.0)
    rotation = _ROTATIONS[axis]
    mesh = trimesh.Trimesh(part.vertices @ rotation.T, part.faces, process=False)
    hull = mesh.convex_hull
    convex = hull.volume - mesh.volume <= 0.1 * tolerance * mesh.area
    if convex and len(hull.vertices) <= _MANY:
        pieces = [Piece("hull", np.asarray(hull.vertices))]
    else:
        pieces = _pieces(_layers(mesh, tolerance), tolerance)
    made = replace(part, pieces=tuple(replace(p, size=p.size @ rotation) for p in pieces))
    error = hausdorff_error(made, count=5000) if pieces else None
    if error is None or error.largest > 2 * tolerance + _LEVEL:
        off = "none remain" if error is None else f"their error is {1000 * error.largest:.2g} mm"
        raise InputError(
            f"part {part.name!r} does not consist of walls along {axis}, faces across it and chamfers (of "
            f"its prisms {off}); give another axis, or decompose it with `decomposed`."
        )
    return made


def _levels(mesh: trimesh.Trimesh) -> list[float]:
    """Heights of the horizontal edges at which the surface bends; between them all faces are planar."""
    bent = mesh.face_adjacency_angles > _FLAT
    ends = mesh.vertices[mesh.face_adjacency_edges[bent], 2]
    sloped = np.abs(mesh.face_normals[mesh.face_adjacency[bent], 2]).max(axis=1) > _FLAT
    heights = ends[sloped & (np.ptp(ends, axis=1) < _LEVEL)].ravel()
    heights = np.sort(np.concatenate([heights, mesh.bounds[:, 2]]))
    groups = np.split(heights, np.flatnonzero(np.diff(heights) > _LEVEL) + 1)
    return [float(np.median(group)) for group in groups]


def _layers(mesh: trimesh.Trimesh, tolerance: float) -> list[Layer]:
    """The slabs of a solid, bottom to top; sections that agree are one object."""
    layers: list[Layer] = []
    for bottom, top in itertools.pairwise(_levels(mesh)):
        inset = 0.01 * (top - bottom)
        near, far = (_section(mesh, height) for height in (bottom + inset, top - inset))
        if _same(near, far, 2 * _LEVEL):
            low = _known(layers, _section(mesh, 0.5 * (bottom + top)), tolerance)
            layers.append(Layer(bottom, top, low, low))
        else:
            low = _known(layers, _section(mesh, bottom + _LEVEL), tolerance)
            layers.append(Layer(bottom, top, low, _moved(low, far, _corners_at(mesh, top, far, 2 * inset))))
    return layers


def cross_section(mesh: trimesh.Trimesh, height: float) -> list[shapely.Polygon]:
    """The polygons in which a closed mesh meets the plane z = height (m), in its x-y plane."""
    above, ends = mesh.vertices[:, 2] - height, mesh.edges_unique
    # From the lower end: the edges on either side of a seam meet the plane in the same point, to the bit.
    low, high = np.where((above[ends[:, 0]] < above[ends[:, 1]])[:, None], ends, ends[:, ::-1]).T
    crosses = (above[low] < 0.0) & (above[high] >= 0.0)
    start, stop = mesh.vertices[low[crosses]], mesh.vertices[high[crosses]]
    points = np.empty((len(ends), 2))
    points[crosses] = (start + (height - start[:, 2:]) / (stop - start)[:, 2:] * (stop - start))[:, :2]
    sides = mesh.faces_unique_edges
    cut = crosses[sides].sum(axis=1) == 2
    segments = points[sides[cut][crosses[sides[cut]]].reshape(-1, 2)]
    segments = segments[(segments[:, 0] != segments[:, 1]).any(axis=1)]
    return polygons_of(shapely.build_area(shapely.multilinestrings(shapely.linestrings(segments))))


def _section(mesh: trimesh.Trimesh, height: float) -> shapely.MultiPolygon:
    return shapely.MultiPolygon(polygons_of(shapely.union_all(cross_section(mesh, height))))


def _known(layers: list[Layer], section: shapely.MultiPolygon, tolerance: float) -> shapely.MultiPolygon:
    """The section of a layer below that agrees with this one, else this one without collinear vertices."""
    simple = shapely.simplify(section, tolerance)
    if isinstance(simple, shapely.Polygon):
        simple = shapely.MultiPolygon([simple])
    equal = (k.high for k in reversed(layers) if _same(k.high, simple, tolerance + _LEVEL))
    return next(equal, simple)


def _same(a: shapely.Geometry, b: shapely.Geometry, tolerance: float) -> bool:
    """Whether the Hausdorff distance between two sections is at most the tolerance."""
    return bool(a.buffer(tolerance).covers(b) and b.buffer(tolerance).covers(a))


def _corners_at(mesh: trimesh.Trimesh, height: float, section: shapely.Geometry, reach: float) -> Array:
    """The mesh's vertices (K, 2) at a height within a distance `reach` of a section's outline."""
    level = mesh.vertices[np.abs(mesh.vertices[:, 2] - height) < _LEVEL][:, :2]
    return np.asarray(level[shapely.distance(shapely.points(level), section.boundary) <= reach])


def _moved(section: shapely.MultiPolygon, far: shapely.MultiPolygon, corners: Array) -> shapely.MultiPolygon:
    """A section with each vertex moved to the nearest of some corners, unless it is on the far outline."""
    if len(corners) == 0:
        return shapely.transform(section, np.copy)
    tree = cKDTree(corners)

    def nearest(points: Array) -> Array:
        stays = shapely.distance(shapely.points(points), far.boundary) <= 2 * _LEVEL
        return np.where(stays[:, None], points, corners[tree.query(points)[1]])

    return shapely.transform(section, nearest)


def _pieces(layers: list[Layer], tolerance: float) -> list[Piece]:
    """Convex pieces: upright layers with the chamfers that cap them, then the other chamfers."""
    pieces, used = [], set()
    for k, layer in enumerate(layers):
        if not layer.upright or layer.low.is_empty:
            continue
        caps = {}
        if k > 0 and not layers[k - 1].upright and layers[k - 1].high is layer.low:
            caps[-1] = (layers[k - 1].bottom, layers[k - 1].low)
        if k + 1 < len(layers) and not layers[k + 1].upright and layers[k + 1].low is layer.low:
            caps[1] = (layers[k + 1].top, layers[k + 1].high)
        caps = {d: c for d, c in caps.items() if layer.low.buffer(_LEVEL).covers(c[1])}
        used |= {k + d for d in caps}
        pieces += _columns(k, layers, caps, tolerance)
    for k, layer in enumerate(layers):
        if k not in used and not layer.upright and not layer.low.is_empty:
            alone = [Layer(layer.bottom, layer.bottom, layer.low, layer.low)]
            pieces += _columns(0, alone, {1: (layer.top, layer.high)}, tolerance)
    return pieces


def _columns(
    k: int, layers: list[Layer], caps: dict[int, tuple[float, shapely.MultiPolygon]], tolerance: float
) -> list[Piece]:
    """The pieces of layer `k` with its caps: end height and end section, by direction (-1 below, 1 above)."""
    base, cells = layers[k].low, convex_cells(layers[k].low, OVERLAP)
    hulls: list[list[Array]] = [[] for _ in cells]
    for direction in (-1, 1):
        if direction in caps:
            rest = layers[k].bottom if direction < 0 else layers[k].top
            ends = _capped(cells, base, rest, *caps[direction], direction, tolerance)
        else:
            ends = [_upright_end(cell, layers, k, direction) for cell in cells]
        for hull, end in zip(hulls, ends, strict=True):
            hull += end
    return [Piece("hull", np.concatenate(hull)) for hull in hulls]


def _upright_end(cell: Cell, layers: list[Layer], k: int, direction: int) -> list[Array]:
    """Vertices (C, 3) of one end of a cell, extended through upright layers as far as they are solid."""
    grown = shapely.Polygon(cell.grown)
    while 0 <= k + direction < len(layers):
        beyond = layers[k + direction]
        if not (beyond.upright and beyond.low.buffer(1e-11).covers(grown)):
            break
        k += direction
    end = layers[k].bottom if direction < 0 else layers[k].top
    bevel = min(BEVEL, 0.25 * (layers[k].top - layers[k].bottom))
    return [np.insert(cell.core, 2, end, axis=1), np.insert(cell.grown, 2, end - direction * bevel, axis=1)]


def _capped(
    cells: list[Cell],
    base: shapely.MultiPolygon,
    rest: float,
    end: float,
    section: shapely.MultiPolygon,
    direction: int,
    tolerance: float,
) -> list[list[Array]]:
    """For each cell the vertices (C, 3) of an end capped by a chamfer, from height `rest` to `end`."""
    pairs = zip(shapely.get_coordinates(base).tolist(), shapely.get_coordinates(section), strict=True)
    image = {tuple(a): b for a, b in pairs}  # of each vertex at the end of the chamfer
    halfway = shapely.transform(
        base, lambda points: np.array([0.5 * (p + image[tuple(p.tolist())]) for p in points])
    )
    shapely.prepare(allowed := halfway.buffer(0.2 * tolerance))
    capped = []
    cores = [np.array([image.get(tuple(p.tolist()), p) for p in cell.core]) for cell in cells]
    wide = grown_in(section, [straightened(core) for core in cores], OVERLAP)
    wide = [wider if len(wider) > 2 else core for wider, core in zip(wide, cores, strict=True)]
    for cell, core, wider in zip(cells, cores, wide, strict=True):
        corners = [np.insert(cell.core, 2, rest, axis=1), np.insert(core, 2, end, axis=1)]
        both = 0.5 * (cell.grown[:, None] + wider[None]).reshape(-1, 2)
        if allowed.covers(shapely.MultiPoint(both).convex_hull):
            corners += [np.insert(cell.grown, 2, rest, axis=1)]
            corners += [np.insert(wider, 2, end - direction * min(BEVEL, 0.25 * abs(end - rest)), axis=1)]
        capped.append(corners)
    return capped

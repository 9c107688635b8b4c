"""The faces of a part that can be touched from above and from its sides, from its mesh."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import shapely
from shapely.affinity import translate

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.convex.cover import polygons_of
from bcppl.geometry.parts import Part

_BELOW = 0.0002  # m below the top at which its outline is taken
_HOLE = 0.002  # m
_STRAIGHT = 0.0001  # m by which a side may be bent
_ON_HULL = 0.0002  # m from its outline: an edge of a section's convex hull is one of its own
_TRIES = (1.0, 0.75, 0.5, 0.25, 0.0)  # shares of the margin that was asked for
_CANDIDATES = 60
_WORTH_A_LIFT = 2.0  # a lift is worth it for a triangle so many times as large


class Side(NamedTuple):
    """An upright face in the part's x-y plane: its ends (2,), metres, and its outward unit normal (2,)."""

    start: Array
    stop: Array
    normal: Array

    @property
    def length(self) -> float:
        """Metres."""
        return float(np.linalg.norm(self.stop - self.start))


class TopPoints(NamedTuple):
    """Points of contact on a top (3, 2), in the part's x-y plane, metres.

    A peg can slide from the first to the second, and on to the third unless it must be `lifted`.
    """

    positions: Array
    lifted: bool


def section(part: Part, height: float) -> shapely.Polygon:
    """The cross section of a part at a height z in its frame, the largest piece of it, metres."""
    path = part.mesh.section(plane_origin=[0.0, 0.0, height], plane_normal=[0.0, 0.0, 1.0])
    if path is None:
        raise InputError(
            f"part {part.name!r} has no cross section at z = {height:g} m; give a height within it."
        )
    planar, to_3d = path.to_2D(normal=[0.0, 0.0, 1.0])
    polygons = [translate(p, to_3d[0, 3], to_3d[1, 3]) for p in planar.polygons_full]
    pieces = [p for each in polygons for p in polygons_of(each)]
    return shapely.simplify(max(pieces, key=lambda p: p.area), 1e-5)


def points_on_top(part: Part, peg: Part, margin: float) -> TopPoints:
    """Three points on a part's top, far apart, between which a peg can slide on it, in that order.

    The peg's whole cross section stays on the top, `margin` metres from its outer edge where there is room
    for that, and 2 mm from holes. Of all such triples of candidates, the one with the largest triangle; where
    slides cannot lead far, as on a narrow rim, the peg is lifted to the third.
    """
    top = float(part.vertices[:, 2].max())
    outline = section(part, top - _BELOW)
    across = float(np.linalg.norm(peg.vertices[:, :2], axis=1).max())
    holes = shapely.union_all([shapely.Polygon(ring) for ring in outline.interiors])
    room = shapely.Polygon()
    for share in _TRIES:
        outside = shapely.Polygon(outline.exterior).buffer(-(across + share * margin))
        room = outside.difference(holes.buffer(across + share * _HOLE))
        if _spread(room) >= 1.5 * across:
            break
    if room.is_empty:
        room = outline.buffer(-0.5 * across)
    if room.is_empty:
        raise InputError(
            f"the top of part {part.name!r} has no room for a peg {2e3 * across:.3g} mm across; "
            "plan touches by hand."
        )
    candidates = boundary_points(room)
    reachable = _straight_ways(room, candidates)
    from_middle = candidates[None] - candidates[:, None]
    sizes = np.abs(  # (M, M, M): twice the area, by the second point, the first and the third
        from_middle[:, :, None, 0] * from_middle[:, None, :, 1]
        - from_middle[:, :, None, 1] * from_middle[:, None, :, 0]
    )
    slid, lifted = (
        np.where(ways, sizes, -1.0)
        for ways in (reachable[:, :, None] & reachable[:, None, :], reachable[:, :, None])
    )
    worth = bool(lifted.max() > _WORTH_A_LIFT * slid.max())
    areas = lifted if worth else slid
    second, first, third = np.unravel_index(int(areas.argmax()), areas.shape)
    return TopPoints(candidates[[first, second, third]], worth)


def sides(part: Part, height: float) -> list[Side]:
    """The upright faces on the outside of a part's cross section at a height z, the longest first.

    They are the stretches of its convex hull's edges that lie on its own outline: across a recess there is
    nothing to slide along.

    Raises:
        InputError: the part has no cross section at the height.
    """
    outline = section(part, height)
    near = outline.exterior.buffer(_ON_HULL)
    ring = shapely.geometry.polygon.orient(outline.convex_hull).exterior
    corners = np.asarray(shapely.simplify(ring, _STRAIGHT).coords)
    faces = []
    for start, stop in pairwise(corners):
        along = (stop - start) / np.linalg.norm(stop - start)
        normal = np.array([along[1], -along[0]])
        for stretch in shapely.get_parts(shapely.LineString([start, stop]).intersection(near)):
            ends = np.asarray(stretch.coords)
            begin, end = ends[np.argsort(ends @ along)][[0, -1]]
            faces.append(Side(begin, end, normal))
    return sorted(faces, key=lambda side: -side.length)


def _spread(room: shapely.Geometry) -> float:
    if room.is_empty:
        return 0.0
    low, high = np.reshape(room.bounds, (2, 2))
    return float((high - low).min())


def boundary_points(room: shapely.Geometry) -> Array:
    """Points (M, 2) along the outer boundaries, where the vertices of the largest triangle lie."""
    pieces = [shapely.Polygon(piece.exterior) for piece in polygons_of(room)]
    whole = sum(piece.length for piece in pieces)
    points = []
    for ring in pieces:
        # Points are inside, if only just. A ring that is narrow somewhere falls into several.
        shrunk = [p for p in shapely.get_parts(ring.buffer(-1e-6)) if p.area > 0.0] or [ring]
        length = sum(piece.length for piece in shrunk)
        for line in (piece.exterior for piece in shrunk):
            count = round(_CANDIDATES * ring.length * (line.length / length) / whole)
            shares = np.linspace(0, 1, max(3, count))
            points.append(np.asarray(shapely.simplify(line, 1e-4).coords))
            points.append(
                np.asarray([line.interpolate(share, normalized=True).coords[0] for share in shares])
            )
    return np.unique(np.round(np.concatenate(points), 7), axis=0)


def _straight_ways(room: shapely.Geometry, points: Array) -> npt.NDArray[np.bool_]:
    """Whether (M, M) the straight way between two points stays within the room."""
    count = len(points)
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    ways = shapely.linestrings(np.stack([points[i.ravel()], points[j.ravel()]], axis=1))
    return np.asarray(shapely.covers(room.buffer(1e-5), ways)).reshape(count, count)

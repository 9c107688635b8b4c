"""Holes along a part's z axis, the insertion pose of a peg in one, and its clearance."""

from __future__ import annotations

import itertools
from bisect import bisect_left
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
import torch
import trimesh
from scipy.optimize import minimize_scalar
from shapely.affinity import rotate, translate

from bcppl import poses
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.layers import cross_section
from bcppl.geometry.outlines import check_fit
from bcppl.geometry.parts import Part

_LEVEL = 1e-5  # m: vertices closer in height than this lie on one level
_LEAST = 0.0005  # m: smallest extent of a hole for a peg
_WIDER = 1e-5  # m by which a chamfered section is wider, at least
_TURNS = 720  # yaws of the grid search
_OUT = 2e-6  # m by which a peg as wide as its hole protrudes by rounding
_SLIVER = 1e-12  # m^2: a triangle of a peg's mesh that covers less is of an upright wall


@dataclass(frozen=True, eq=False)
class Hole:
    """A hole in a part's top.

    Attributes:
        part_from_hole: (7,) its frame: origin at the centroid of its outline in the plane of the part's top,
            z out of the material, x and y the part's.
        outline: its narrowest cross section down to its end, in its frame, metres.
        depth: of its end below the top, metres.
        chamfer: depth of the part of it that is wider than its outline, metres.
        through: whether it is a through hole.
    """

    part_from_hole: Array
    outline: shapely.Polygon
    depth: float
    chamfer: float
    through: bool


def hole_of(part: Part, inside: tuple[float, float] | None = None, peg: Part | None = None) -> Hole:
    """The hole in a part's top, from cross sections of its mesh between the levels of its vertices.

    Args:
        part: its z axis points out of its top. Of a hole whose walls are not parallel to z, below its
            chamfer, what is left straight down counts.
        inside: (x, y) of a point in the hole, down to its end, metres in the part's frame; needed where there
            are several.
        peg: that is to go in: the hole ends where the peg no longer fits, at a drill's point or at the floor
            of a counterbore. Without one, or with one that does not fit at all, it ends where it is closed.

    Raises:
        InputError: there is no hole in the top, none around the point, or there are several and no point is
            given.
    """
    levels = _levels(part)
    layers = list(itertools.pairwise(levels))
    sections = (_rings(part, 0.5 * (a + b)) for a, b in layers)
    top = next(sections, [])
    if not top:
        raise InputError(
            f"part {part.name!r} has no hole in its top; give a part with a hole along its z axis, or turn "
            "it with `Part.moved` until the hole points up."
        )
    first = top
    if inside is not None:
        try:
            x, y = (float(each) for each in inside)
        except (TypeError, ValueError):
            raise InputError(
                f"a hole is to be around {inside!r}; give x and y of a point inside one, metres."
            ) from None
        inside = x, y
        first = [ring for ring in top if ring.contains(shapely.Point(inside))]
        if not first:
            raise InputError(f"part {part.name!r} has no hole around {inside} m; give a point inside one.")
    if len(first) > 1:
        raise InputError(
            f"part {part.name!r} has {len(first)} holes in its top, at {_places(first)} m; choose one with "
            "`inside`."
        )
    middle = _middle(first[0]) if inside is None else shapely.Point(inside)

    def along(rings: list[shapely.Polygon]) -> Hole:
        """The hole of a ring in each of the first sections, down to the lower end of the last."""
        least, count = min(ring.area + _WIDER * ring.length for ring in rings), len(rings)
        narrowest = next(k for k, ring in enumerate(rings) if ring.area <= least)
        ring = _room(part, rings[narrowest], layers[narrowest:count])
        centre = np.array([ring.centroid.x, ring.centroid.y, levels[0]])
        return Hole(
            np.concatenate([centre, [1.0, 0.0, 0.0, 0.0]]),
            translate(ring, -centre[0], -centre[1]),
            levels[0] - levels[count],
            levels[0] - levels[narrowest],
            count == len(layers),
        )

    rings: list[shapely.Polygon] = []
    for section in itertools.chain([top], sections):
        around = [ring for ring in section if ring.contains(middle)]
        if not around and rings and peg is not None and inside is None:
            # In the floor of a counterbore, beside its middle.
            below = [ring for ring in section if rings[-1].contains(ring.representative_point())]
            around = [ring for ring in below if _takes(along([*rings, ring]), peg)]
            if len(around) > 1:
                raise InputError(
                    f"part {part.name!r} has {len(around)} holes below its top that take the peg, at "
                    f"{_places(around)} m; choose one with `inside`."
                )
            middle = _middle(around[0]) if around else middle
        if not around:
            break
        rings.append(around[0])
    counts = range(1, len(rings) + 1)
    taking = 0 if peg is None else bisect_left(counts, True, key=lambda n: not _takes(along(rings[:n]), peg))
    return along(rings[: taking or len(rings)])


class Fit(NamedTuple):
    """The insertion pose (7,), the peg's tip in the plane of the part's top, and the clearance in metres.

    The clearance is of the diameter, or between opposite flats.
    """

    hole_from_peg: Array
    clearance: float


def fit_in(hole: Hole, peg: Part) -> Fit:
    """The insertion pose of a peg and its clearance; of several yaws that fit, the smallest.

    The hole has to take all of the peg that goes in: its lowest part, as long as the hole is deep.

    Raises:
        InputError: the peg fits at no yaw, or has no lower end.
    """
    low = float(peg.vertices[:, 2].min())
    outline = lowest_outline(peg, hole.depth)
    held = np.array([outline.centroid.x, outline.centroid.y])
    centred = translate(outline, *-held)

    # Offset inwards to the peg's width, so that only the pose in the middle of the play fits.
    play = max((hole.outline.area - centred.area) / hole.outline.length, 0.0)
    narrowed = hole.outline.buffer(-play, join_style="mitre", mitre_limit=100.0)

    def turned(yaw: float) -> shapely.Polygon:
        return rotate(centred, yaw, origin=(0.0, 0.0), use_radians=True)

    def beyond(yaw: float) -> float:
        """The area (m^2) of the peg outside the hole."""
        return float(turned(yaw).difference(narrowed).area)

    yaw, nothing = 0.0, _OUT * float(centred.length)
    if beyond(0.0) > nothing:
        step = 2.0 * np.pi / _TURNS
        yaws = sorted((k * step for k in range(-_TURNS // 2, _TURNS // 2)), key=abs)
        areas = np.array([beyond(yaw) for yaw in yaws])
        yaw = yaws[int(np.flatnonzero(areas <= 1.5 * areas.min() + nothing)[0])]
        yaw = float(minimize_scalar(beyond, bounds=(yaw - step, yaw + step), method="bounded").x)
    try:
        clearance = check_fit(hole.outline, turned(yaw))
    except InputError as error:
        raise InputError(f"peg {peg.name!r} does not fit the hole: {error}") from None
    rotation = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)])
    shift = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ held
    return Fit(np.concatenate([-shift, [-low], rotation]), clearance)


def _middle(ring: shapely.Polygon) -> shapely.Point:
    """A point inside a ring: its centroid, which of one that is bent may lie outside."""
    return ring.centroid if ring.contains(ring.centroid) else ring.representative_point()


def _places(rings: list[shapely.Polygon]) -> str:
    return ", ".join(f"({p.centroid.x:.4f}, {p.centroid.y:.4f})" for p in rings)


def _room(part: Part, ring: shapely.Polygon, layers: list[tuple[float, float]]) -> shapely.Polygon:
    """What a hole of a ring leaves straight down some layers whose walls lean; the ring where none does."""
    room, (bottom, top) = ring, _leaning(part, ring)
    for high, low in layers:
        if not ((bottom < high - _LEVEL) & (top > low + _LEVEL)).any():
            continue
        for height in (high - _LEVEL, low + _LEVEL):
            ends = [end for end in _rings(part, height) if end.intersects(room)]
            narrower = [room.intersection(end) for end in ends]
            if narrower and min(each.area for each in narrower) < room.area - _WIDER * room.length:
                room = max(shapely.get_parts(min(narrower, key=lambda each: each.area)), key=shapely.area)
    return room if isinstance(room, shapely.Polygon) and not room.is_empty else ring


def _leaning(part: Part, ring: shapely.Polygon) -> tuple[Array, Array]:
    """The lowest and the highest z (K,) of faces about a ring that lean more than coordinates are rounded."""
    lean = np.ptp(part.mesh.triangles[..., 2], axis=1) * np.abs(part.mesh.face_normals[:, 2])
    leaning = part.mesh.triangles[lean > 0.5 * _WIDER]
    lowest, highest = leaning.min(axis=1), leaning.max(axis=1)
    about = (highest[:, :2] > ring.bounds[:2]) & (lowest[:, :2] < ring.bounds[2:])
    return lowest[about.all(axis=1), 2], highest[about.all(axis=1), 2]


def _takes(hole: Hole, peg: Part) -> bool:
    try:
        fit_in(hole, peg)
    except InputError:
        return False
    return True


def lowest_outline(peg: Part, length: float) -> shapely.Polygon:
    """The outline of a peg's lowest part of a length (m), in its x-y plane: the union of its sections."""
    top = float(peg.vertices[:, 2].min()) + length - _LEVEL  # a collar that rests on the part is not of it
    lowest = trimesh.intersections.slice_mesh_plane(peg.mesh, [0.0, 0.0, -1.0], [0.0, 0.0, top])
    triangles = shapely.polygons(lowest.triangles[..., :2])
    pieces = shapely.get_parts(shapely.union_all(triangles[shapely.area(triangles) > _SLIVER]))
    if not len(pieces):
        raise InputError(f"peg {peg.name!r} has no lower end; give a closed mesh, its tip at the lowest z.")
    return shapely.Polygon(max(pieces, key=shapely.area).exterior)


def depth_reached(hole: Hole, peg: Part, part_from_peg: Array) -> Array:
    """The depth (...) of a peg's tip below the plane of the part's top at poses (..., 7), metres."""
    tip = torch.tensor([[0.0, 0.0, float(peg.vertices[:, 2].min())]], dtype=torch.float64)
    there = poses.transform(torch.as_tensor(part_from_peg), tip)[..., 0, :]
    return np.asarray(hole.part_from_hole[2] - there[..., 2].numpy())


def lateral_error(hole: Hole, peg: Part, part_from_peg: Array) -> Array:
    """The distance (...) of a peg's tip from the hole's axis beyond the clearance, at poses (..., 7), metres.

    It is 0 for an upright peg in its hole; depth alone does not distinguish a peg in the hole from one beside
    the part.

    Raises:
        InputError: the peg does not fit.
    """
    fit = fit_in(hole, peg)
    tip = poses.inverse(torch.from_numpy(fit.hole_from_peg))[None, :3]
    there = poses.transform(torch.as_tensor(part_from_peg), tip)[..., 0, :2].numpy()
    off = np.linalg.norm(there - hole.part_from_hole[:2], axis=-1)
    return np.asarray(np.maximum(off - fit.clearance, 0.0))


def _levels(part: Part) -> Array:
    """The heights of a mesh's vertices, the highest first, metres."""
    heights = np.sort(part.vertices[:, 2])[::-1]
    return heights[np.concatenate([[True], np.diff(heights) < -_LEVEL])]


def _rings(part: Part, height: float) -> list[shapely.Polygon]:
    """The holes of a cross section, in the part's x-y plane."""
    rings = [shapely.Polygon(ring) for cut in _cut(part, height) for ring in cut.interiors]
    return [ring for ring in rings if min(np.ptp(shapely.get_coordinates(ring), axis=0)) > _LEAST]


def _cut(part: Part, height: float) -> list[shapely.Polygon]:
    """The polygons of a cross section, the largest first."""
    return sorted(cross_section(part.mesh, height), key=lambda p: -p.area)

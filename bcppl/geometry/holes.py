"""Where a part has a hole along its z axis, and how a peg stands in it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import shapely
import torch
from scipy.optimize import minimize_scalar
from shapely.affinity import rotate, translate

from bcppl import poses
from bcppl.errors import InputError
from bcppl.geometry.outlines import check_fit
from bcppl.geometry.parts import Part

Array = npt.NDArray[np.float64]

_LEVEL = 1e-5  # m: corners nearer in height than this are of one level
_LEAST = 0.0005  # m across: what is smaller is no hole for a peg
_WIDER = 1e-5  # m by which a section is wider where a chamfer is
_TURNS = 720  # yaws that are tried
_OUT = 2e-6  # m by which a peg as wide as its hole stands out of it by rounding


@dataclass(frozen=True, eq=False)
class Hole:
    """A hole in a part's top.

    Attributes:
        part_from_hole: (7,) its frame: origin at the middle of its outline in the plane of the part's top, z
            out of the material, x and y the part's.
        outline: where it is narrowest, in its frame, metres.
        depth: below the top, metres.
        chamfer: how far below the top it is wider than that, metres.
        through: whether it has no bottom.
    """

    part_from_hole: Array
    outline: shapely.Polygon
    depth: float
    chamfer: float
    through: bool


def hole_of(part: Part, inside: tuple[float, float] | None = None) -> Hole:
    """The hole in a part's top, from sections of its mesh between the levels at which it has corners.

    Args:
        part: its z axis points out of its top; the walls of its hole are parallel to it, but for a chamfer.
        inside: (x, y) in the part's frame of a point in the hole; needed where there are several.

    Raises:
        InputError: there is no hole in the top, none around the point, or there are several and no point is
            given.
    """
    levels = _levels(part)
    found = [_rings(part, 0.5 * (a + b)) for a, b in itertools.pairwise(levels)]
    if not found or not found[0]:
        raise InputError(
            f"part {part.name!r} has no hole in its top; give a part with a hole along its z axis, or turn "
            "it with `Part.moved` until the hole points up."
        )
    first = found[0]
    if inside is not None:
        first = [ring for ring in first if ring.contains(shapely.Point(inside))]
        if not first:
            raise InputError(f"part {part.name!r} has no hole around {inside} m; give a point inside one.")
    if len(first) > 1:
        places = ", ".join(f"({p.centroid.x:.4f}, {p.centroid.y:.4f})" for p in first)
        raise InputError(
            f"part {part.name!r} has {len(first)} holes in its top, at {places} m; say which with `inside`."
        )
    middle, rings = first[0].centroid, []
    for each in found:
        around = [ring for ring in each if ring.contains(middle)]
        if not around:
            break
        rings.append(around[0])
    least = min(ring.area + _WIDER * ring.length for ring in rings)
    narrowest = next(k for k, ring in enumerate(rings) if ring.area <= least)
    ring, top = rings[narrowest], levels[0]
    centre = np.array([ring.centroid.x, ring.centroid.y, top])
    return Hole(
        np.concatenate([centre, [1.0, 0.0, 0.0, 0.0]]),
        translate(ring, -centre[0], -centre[1]),
        top - levels[len(rings)],
        top - levels[narrowest],
        len(rings) == len(found),
    )


def hole_from_peg(hole: Hole, peg: Part) -> Array:
    """How a peg stands in a hole, its tip in the plane of the part's top: (7,).

    Where it fits in several ways the one that turns it least.

    Raises:
        InputError: the peg fits in no way.
    """
    low = float(peg.vertices[:, 2].min())
    outline = _cut(peg, low + 0.1 * float(peg.extent[2]))[0]
    held = np.array([outline.centroid.x, outline.centroid.y])
    centred = translate(outline, *-held)

    # As wide as the peg, so that it fits in the middle of its play and nowhere else.
    gap = max((hole.outline.area - centred.area) / hole.outline.length, 0.0)
    narrowed = hole.outline.buffer(-gap, join_style="mitre", mitre_limit=100.0)

    def beyond(yaw: float) -> float:
        """The area (m^2) that stands out."""
        return float(rotate(centred, yaw, origin=(0.0, 0.0), use_radians=True).difference(narrowed).area)

    yaw, nothing = 0.0, _OUT * float(centred.length)
    if beyond(0.0) > nothing:
        step = 2.0 * np.pi / _TURNS
        tried = sorted((k * step for k in range(-_TURNS // 2, _TURNS // 2)), key=abs)
        areas = np.array([beyond(yaw) for yaw in tried])
        yaw = tried[int(np.flatnonzero(areas <= 1.5 * areas.min() + nothing)[0])]
        yaw = float(minimize_scalar(beyond, bounds=(yaw - step, yaw + step), method="bounded").x)
    turned = rotate(centred, yaw, origin=(0.0, 0.0), use_radians=True)
    try:
        check_fit(hole.outline, turned)
    except InputError as error:
        raise InputError(f"peg {peg.name!r} does not fit the hole: {error}") from None
    turn = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)])
    shift = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ held
    return np.concatenate([-shift, [-low], turn])


def clearance_in(hole: Hole, peg: Part) -> float:
    """The clearance (m) that a peg has in a hole, of the diameter or of opposite flats.

    Raises:
        InputError: the peg does not fit.
    """
    pose = hole_from_peg(hole, peg)
    outline = _cut(peg, float(peg.vertices[:, 2].min()) + 0.1 * float(peg.extent[2]))[0]
    yaw = 2.0 * np.arctan2(pose[6], pose[3])
    turned = rotate(outline, yaw, origin=(0.0, 0.0), use_radians=True)
    return check_fit(hole.outline, translate(turned, *pose[:2]))


def depth_reached(hole: Hole, peg: Part, part_from_peg: Array) -> Array:
    """How deep (...) the lowest end of a peg is below the plane of the part's top, metres.

    Args:
        hole: in the part.
        peg: what is held.
        part_from_peg: (..., 7).
    """
    tip = torch.tensor([[0.0, 0.0, float(peg.vertices[:, 2].min())]], dtype=torch.float64)
    there = poses.transform(torch.as_tensor(part_from_peg), tip)[..., 0, :]
    return np.asarray(hole.part_from_hole[2] - there[..., 2].numpy())


def aside_of(hole: Hole, peg: Part, part_from_peg: Array) -> Array:
    """How far (...) a peg's tip is from the hole's axis, beyond what its clearance leaves it, metres.

    It is 0 for a peg in its hole, but for what a tilt adds; depth alone does not tell a peg in a hole from
    one beside the part.

    Args:
        hole: in the part.
        peg: what is held.
        part_from_peg: (..., 7).

    Raises:
        InputError: the peg does not fit.
    """
    stands = torch.from_numpy(hole_from_peg(hole, peg))
    tip = poses.inverse(stands)[None, :3]
    there = poses.transform(torch.as_tensor(part_from_peg), tip)[..., 0, :2].numpy()
    off = np.linalg.norm(there - hole.part_from_hole[:2], axis=-1)
    return np.asarray(np.maximum(off - clearance_in(hole, peg), 0.0))


def _levels(part: Part) -> Array:
    """The heights at which a mesh has corners, the highest first, metres."""
    heights = np.sort(part.vertices[:, 2])[::-1]
    return heights[np.concatenate([[True], np.diff(heights) < -_LEVEL])]


def _rings(part: Part, height: float) -> list[shapely.Polygon]:
    """The holes of a section, in the part's x-y plane."""
    rings = [shapely.Polygon(ring) for cut in _cut(part, height) for ring in cut.interiors]
    return [ring for ring in rings if min(np.ptp(shapely.get_coordinates(ring), axis=0)) > _LEAST]


def _cut(part: Part, height: float) -> list[shapely.Polygon]:
    """A section of the mesh at a height, the largest polygon first, in the part's x-y plane."""
    path = part.mesh.section(plane_origin=[0.0, 0.0, height], plane_normal=[0.0, 0.0, 1.0])
    if path is None:
        return []
    planar, _ = path.to_2D(to_2D=np.eye(4))
    return sorted((p.buffer(0.0) for p in planar.polygons_full), key=lambda p: -p.area)

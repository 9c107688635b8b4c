"""Parts that no shipped world holds, a peg, and the places on a part at which a plan touches it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely
import trimesh
from shapely.affinity import translate

from bcppl.arrays import Array
from bcppl.geometry.extrusion import extruded
from bcppl.geometry.layers import prismatic
from bcppl.geometry.outlines import round_outline
from bcppl.geometry.parts import Part, Piece

SIDES = 32  # of a round hole and of the peg
LENGTH, BEVEL = 0.09, 0.0004  # m: of the peg from the wrench sensor to the tip, and of its tip's edge
JITTER = 0.002  # m, of a place along its face
DEEP = 0.006  # m, of a side's places below the face above it


class Place(NamedTuple):
    """A point on a part's surface and its outward normal, both (3,) in the part's frame."""

    point: Array
    normal: Array


@dataclass(frozen=True, eq=False)
class ForeignPart:
    """A part and the places at which it is touched.

    Attributes:
        part: mesh and convex pieces; its highest face is at z = 0.
        top, long, short, more: places on upward faces, on a long side, on a side across it, and on others.
    """

    part: Part
    top: tuple[Place, ...]
    long: tuple[Place, ...]
    short: tuple[Place, ...]
    more: tuple[Place, ...]

    def places(self, count: int, generator: np.random.Generator) -> list[Place]:
        """Places in 3-2-1 order, then others up to a count; each is moved at random along its face."""
        groups = [(self.top, 3), (self.long, 2), (self.short, 1)]
        chosen = [g[k] for g, most in groups for k in generator.permutation(len(g))[:most]]
        chosen += [self.more[k] for k in generator.permutation(len(self.more))]
        return [_moved(place, generator.uniform(-JITTER, JITTER, 3)) for place in chosen[:count]]


def _moved(place: Place, by: Array) -> Place:
    along = by - place.normal * (by @ place.normal)
    if place.normal[2] == 0.0:
        along[2] = 0.0
    return Place(place.point + along, place.normal)


def _places(normal: str, *points: tuple[float, ...]) -> tuple[Place, ...]:
    """Places on faces of one normal ("+x"), their points in millimetres."""
    direction = np.zeros(3)
    direction["xyz".index(normal[1])] = 1.0 if normal[0] == "+" else -1.0
    return tuple(Place(1e-3 * np.array(point, dtype=float), direction) for point in points)


def l_block() -> ForeignPart:
    """An L-shaped block, 70 by 60 by 24 mm, with a round hole of 12 mm in its longer leg."""
    corners = [(0, 0), (70, 0), (70, 28), (28, 28), (28, 60), (0, 60)]
    outline = shapely.Polygon([(1e-3 * x - 0.03, 1e-3 * y - 0.025) for x, y in corners])
    outline = outline.difference(translate(round_outline(0.012, SIDES), 0.006, -0.011))
    side = -1e3 * DEEP
    return ForeignPart(
        extruded("L-shaped block with a hole", outline, -0.024, 0.0),
        _places("+z", (-18, -13, 0), (-16, 24, 0), (29, -11, 0)),
        _places("-y", (-18, -25, side), (8, -25, side), (32, -25, side)),
        _places("-x", (-30, -12, side), (-30, 22, side)),
        _places("+x", (40, -11, side)) + _places("+y", (-16, 35, side)),
    )


def slotted_plate() -> ForeignPart:
    """A plate, 80 by 56 by 14 mm, with a slot of 30 by 9 mm off its middle."""
    middle = shapely.LineString([(-0.0025, 0.006), (0.0185, 0.006)])
    outline = shapely.box(-0.04, -0.028, 0.04, 0.028).difference(middle.buffer(0.0045, quad_segs=8))
    side = -1e3 * DEEP
    return ForeignPart(
        extruded("plate with a slot", outline, -0.014, 0.0),
        _places("+z", (-30, -18, 0), (30, -18, 0), (-29, 19, 0), (31, 19, 0)),
        _places("-y", (-29, -28, side), (0, -28, side), (28, -28, side)),
        _places("-x", (-40, -12, side), (-40, 10, side)),
        _places("+x", (40, -6, side)) + _places("+y", (8, 28, side)),
    )


def stepped_block() -> ForeignPart:
    """A block, 66 by 50 by 26 mm, 10 mm lower at one end, with a round hole of 14 mm at the other."""
    solids = [
        trimesh.creation.box(bounds=[[-0.033, -0.025, -0.026], [0.033, 0.025, -0.010]]),
        trimesh.creation.box(bounds=[[-0.033, -0.025, -0.020], [0.005, 0.025, 0.0]]),
    ]
    bore = trimesh.creation.extrude_polygon(translate(round_outline(0.014, SIDES), -0.014, 0.003), 0.06)
    bore.apply_translation([0.0, 0.0, -0.04])
    mesh = trimesh.boolean.difference([trimesh.boolean.union(solids), bore])
    part = Part("stepped block with a hole", np.asarray(mesh.vertices, float), np.asarray(mesh.faces))
    deep = -1e3 * DEEP
    return ForeignPart(
        replace(prismatic(part), name=part.name),
        _places("+z", (-25, -16, 0), (-25, 18, 0), (21, 10, -10), (21, -12, -10)),
        _places("-y", (-24, -25, deep), (-8, -25, deep), (24, -25, deep - 10)),
        _places("-x", (-33, -14, deep), (-33, 12, deep)),
        _places("+x", (33, -8, deep - 10)) + _places("+y", (-8, 25, deep)),
    )


PARTS = {"L-shaped": l_block, "slotted": slotted_plate, "stepped": stepped_block}


def peg(radius: float) -> Part:
    """A round peg, its tip's edge bevelled; its origin at the wrench sensor, z away from the tip."""
    angles = 2.0 * np.pi * (np.arange(SIDES) + 0.5) / SIDES
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    levels = [(radius - BEVEL, -LENGTH), (radius, -LENGTH + BEVEL), (radius, 0.0)]
    points = np.concatenate([np.column_stack([r * ring, np.full(SIDES, z)]) for r, z in levels])
    hull = trimesh.convex.convex_hull(points)
    vertices = np.asarray(hull.vertices, dtype=np.float64)
    faces = np.asarray(hull.faces, dtype=np.int64)
    return Part("bevelled round peg", vertices, faces, (Piece("hull", vertices),), "drawn for a benchmark")

"""Holes and pegs that are not prisms: drilled, stepped, conical, chamfered; and how deep a peg goes in."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import shapely
import trimesh

from bcppl.errors import InputError
from bcppl.geometry.extrusion import block_with_hole, peg_for
from bcppl.geometry.holes import fit_in, hole_of
from bcppl.geometry.layers import cross_section
from bcppl.geometry.outlines import round_outline
from bcppl.geometry.parts import Part

RADIUS = 0.005
SIDES = 64


def turned(name: str, *profile: tuple[float, float]) -> Part:
    """The solid of revolution of a profile of radii and heights, metres."""
    mesh = trimesh.creation.revolve(np.array(profile), sections=SIDES)
    mesh.merge_vertices()
    mesh.fix_normals()
    part = Part(name, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    part.check()
    return part


def drilled(*bottom: tuple[float, float]) -> Part:
    """A disc, 30 mm high, with a hole of 10 mm whose bottom has a profile."""
    lowest = (bottom[0][0], -0.03) if bottom[0][0] > 0.0 else (0.0, -0.03)
    closing = (bottom[0],) if bottom[0][0] > 0.0 else ()
    return turned("disc", *bottom, (RADIUS, 0.0), (0.03, 0.0), (0.03, -0.03), lowest, *closing)


@functools.cache
def pin(diameter: float) -> Part:
    return peg_for(round_outline(diameter), 0.0002, 0.08, f"pin for {1000.0 * diameter:g} mm")


def coned(shank: float, length: float, tip: float = 0.0, whole: float = 0.08) -> Part:
    """A peg whose shank (m) narrows over the lowest length (m) of it to the diameter of its tip (m)."""
    flat = ((0.5 * tip, -whole),) if tip else ()
    return turned("cone", (0.0, -whole), *flat, (0.5 * shank, length - whole), (0.5 * shank, 0.0), (0.0, 0.0))


def test_a_drilled_hole_ends_where_its_point_begins() -> None:
    point = RADIUS / math.tan(math.radians(59.0))
    part = drilled((0.0, -0.015 - point), (RADIUS, -0.015))
    hole = hole_of(part, peg=pin(0.010))
    assert hole.depth == pytest.approx(0.015) and hole.chamfer == 0.0 and not hole.through
    assert fit_in(hole, pin(0.010)).clearance == pytest.approx(0.0002, abs=2e-5)


def test_a_counterbore_is_a_hole_for_a_wide_peg_and_a_chamfer_for_a_narrow_one() -> None:
    part = drilled((0.003, -0.03), (0.003, -0.008), (RADIUS, -0.008))
    wide, narrow = hole_of(part, peg=pin(0.010)), hole_of(part, peg=pin(0.006))
    assert wide.depth == pytest.approx(0.008) and not wide.through
    assert narrow.depth == pytest.approx(0.03) and narrow.chamfer == pytest.approx(0.008) and narrow.through
    for hole, peg in ((wide, pin(0.010)), (narrow, pin(0.006))):
        assert fit_in(hole, peg).clearance == pytest.approx(0.0002, abs=2e-5)
    with pytest.raises(InputError, match="does not fit the hole"):
        fit_in(hole_of(part, peg=pin(0.014)), pin(0.014))


def bored(*tools: trimesh.Trimesh) -> Part:
    """A block, 30 mm high, without some solids."""
    box = trimesh.creation.box((0.08, 0.06, 0.03))
    box.apply_translation((0.0, 0.0, -0.015))
    mesh = trimesh.boolean.difference([box, *tools])
    part = Part("bored block", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    part.check()
    return part


def straight(x: float, diameter: float, depth: float, angle: float = 0.0) -> trimesh.Trimesh:
    """A drill of a diameter and a depth below the top, at an angle (rad) to the part's z axis."""
    tool = trimesh.creation.cylinder(0.5 * diameter, 2.0 * depth, sections=SIDES)
    tool.apply_transform(trimesh.transformations.rotation_matrix(angle, [0.0, 1.0, 0.0]))
    tool.apply_translation((x, 0.0, 0.0))
    return tool


def test_of_holes_in_the_floor_of_a_wider_one_the_point_chooses_as_deep_as_it_goes() -> None:
    part = bored(straight(0.0, 0.05, 0.006), straight(-0.015, 0.01, 0.04), straight(0.015, 0.01, 0.04))
    for x in (-0.015, 0.015):
        hole = hole_of(part, (x, 0.001), pin(0.010))
        assert hole.part_from_hole[0] == pytest.approx(x, abs=1e-5) and hole.through
    with pytest.raises(InputError, match="2 holes below its top that take the peg"):
        hole_of(part, peg=pin(0.010))
    assert hole_of(part, (0.0, 0.0), pin(0.010)).depth == pytest.approx(0.006)
    assert hole_of(part, peg=pin(0.05)).depth == pytest.approx(0.006)


def test_a_hole_beside_the_middle_of_its_counterbore_is_the_one_that_takes_the_peg() -> None:
    part = bored(straight(0.0, 0.03, 0.006), straight(0.009, 0.008, 0.04))
    hole = hole_of(part, peg=pin(0.008))
    assert hole.part_from_hole[0] == pytest.approx(0.009, abs=1e-5)
    assert hole.through and hole.chamfer == pytest.approx(0.006)


def test_of_walls_that_lean_what_is_left_straight_down_counts() -> None:
    narrowing = turned("cone", (0.0, -0.0301), (0.004, -0.0301), (0.005, 1e-5), (0.0, 1e-5)).mesh
    for tool in (narrowing, straight(0.0, 0.01, 0.06, math.radians(10.0))):
        part = bored(tool)
        with pytest.raises(InputError, match="does not fit the hole"):
            fit_in(hole_of(part, peg=pin(0.0095)), pin(0.0095))
    assert fit_in(hole_of(bored(narrowing), peg=pin(0.0079)), pin(0.0079)).clearance > 0.0


@pytest.mark.parametrize("length", [0.003, 0.015])
def test_a_peg_with_a_cone_is_as_wide_as_what_goes_in(length: float) -> None:
    part = block_with_hole(round_outline(2.0 * RADIUS), (0.06, 0.06, 0.025))
    hole = hole_of(part)
    assert fit_in(hole, coned(0.0098, length)).clearance == pytest.approx(0.0002, abs=2e-5)
    with pytest.raises(InputError, match="does not fit the hole"):
        fit_in(hole, coned(0.014, length))
    # What stays above the part is not asked for: this one is 8 mm wide where the hole ends, 14 mm at its top.
    assert fit_in(hole, coned(0.014, 0.075, tip=0.005)).clearance == pytest.approx(0.002, abs=1e-4)


def test_the_middle_of_a_bent_hole_may_lie_outside_it() -> None:
    corners = [(0, 0), (0.02, 0), (0.02, 0.004), (0.004, 0.004), (0.004, 0.02), (0, 0.02)]
    hole = hole_of(block_with_hole(shapely.Polygon(corners)))
    assert hole.through and hole.outline.area == pytest.approx(shapely.Polygon(corners).area)


def test_a_cross_section_has_the_solid_s_area_also_at_vertices_and_of_a_mesh_of_single_triangles() -> None:
    mesh = bored(straight(0.0, 0.03, 0.006), straight(0.009, 0.008, 0.04)).mesh
    corners = np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    single = trimesh.Trimesh(mesh.triangles.reshape(-1, 3), corners, process=False)
    wide, narrow = (SIDES / 8.0 * d**2 * math.sin(2.0 * math.pi / SIDES) for d in (0.03, 0.008))
    floor = float(mesh.vertices[mesh.vertices[:, 2] < -0.005, 2].max())
    for height, hole in ((-0.003, wide), (floor, narrow), (-0.010, narrow)):
        for each in (mesh, single):
            area = sum(polygon.area for polygon in cross_section(each, height))
            assert area == pytest.approx(0.08 * 0.06 - hole, rel=1e-6)
    assert cross_section(mesh, 0.001) == []
    tilt = trimesh.transformations.rotation_matrix(0.7, [0.3, 1.0, 0.2])
    for each in (mesh, single):
        each.apply_transform(tilt)
    expected = mesh.section(plane_normal=[0.0, 0.0, 1.0], plane_origin=[0.0, 0.0, 0.004])
    expected, _ = expected.to_2D()
    area = sum(polygon.area for polygon in cross_section(single, 0.004))
    assert area == pytest.approx(expected.area, rel=1e-6)

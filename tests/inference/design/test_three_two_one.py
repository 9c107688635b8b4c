"""What 3-2-1 and other planned touches keep clear of, on parts, pegs and beliefs of all kinds."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch
import trimesh
from shapely.affinity import translate

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.contact.physics import PegPhysics
from bcppl.errors import InputError
from bcppl.geometry.extrusion import (
    block,
    block_with_hole,
    block_with_square_hole,
    box_peg,
    extruded,
    round_peg,
)
from bcppl.geometry.gap import PegGap
from bcppl.geometry.holes import hole_of
from bcppl.geometry.outlines import round_outline
from bcppl.geometry.parts import Part, Piece
from bcppl.inference.planning.candidate_layout import plan_candidates
from bcppl.inference.planning.constraints import feasible, require_candidates
from bcppl.inference.planning.insertion import insertion_plan
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.motion_constraints import collision_free, force_at_most
from bcppl.inference.planning.motions import expected_contacts
from bcppl.inference.planning.success import success_probability
from bcppl.inference.planning.touching import SurfacePoint, pair, slide

NAN = float("nan")


@pytest.mark.parametrize("axis", range(6))
def test_a_stroke_begins_beside_the_part_and_ends_in_it_wherever_it_may_be(axis: int) -> None:
    part, peg = block_with_square_hole((0.12, 0.08, 0.025)), round_peg(0.004, 0.08)
    normal = torch.linspace(-2.8, 2.8, 401, dtype=torch.float64)  # within three standard deviations
    away = torch.zeros(401, 6, dtype=torch.float64)
    away[:, axis] = (0.0025 if axis < 3 else 0.03) * normal
    world_from_part = poses.retract(poses.identity(), away)
    plan = three_two_one(Belief(world_from_part, -0.5 * normal**2), part, peg)
    strokes = [k for k, manner in enumerate(plan.manners) if manner == "guarded"]
    ends = torch.from_numpy(plan.world_from_peg[[*strokes, *(k + 1 for k in strokes)]])
    begun, ended = PegGap(part, peg)(world_from_part, ends).distance.split(len(strokes), dim=1)
    assert begun.min() > -2e-4 and ended.max() < 2e-4  # the edge of a turned peg is ahead of its tip


def near(count: int = 60, rot: float = 1e-3) -> Belief:
    """A belief about the identity of .3 mm, whose rotations have a standard deviation (rad)."""
    torch.manual_seed(0)
    spread = torch.tensor([3e-4] * 3 + [rot] * 3, dtype=torch.float64)
    around = poses.retract(poses.identity(), spread * torch.randn(count, 6, dtype=torch.float64))
    return Belief(around, torch.zeros(count, dtype=torch.float64))


def united(*solids: trimesh.Trimesh) -> Part:
    mesh = trimesh.boolean.union(solids)
    hulls = [Piece("hull", np.asarray(each.vertices, dtype=np.float64)) for each in solids]
    return Part("united", np.asarray(mesh.vertices), np.asarray(mesh.faces), hulls)


def test_sides_under_an_overhang_are_not_touched_through_it() -> None:
    plate, stem = trimesh.creation.box((0.06, 0.06, 0.008)), trimesh.creation.box((0.04, 0.04, 0.0321))
    plate.apply_translation((0.0, 0.0, -0.004))
    stem.apply_translation((0.0, 0.0, -0.02395))
    mushroom, peg, belief = united(plate, stem), box_peg(0.01, 0.08), near()
    plan = three_two_one(belief, mushroom, peg)
    require_candidates(feasible([plan], [collision_free(PegGap(mushroom, peg), belief.mean)]))
    thin = trimesh.creation.box((0.06, 0.06, 0.002))
    thin.apply_translation((0.0, 0.0, -0.001))
    stem.apply_translation((0.0, 0.0, 0.007))
    with pytest.raises(InputError, match="under an overhang"):
        three_two_one(belief, united(thin, stem), peg)


def test_two_sides_are_never_parallel() -> None:
    corners = [(0.0, 0.0), (0.1, 0.0), (0.15, 0.05), (0.05, 0.05)]
    plan = three_two_one(
        near(), extruded("slanted", shapely.Polygon(corners), -0.02, 0.0), box_peg(0.01, 0.08)
    )
    one, other = (heading[:2] for _, heading in expected_contacts(plan)[1:])
    assert abs(float(one @ other)) < 0.8


def test_a_collar_far_above_the_tip_does_not_keep_it_from_the_sides() -> None:
    shank, collar = (trimesh.creation.cylinder(r, h, sections=48) for r, h in ((0.005, 0.08), (0.015, 0.02)))
    shank.apply_translation((0.0, 0.0, -0.04))
    collar.apply_translation((0.0, 0.0, -0.01))
    peg, part, belief = united(shank, collar), block((0.08, 0.06, 0.03)), near()
    plan = three_two_one(belief, part, peg)
    ends = [k + 1 for k, manner in enumerate(plan.manners) if manner == "guarded"]
    gaps = PegGap(part, peg)(belief.world_from_part, torch.from_numpy(plan.world_from_peg[ends]))
    assert bool((gaps.distance < 0.0).all())


def test_what_three_two_one_cannot_keep_is_stated() -> None:
    part, peg = block((0.3, 0.2, 0.05)), box_peg(0.015, 0.08)
    with pytest.warns(RuntimeWarning, match="farther away than half a stroke"):
        three_two_one(near(200, 0.1), part, peg)
    yaw = torch.zeros(80, 6, dtype=torch.float64)
    yaw[40:, 5] = 1.5
    halves = Belief(poses.retract(near(80).world_from_part, yaw), torch.zeros(80, dtype=torch.float64))
    with pytest.warns(RuntimeWarning, match="several modes, the heaviest with 50 %"):
        three_two_one(halves, block((0.06, 0.06, 0.025)), peg)
    turn = torch.tensor([0.0, 0.0, 0.0, math.pi, 0.0, 0.0], dtype=torch.float64)
    with pytest.raises(InputError, match="faces down"):
        three_two_one(
            Belief(poses.retract(near().world_from_part, turn), torch.zeros(60).double()), part, peg
        )


def test_a_slide_stays_on_the_surface_and_a_normal_is_of_unit_length() -> None:
    part, peg = block((0.06, 0.06, 0.025)), box_peg(0.01, 0.08)
    listed = slide(near(), part, peg, ((0, 0, 0), (0, 0, 1)), [0.01, 0, 0], lean=[0.0, 0.0, 0.1])  # type: ignore
    assert np.isfinite(listed.world_from_peg).all()
    with pytest.raises(InputError, match="give a list of them"):
        plan_candidates(near(), part, peg, constraints=force_at_most(5.0))  # type: ignore[arg-type]
    for normal, displacement, words in (
        ([0.0, 0.0, 1.0], [0.01, 0.0, -0.05], "leaves the surface"),
        ([0.0, 0.0, 1.0], [NAN, 0.0, 0.0], "leaves the surface"),
        ([0.0, 0.0, 5.0], [0.01, 0.0, 0.0], "give a unit vector"),
        ([0.0, 0.0, 0.0], [0.01, 0.0, 0.0], "give a unit vector"),
    ):
        point = SurfacePoint(np.zeros(3), np.array(normal))
        with pytest.raises(InputError, match=words):
            slide(near(), part, peg, point, np.array(displacement))
        with pytest.raises(InputError, match="give a unit vector"):
            pair(near(), part, peg, SurfacePoint(np.zeros(3), np.zeros(3)), point)


def test_a_peg_in_the_neighbouring_hole_is_not_inserted() -> None:
    holes = [translate(round_outline(0.00105), x) for x in (-0.0006, 0.0006)]
    plate = extruded(
        "plate", shapely.box(-0.01, -0.01, 0.01, 0.01).difference(shapely.union_all(holes)), -0.006, 0.0
    )
    peg, belief = round_peg(0.0005, 0.03), near(rot=1e-4)
    hole = hole_of(plate, (0.0006, 0.0), peg)
    sharp = Belief(
        poses.retract(poses.identity(8), torch.full((8, 6), 1e-6).double()), belief.log_weights[:8]
    )
    plan = insertion_plan(sharp, plate, peg, hole)
    beside = sharp.world_from_part.clone()
    beside[:, 0] += 0.0012
    physics = PegPhysics(plate, peg)
    for poses_of_part, expected in ((sharp.world_from_part, 1.0), (beside, 0.0)):
        chance = success_probability(
            Belief(poses_of_part, sharp.log_weights), plan, physics, hole, particles=4
        )
        assert (chance.success, chance.hole_found) == (expected, expected)


def test_the_descent_to_a_hole_stops_above_the_rim_of_a_part_that_may_lean() -> None:
    part, peg = block_with_hole(round_outline(0.0302), (0.1, 0.1, 0.025)), round_peg(0.015, 0.08)
    torch.manual_seed(0)
    spread = torch.tensor([1e-4] * 3 + [0.05, 0.05, 0.0], dtype=torch.float64)
    around = poses.retract(poses.identity(), spread * torch.randn(200, 6, dtype=torch.float64))
    search = insertion_plan(Belief(around, torch.zeros(200).double()), part, peg).search
    landing = torch.from_numpy(search.world_from_peg[[search.manners.index("guarded")]])
    assert float((PegGap(part, peg)(around, landing).distance < 0.0).double().mean()) < 0.02

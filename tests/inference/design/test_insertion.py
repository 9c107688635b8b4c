"""Insertion: the hole of a mesh, the plan, its execution, and the predicted success probability."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import shapely
import shapely.affinity
import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.contact.physics import PegPhysics
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, block_with_hole, extruded, peg_for
from bcppl.geometry.holes import Hole, fit_in, hole_of
from bcppl.geometry.outlines import rectangular_outline, round_outline
from bcppl.geometry.parts import Part
from bcppl.inference.planning.insertion import InsertionParameters, insertion_plan
from bcppl.inference.planning.success import success_probability
from bcppl.inference.resampling import systematic
from bcppl.models.worlds.bench.parts import PARTS, PEG_LENGTH, bench_part
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.robot.commands import command_of, stamps_of
from bcppl.robot.plan import InsertionPlan


def believed(
    scene: BenchScene, seed: int, shift: float, turn: float, off: tuple[float, ...] | None = None
) -> Belief:
    """A belief after a probe: 40 particles about a mean with an error like theirs (or `off`), at the hole."""
    generator = np.random.default_rng(seed)
    spread = torch.tensor([shift] * 3 + [turn] * 3, dtype=torch.float64)
    hole = torch.from_numpy(scene.kind.part_from_hole)
    error = torch.from_numpy(generator.normal(size=6)) * spread
    if off is not None:
        error = torch.tensor(off, dtype=torch.float64)
    mean = poses.retract(poses.compose(torch.from_numpy(scene.truth), hole), error)
    holes = poses.retract(mean.expand(40, 7), torch.from_numpy(generator.normal(size=(40, 6))) * spread)
    world_from_part = poses.compose(holes, poses.inverse(hole).expand(40, 7))
    return Belief(world_from_part, torch.zeros(40, dtype=torch.float64))


@functools.cache
def tight(part: str = "square 8 mm", seed: int = 3) -> BenchScene:
    return bench_scene(seed, part=part, clearance=0.0001)


@functools.cache
def touched(part: str = "square 8 mm") -> Belief:
    return believed(tight(part), 3, 0.0001, np.radians(0.1))


def plan_of(part: str = "square 8 mm") -> InsertionPlan:
    return insertion_plan(touched(part), tight(part).part, tight(part).peg)


@pytest.mark.parametrize("name", PARTS)
def test_the_hole_of_a_mesh_is_the_one_that_was_drawn(name: str) -> None:
    kind = bench_part(name)
    hole = hole_of(kind.part)
    stands = fit_in(hole, kind.peg(0.0001)).hole_from_peg
    # Where the peg stands in the part is what counts; the two frames of a D differ in where its middle is.
    place = poses.compose(torch.from_numpy(hole.part_from_hole), torch.from_numpy(stands))
    drawn = kind.part_from_hole.copy()
    drawn[2] += PEG_LENGTH
    np.testing.assert_allclose(place.numpy(), drawn, atol=5e-6)
    assert hole.depth == pytest.approx(kind.depth, abs=1e-6)
    tray = "tray" in name
    assert hole.chamfer == pytest.approx(0.001 if tray else 0.0, abs=1e-6) and hole.through == (not tray)
    assert fit_in(hole, kind.peg(0.0002)).clearance == pytest.approx(0.0002, abs=1e-5)


def test_a_peg_that_is_held_turned_and_aside_is_turned_into_the_hole() -> None:
    kind = bench_part("D 10 mm")
    hole, peg = hole_of(kind.part), kind.peg(0.0002)
    yaw = np.radians(77.3)
    held = np.array([0.003, -0.002, 0.0, np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)])
    stands = torch.from_numpy(fit_in(hole, peg.moved(held)).hole_from_peg)
    back = poses.local(
        torch.from_numpy(fit_in(hole, peg).hole_from_peg), poses.compose(stands, torch.from_numpy(held))
    )
    assert float(back[:3].norm()) < 1e-5 and float(back[3:].norm()) < np.radians(0.1)


def test_a_plan_follows_the_axis_and_its_search_covers_the_belief_with_the_clearance_as_pitch() -> None:
    scene, plan = tight(), plan_of()
    under = poses.inverse(torch.from_numpy(plan.world_from_hole))
    tips = poses.transform(
        torch.from_numpy(plan.search.world_from_peg), torch.tensor([[0.0, 0.0, -PEG_LENGTH]]).double()
    )[:, 0]
    inside = poses.transform(under, tips).numpy()
    searching = 1 + np.flatnonzero(np.array(plan.search.manners) == "searching")
    before = inside[: searching[0]]
    assert np.abs(before[:, :2]).max() < 1e-5 and (np.diff(before[:, 2]) < 1e-9).all()
    assert np.ptp(inside[searching, 2]) < 1e-9 and inside[searching[0], 2] < -plan.search.sink
    # Where the particles have the hole, the way passes it within half of the clearance for nine in ten.
    hole = torch.from_numpy(scene.kind.part_from_hole)
    holes = poses.compose(touched().world_from_part, hole.expand(40, 7))
    places = shapely.points(poses.transform(under, holes[:, :3])[:, :2].numpy())
    way = shapely.LineString(inside[searching, :2])
    assert np.mean(shapely.distance(places, way) < 0.5 * scene.clearance) > 0.9
    # A belief twice as wide is searched with nearly twice the rounds: the clearance sets the pitch.
    wide = insertion_plan(believed(scene, 3, 0.0002, np.radians(0.1)), scene.part, scene.peg)
    assert 1.5 < wide.search.manners.count("searching") / plan.search.manners.count("searching") < 2.1


@pytest.mark.long
@pytest.mark.parametrize("part", ["rectangular tray", "square 8 mm", "hexagon 12 mm"])
def test_a_peg_with_a_tenth_of_clearance_goes_in_as_predicted(part: str) -> None:
    scene, plan = tight(part), plan_of(part)
    result = scene.insert(plan)
    assert result.inserted and result.depth > 0.02 and result.sustained_force < 10.0
    assert result.found_at <= plan.search.times[-1] and result.time < 8.0
    if part == "square 8 mm":
        assert scene.insert(plan) == result
        chance = success_probability(touched(part), plan, PegPhysics(scene.part, scene.peg), particles=8)
        assert chance.success > 0.7 and chance.success <= chance.hole_found


def test_the_search_finds_the_hole() -> None:
    """Off by 0.3 mm the same plan goes in with its spiral, and does not where the spiral is but a point."""
    scene = tight()
    off = believed(scene, 1, 0.0002, 0.0005, off=(0.0003, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert scene.insert(insertion_plan(off, scene.part, scene.peg)).inserted
    blind = insertion_plan(
        off, scene.part, scene.peg, parameters=InsertionParameters(maximum_radius=0.0001, search_time=1.0)
    )
    result = scene.insert(blind)
    assert not result.inserted and np.isnan(result.found_at) and result.depth < 0.001
    assert result.sustained_force < 30.0


@pytest.mark.long
def test_the_success_probability_is_the_arms_and_rises_with_clearance_and_precision() -> None:
    chances = []
    for clearance, shift in ((0.0001, 0.0004), (0.001, 0.001), (0.001, 0.0002)):
        scene = bench_scene(3, part="square 8 mm", clearance=clearance)
        belief = believed(scene, 3, shift, np.radians(0.3))
        plan = insertion_plan(belief, scene.part, scene.peg, parameters=InsertionParameters(search_time=2.0))
        count = 4 if chances else 8
        chances.append(success_probability(belief, plan, PegPhysics(scene.part, scene.peg), particles=count))
        if len(chances) == 1:
            # Pegs that find nothing are pushed as well, and some slip over the chamfer into the hole.
            torch.manual_seed(0)
            drawn = systematic(belief.log_weights, 8)
            arms = [replace(scene, truth=t.numpy()) for t in belief.world_from_part[drawn]]
            inserted = float(np.mean([arm.insert(plan).inserted for arm in arms]))
            assert 0.3 < inserted < 0.8 and chances[0].success == pytest.approx(inserted, abs=0.26)
    assert chances[0].success < chances[2].success > 0.9
    assert chances[0].hole_found < chances[1].hole_found <= chances[2].hole_found
    elsewhere = belief.world_from_part.clone()
    elsewhere[:, 0] += 0.015
    away = Belief(elsewhere, belief.log_weights)
    assert success_probability(away, plan, PegPhysics(scene.part, scene.peg), particles=4).success == 0.0
    # A peg that sinks beside the part has found no hole.
    elsewhere[:, 0] += 0.5
    away = Belief(elsewhere, belief.log_weights)
    beside = success_probability(away, plan, PegPhysics(scene.part, scene.peg), particles=4)
    assert beside.success == 0.0 and beside.hole_found == 0.0


def test_a_search_that_has_found_its_hole_skips_the_rest() -> None:
    scene, plan = tight(), plan_of()
    whole = scene.execute(plan.search)[0]
    (stopped,) = [t for k, t in whole.stops.items() if plan.search.manners[k] == "searching"]
    after = whole.probe.command[whole.probe.command_times > stopped + 0.05]
    assert np.ptp(after, axis=0).max() < 1e-9
    led = command_of(plan.search, {}).command
    assert np.abs(led[-1] - after[-1])[:3].max() > 1e-5


def _no_hole() -> Part:
    return block((0.05, 0.05, 0.02), "brick")


def _two_holes() -> Part:
    hole = rectangular_outline(0.008, 0.008)
    rings = [shapely.affinity.translate(hole, x, 0.1 * x).exterior for x in (-0.012, 0.012)]
    return extruded("plate", shapely.Polygon(rectangular_outline(0.06, 0.04).exterior, rings), -0.02, 0.0)


def test_one_of_several_holes_is_the_one_around_the_point() -> None:
    hole = hole_of(_two_holes(), inside=(0.011, 0.001))
    np.testing.assert_allclose(hole.part_from_hole[:3], [0.012, 0.0012, 0.0], atol=1e-9)


def test_impossible_insertions_are_refused_in_one_sentence() -> None:
    scene, plan = tight(), plan_of()
    hole: Hole = hole_of(scene.part)
    with pytest.raises(InputError, match="'brick' has no hole in its top"):
        hole_of(_no_hole())
    with pytest.raises(InputError, match="has 2 holes in its top"):
        hole_of(_two_holes())
    with pytest.raises(InputError, match="no hole around"):
        hole_of(_two_holes(), inside=(0.0, 0.0))
    with pytest.raises(InputError, match="does not fit the hole"):
        fit_in(hole, bench_part("round 16 mm").peg(0.0001))
    with pytest.raises(InputError, match="the insertion has press_depth 0"):
        insertion_plan(touched(), scene.part, scene.peg, parameters=InsertionParameters(press_depth=0.0))
    with pytest.raises(InputError, match=r"search_stiffness .*; give six numbers"):
        insertion_plan(
            touched(), scene.part, scene.peg, parameters=InsertionParameters(search_stiffness=(4000.0, 150.0))
        )
    with pytest.raises(InputError, match="search_stiffness with 0"):
        insertion_plan(
            touched(), scene.part, scene.peg, parameters=InsertionParameters(search_stiffness=(0.0,) * 6)
        )
    with pytest.raises(InputError, match="searches until the peg has sunk by 0 m"):
        replace(plan.search, sink=0.0)
    with pytest.raises(InputError, match="has no searching motion"):
        replace(plan, search=plan.push)
    with pytest.raises(InputError, match="success of an insertion is to be simulated for 0 particles"):
        success_probability(touched(), plan, PegPhysics(scene.part, scene.peg), particles=0)


def _plate(outline: shapely.Polygon) -> Part:
    return block_with_hole(outline, (0.06, 0.06, 0.025))


def _about(pose: tuple[float, ...], spread: tuple[float, ...], count: int = 400) -> torch.Tensor:
    """Poses (N, 7) about one, with standard deviations (6,) in its tangent space."""
    away = torch.randn(count, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return poses.retract(poses.as_pose(pose).expand(count, 7), away * torch.tensor(spread).double())


def _belief(world_from_part: torch.Tensor) -> Belief:
    return Belief(world_from_part, torch.zeros(len(world_from_part), dtype=torch.float64))


FLAT = (0.5, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0)


@pytest.mark.long
@pytest.mark.parametrize("clearance", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("spread", [(1e-3, 5e-5), (1e-3, 1e-3), (3e-4, 1e-4), (0.0, 0.0)])
def test_a_search_keeps_its_speed_its_turns_and_its_time(
    clearance: float, spread: tuple[float, float]
) -> None:
    outline, parameters = round_outline(0.010), InsertionParameters()
    belief = _belief(_about(FLAT, (*spread, 0.0, 0.0, 0.0, 0.0)))
    search = insertion_plan(belief, _plate(outline), peg_for(outline, clearance, 0.08)).search
    searching = np.array(search.manners) == "searching"
    spans, path = np.diff(search.times), search.world_from_peg[:, :2]
    speeds = np.linalg.norm(np.diff(path, axis=0), axis=1) / spans
    assert speeds[searching].max() < parameters.search_speed * (1.0 + 1e-9)
    assert spans[searching].sum() < parameters.search_time + 1e-9
    away = path[1:][searching] - path[:-1][searching][0]
    axes = np.linalg.eigh(np.cov(away.T))[1]
    turned = np.unwrap(np.arctan2(*(away @ axes).T))
    assert abs(np.diff(turned)).sum() / (2.0 * np.pi) < parameters.maximum_turns * parameters.search_time
    if clearance > 1e-5 and min(spread) < 1e-3:  # the rest is too much for the time
        places = shapely.points((belief.world_from_part[:, :2]).numpy())
        near = shapely.distance(places, shapely.LineString(path[:-1][searching])) < 0.5 * clearance
        assert near.mean() > 0.95


def test_of_two_modes_the_heavier_one_is_tried_and_succeeds() -> None:
    outline = round_outline(0.010)
    part, peg = _plate(outline), peg_for(outline, 0.0005, 0.08)
    spread = (5e-5, 5e-5, 5e-5, 1e-3, 1e-3, 1e-3)
    both = torch.cat([_about(FLAT, spread, 70), _about((0.516, *FLAT[1:]), spread, 30)])
    belief = _belief(both)
    plan = insertion_plan(belief, part, peg)
    assert np.abs(plan.world_from_hole[:2] - [0.5, 0.0]).max() < 1e-4
    assert success_probability(belief, plan, PegPhysics(part, peg), particles=4).success >= 0.5


@pytest.mark.parametrize("depth", [0.0008, 0.0015, 0.025])
def test_a_search_ends_in_a_shallow_hole_too(depth: float) -> None:
    outline = round_outline(0.010)
    part, peg = _plate(outline), peg_for(outline, 0.0003, 0.08)
    hole = replace(hole_of(part), depth=depth, through=False)
    assert 0.0 < insertion_plan(_belief(_about(FLAT, (0.0,) * 6, 4)), part, peg, hole).search.sink < depth


def test_without_any_contact_nothing_is_pushed() -> None:
    scene, plan = tight(), plan_of()
    gone = scene.truth + np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    result = replace(scene, truth=gone).insert(plan)
    assert not result.inserted and np.isnan(result.found_at) and result.peak_force < 1.0
    assert result.time == pytest.approx(len(stamps_of(plan.search)) / plan.search.rate)

"""Candidates make contact where they are planned to, and constraints exclude the infeasible ones."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.errors import InputError
from bcppl.geometry.gap import PegGap
from bcppl.inference.design.rules import surface_variance
from bcppl.inference.planning.candidate_layout import plan_candidates
from bcppl.inference.planning.constraints import Candidates, Constraint, feasible, require_candidates
from bcppl.inference.planning.motion_constraints import (
    above_table,
    approach_within,
    collision_free,
    contact_at_mid_stroke,
    force_at_most,
    not_from_below,
    within_reach,
)
from bcppl.inference.planning.motions import expected_contacts, pressing_force
from bcppl.inference.planning.touching import SurfacePoint, TouchParameters, face_name, slide, touch
from bcppl.models.robots import load_robot
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.robot.arm_with_peg import ArmWithPeg
from bcppl.robot.inverse_kinematics import joint_paths
from bcppl.robot.plan import Plan
from bcppl.sensors import View
from bcppl.sensors.candidates import name_of
from tests.made_recordings import assert_one_sentence

KINDS = {"touch": 4, "slide": 2, "pair": 2, "search": 1, "attempt": 1, "view": 2}
UP = np.array([0.0, 0.0, 1.0])


def about(scene: BenchScene, spread: float) -> Belief:
    """A belief about the truth, of so many metres and twenty times as many radians."""
    torch.manual_seed(scene.seed)
    away = spread * torch.randn(40, 6, dtype=torch.float64) * torch.tensor([1.0] * 3 + [5.0] * 3)
    return Belief(
        poses.retract(torch.from_numpy(scene.truth), away - away.mean(dim=0)),
        torch.zeros(40, dtype=torch.float64),
    )


@functools.cache
def planned(seed: int) -> tuple[BenchScene, PegGap, Candidates]:
    scene = bench_scene(seed)
    gap = PegGap(scene.part, scene.peg)
    found = plan_candidates(
        about(scene, 0.001), scene.part, scene.peg, KINDS, gap=gap, like=[View(scene.cameras[0])]
    )
    return scene, gap, found


@pytest.mark.long
@pytest.mark.parametrize("seed", [5, 7])  # blocks with a square and a D-shaped hole
def test_candidates_touch_the_faces_in_their_names_and_nothing_on_their_way(seed: int) -> None:
    scene, gap, found = planned(seed)
    truth = torch.from_numpy(scene.truth)[None]
    names = [name_of(c) for c in found]
    assert len(set(names)) == len(names) == sum(KINDS.values())
    for plan in found:
        if not isinstance(plan, Plan) or plan.name.split()[0] not in ("touch", "slide", "pair"):
            continue
        execution, wrench, world_from_peg = scene.execute(plan)
        force = np.linalg.norm(wrench[:, :3] - wrench[:10, :3].mean(axis=0), axis=1)
        met = gap(truth, torch.from_numpy(world_from_peg))
        strokes = [k for k, manner in enumerate(plan.manners) if manner == "guarded"]
        assert sorted(execution.stops) == strokes, plan.name
        faces = plan.name.split(": ")[1].split(", ")
        for k, face in zip(strokes, faces, strict=True):
            stamps = execution.probe.stamps
            until = (stamps >= plan.times[k]) & (stamps < execution.stops[k])
            before = (stamps > (plan.times[k - 1] if k > 1 else 0.0)) & (stamps < plan.times[k] - 0.1)
            pressed = (stamps > execution.stops[k]) & (stamps < plan.times[k + 3]) & (force > 3.0)
            assert until.any() and force[before].max(initial=0.0) < 3.0, plan.name
            # Half of the stroke is over where the mean has the surface, which here is the truth.
            assert abs(execution.stops[k] - 0.5 * (plan.times[k] + plan.times[k + 1])) < 0.12
            normals = met.normal[0, pressed].numpy()
            along = expected_contacts(plan)[strokes.index(k)][1]
            outward = -poses.rotation_matrix(truth[0]).numpy().T @ along
            assert face_name(outward) == face
            assert np.median(normals @ outward) > 0.95, (plan.name, np.median(normals @ outward))


def test_a_slide_stays_on_its_face_and_an_attempt_ends_in_the_hole() -> None:
    scene, gap, found = planned(5)
    truth = torch.from_numpy(scene.truth)[None]
    hole = poses.compose(truth[0], torch.from_numpy(scene.kind.part_from_hole))
    tip = torch.tensor([[0.0, 0.0, -0.08]], dtype=torch.float64)
    for plan in found:
        if not isinstance(plan, Plan) or plan.name.startswith(("touch", "pair")):
            continue
        _, wrench, world_from_peg = scene.execute(plan)
        force = np.linalg.norm(wrench[:, :3] - wrench[:10, :3].mean(axis=0), axis=1)
        if plan.name.startswith("slide"):
            pressed = world_from_peg[force > 1.5]
            assert gap(truth, torch.from_numpy(pressed)).distance.abs().median() < 1e-4
            assert np.linalg.norm(np.ptp(pressed[:, :3], axis=0)) > 0.010
        else:  # aimed at the mean, with one millimetre of clearance
            lowest = poses.transform(torch.from_numpy(world_from_peg), tip)[:, 0]
            depth = -poses.transform(poses.inverse(hole), lowest)[:, 2]
            assert float(depth.max()) > 0.003, plan.name


def test_views_show_the_whole_part() -> None:
    scene, _, found = planned(5)
    views = [c for c in found if isinstance(c, View)]
    assert len({v.camera.name for v in views}) == 2
    corners = poses.transform(torch.from_numpy(scene.truth), torch.from_numpy(scene.part.vertices))
    for view in views:
        seen = poses.transform(poses.inverse(view.camera.stated_pose()), corners)
        pixels = view.camera.project(seen.numpy())
        assert ((pixels > 0) & (pixels < [view.camera.width, view.camera.height])).all()


def test_the_same_seed_plans_the_same_and_strokes_grow_with_the_spread() -> None:
    scene, gap, _ = planned(5)
    kinds, belief = {"touch": 4, "slide": 2}, about(scene, 0.001)
    first, again, other = (
        plan_candidates(belief, scene.part, scene.peg, kinds, gap=gap, seed=seed) for seed in (1, 1, 2)
    )
    assert all(np.array_equal(a.world_from_peg, b.world_from_peg) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0].world_from_peg, other[0].world_from_peg)
    spot, lengths = SurfacePoint(np.zeros(3), UP), []
    for spread in (0.0001, 0.002, 0.02):
        plan = touch(about(scene, spread), scene.part, scene.peg, spot)
        lengths.append(np.linalg.norm(plan.world_from_peg[3, :3] - plan.world_from_peg[2, :3]))
    assert lengths[0] == pytest.approx(0.006) and lengths[2] == pytest.approx(0.028)
    assert lengths[0] < lengths[1] < lengths[2]


def test_constraints_count_the_candidates_that_violate_them() -> None:
    scene, gap, _ = planned(5)
    belief = about(scene, 0.001)
    top, side = (
        SurfacePoint(np.array([-0.02, -0.02, 0.0]), UP),
        SurfacePoint(np.array([0.03, 0.0, -0.01]), np.eye(3)[0]),
    )
    bottom = SurfacePoint(np.array([0.0, 0.0, -0.025]), -UP)
    inside = SurfacePoint(np.array([0.0114, 0.005, -0.01]), -np.eye(3)[0])  # the hole's own wall, from within
    plans = [
        touch(belief, scene.part, scene.peg, spot, name=name)
        for name, spot in (("top", top), ("side", side), ("bottom", bottom), ("inside", inside))
    ]
    down = (0.0, 0.0, -1.0)

    def left(*filters: object) -> list[str]:
        return [name_of(c) for c in feasible(plans, filters)]  # type: ignore[arg-type]

    assert left(approach_within(down, math.radians(30.0))) == ["top"]
    assert left(approach_within(down, math.radians(120.0))) == ["top", "side", "inside"]
    assert set(left(collision_free(gap, scene.truth))) == {"top", "side"}
    assert "inside" not in left(collision_free(gap, scene.truth), contact_at_mid_stroke(gap, scene.truth))
    lowest = scene.truth[2] - 0.012 + 0.005
    assert left(above_table(scene.peg, lowest)) == ["top"]
    hard = dataclasses.replace(plans[0], name="hard", force=20.0)
    assert pressing_force(plans[0]) == pytest.approx(4.0 + 2500.0 * 0.0015, rel=0.01)
    found = feasible([*plans, hard], [force_at_most(10.0), approach_within(down, 0.5, "come from aside")])
    assert found.excluded == {"press with more than 10 N": 1, "come from aside": 3}
    assert str(found) == "1 candidate; excluded those that press with more than 10 N (1), come from aside (3)"
    with pytest.raises(InputError, match=r'of a function of one candidate make one by per_candidate\("are'):
        left(lambda plan: True)


@pytest.mark.long
def test_candidates_out_of_an_arms_reach_are_excluded() -> None:
    arm = load_robot("panda", tip="panda_hand_tcp")
    held = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])  # the hand's z axis points down, the peg's up
    scene, _, _ = planned(5)
    plan = touch(about(scene, 0.001), scene.part, scene.peg, SurfacePoint(np.array([-0.02, -0.02, 0.0]), UP))
    far = dataclasses.replace(plan, name="far", world_from_peg=plan.world_from_peg + np.eye(7)[0])
    here = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    found = feasible([plan, far], [within_reach(ArmWithPeg(arm, "panda_hand_tcp", held, here))])
    assert [c.name for c in found] == [plan.name]
    assert found.excluded == {"are out of panda's reach": 1}
    angles = joint_paths(arm, "panda_hand_tcp", plan.world_from_peg[None], held)[0]
    reached = arm.base_from_link("panda_hand_tcp", angles, link_from_tool=held)
    assert poses.local(torch.from_numpy(plan.world_from_peg), reached).abs().max() < 0.01
    limits = np.array([[joint.lower, joint.upper] for joint in arm.joints])
    assert (angles >= limits[:, 0] - 1e-9).all() and (angles <= limits[:, 1] + 1e-9).all()
    with pytest.raises(
        InputError, match=r"none of 1 candidate is feasible: they are out of panda's reach \(1\)"
    ) as caught:
        require_candidates(feasible([far], [within_reach(ArmWithPeg(arm, "panda_hand_tcp", held, here))]))
    assert_one_sentence(str(caught.value))


def test_reach_is_asked_for_between_the_ends_of_a_motion() -> None:
    """The arm reaches either side of its base, and not the way between them, through the base."""
    arm = load_robot("panda", tip="panda_hand_tcp")
    held, here = np.eye(7)[4], np.eye(7)[3]
    reach = within_reach(ArmWithPeg(arm, "panda_hand_tcp", held, here))
    knots = here + np.array([[-0.1, -0.45, 0.3], [-0.1, 0.45, 0.3]]) @ np.eye(3, 7)

    def plan(poses: np.ndarray) -> Plan:
        return Plan("across", [0.0, 4.0], poses, ("free",), 4.0, np.full(6, 100.0), np.full(6, 10.0))

    assert reach.satisfied([plan(knots), *(plan(knots[[k, k]]) for k in (0, 1))]) == [False, True, True]


def test_no_hand_comes_from_below() -> None:
    """Of a part upside down the sides can be touched, but only by a hand that is under it."""
    scene, _, _ = planned(5)
    spot, turns = SurfacePoint(np.array([0.03, 0.0, -0.01]), np.eye(3)[0]), {}
    for name, degrees in (("upright", 0.0), ("on its side", 90.0), ("upside down", 180.0)):
        turn = torch.tensor([0.0, 0.0, 0.0, math.radians(degrees), 0.0, 0.0], dtype=torch.float64)
        level = about(scene, 0.001)
        mean = torch.tensor([0.5, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        around = poses.retract(mean.expand(40, 7), poses.local(level.mean, level.world_from_part))
        belief = Belief(poses.retract(around, turn), level.log_weights)
        turns[name] = touch(belief, scene.part, scene.peg, spot, name=name)
    found = feasible(list(turns.values()), [not_from_below()])
    assert [name_of(one) for one in found] == ["upright", "on its side"]
    assert found.excluded == {"come from below": 1}


def test_the_largest_variance_is_of_the_surface_along_the_stroke() -> None:
    scene, _, _ = planned(5)
    torch.manual_seed(0)
    away = torch.zeros(400, 6, dtype=torch.float64)
    turned = poses.rotation_matrix(torch.from_numpy(scene.truth))
    away[:, :3] = torch.randn(400, 3).double() * 0.003 @ torch.diag(torch.tensor([1.0, 0.1, 0.1])).double()
    away[:, :3] = away[:, :3] @ turned.T  # along the part's x axis
    belief = Belief(poses.retract(torch.from_numpy(scene.truth), away), torch.zeros(400).double())
    spots = [np.eye(3)[0], np.eye(3)[1], UP]
    plans = [touch(belief, scene.part, scene.peg, SurfacePoint(0.025 * n, n)) for n in spots]
    found = [math.sqrt(surface_variance(belief, scene.peg, plan)) for plan in plans]
    np.testing.assert_allclose(found, [0.003, 0.0003, 0.0003], rtol=0.15)


def test_bad_input_is_refused_in_a_sentence() -> None:
    scene, gap, _ = planned(5)
    belief = about(scene, 0.001)
    point = Belief(belief.world_from_part[:1].expand(5, 7), torch.zeros(5, dtype=torch.float64))
    nothing = Belief(belief.world_from_part, torch.full((40,), -torch.inf, dtype=torch.float64))
    unknown = Belief(belief.world_from_part, torch.full((40,), torch.nan, dtype=torch.float64))
    calls = {
        "there are no candidates": lambda: require_candidates(feasible([], [])),
        "no candidates of kind 'poke'": lambda: plan_candidates(belief, scene.part, scene.peg, {"poke": 1}),
        "collapsed to a point": lambda: plan_candidates(point, scene.part, scene.peg),
        "has no weight": lambda: plan_candidates(nothing, scene.part, scene.peg),
        "weight that is no number": lambda: plan_candidates(unknown, scene.part, scene.peg),
        "give a number of each": lambda: plan_candidates(belief, scene.part, scene.peg, ["touch"]),  # type: ignore[arg-type]
        "probably in millimetres": lambda: plan_candidates(
            belief,
            scene.part,
            dataclasses.replace(scene.peg, vertices=1000.0 * scene.peg.vertices),
            {"touch": 1},
        ),
        "no peg to touch the part": lambda: plan_candidates(belief, scene.part, None, {"touch": 1}),
        "approach at more than": lambda: plan_candidates(
            belief,
            scene.part,
            scene.peg,
            {"touch": 2},
            gap=gap,
            constraints=[approach_within((0, 0, 1.0), 0.1)],
        ),
        "candidates that are dull gives no boolean for each": lambda: feasible(
            planned(5)[2], [Constraint("are dull", lambda found: [True])]
        ),
    }
    for message, call in calls.items():
        with pytest.raises(InputError, match=message) as caught:
            call()
        assert_one_sentence(str(caught.value))
    for message in (
        ["no"] * len(planned(5)[2]),
        [math.nan] * len(planned(5)[2]),
        torch.tensor(True),
        [[True]],
    ):
        with pytest.raises(InputError, match="gives no boolean for each"):
            feasible(planned(5)[2], [Constraint("are dull", lambda found, message=message: message)])  # type: ignore[misc]
    with pytest.raises(InputError, match=r"a touch has press_depth 1\.5"):
        touch(belief, scene.part, scene.peg, SurfacePoint(np.zeros(3), UP), TouchParameters(press_depth=1.5))


def test_motions_held_before_contact_are_constrained_as_well() -> None:
    scene, gap, _ = planned(5)
    plan = touch(about(scene, 0.001), scene.part, scene.peg, SurfacePoint(np.array([-0.02, -0.02, 0.0]), UP))
    through = plan.world_from_peg.copy()
    through[3:5, 2] -= 0.05
    manners = tuple("held" if manner == "guarded" else manner for manner in plan.manners)
    held = dataclasses.replace(plan, world_from_peg=through, manners=manners)
    assert pressing_force(held) > 100.0
    for each in (force_at_most(10.0), collision_free(gap, scene.truth)):
        assert list(feasible([plan, held], [each])) == [plan]


def test_a_slide_goes_as_far_as_it_is_asked_to() -> None:
    scene, _, _ = planned(5)
    way = np.array([0.0, 0.01, 0.0])
    plan = slide(
        about(scene, 0.001), scene.part, scene.peg, SurfacePoint(np.array([-0.02, -0.02, 0.0]), UP), way
    )
    led = plan.world_from_peg[6, :3] - plan.world_from_peg[5, :3]
    turned = poses.rotation_matrix(torch.from_numpy(plan.world_from_peg[0])).numpy()
    np.testing.assert_allclose(led, turned @ way, atol=1e-12)

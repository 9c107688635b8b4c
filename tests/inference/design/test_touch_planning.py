"""Faces, plans, contact signals, and metrology's 3-2-1 executed on the bench."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest
import shapely
import torch
import trimesh

from bcppl import poses
from bcppl.beliefs import Belief
from bcppl.contact.sensing.contact_detection import ContactDetector
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, block_with_square_hole, box_peg, extruded, round_peg
from bcppl.geometry.gap import PegGap
from bcppl.geometry.parts import Part
from bcppl.inference.planning.faces import boundary_points, points_on_top, section, sides
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.metrology_parameters import ROCKED, MetrologyParameters
from bcppl.inference.planning.motions import expected_contacts
from bcppl.inference.planning.touching import SurfacePoint, touch
from bcppl.models.parts import insert_peg, insert_tray
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.models.worlds.guarded_motion import Execution
from bcppl.robot.plan import Plan
from tests.made_recordings import assert_one_sentence

NAN = float("nan")

# ---------------------------------------------------------------- faces


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.007, 0.005), (-0.008, 0.004)])
def test_points_on_top_and_the_ways_between_them_keep_their_margins(offset: tuple[float, float]) -> None:
    part, peg, margin = block_with_square_hole(hole=0.0105, offset=offset), round_peg(0.005, 0.08), 0.004
    spots, lifted = points_on_top(part, peg, margin)
    assert not lifted
    way = shapely.LineString(spots)
    hole = shapely.box(-0.00525, -0.00525, 0.00525, 0.00525)
    outline = shapely.box(-0.03, -0.03, 0.03, 0.03)
    assert spots.shape == (3, 2) and outline.contains(way)
    assert way.distance(outline.exterior) > 0.005 + margin - 2e-5
    assert way.distance(shapely.affinity.translate(hole, *offset)) > 0.005 + 0.002 - 2e-4
    area = 0.5 * abs(np.linalg.det(spots[1:] - spots[0]))
    assert area > 0.4 * (0.06 - 2 * 0.009) ** 2  # of a square's corners any three span half of it


def test_on_a_narrow_rim_the_peg_is_lifted_to_the_third_point() -> None:
    part, peg = insert_tray("rectangular"), insert_peg("rectangular")
    spots, lifted = points_on_top(part, peg, 0.003)
    assert lifted
    assert 0.5 * abs(np.linalg.det(spots[1:] - spots[0])) > 80e-6  # slides alone reach 12 mm2
    belief = Belief(poses.identity(8), torch.full((8,), 0.125, dtype=torch.float64))
    plan = three_two_one(belief, part, peg)
    top = float(part.vertices[:, 2].max())
    tips = plan.world_from_peg[:, :3] + [0.0, 0.0, float(peg.vertices[:, 2].min())]
    met = [k for k, manner in enumerate(plan.manners, start=1) if manner == "guarded" and tips[k, 2] < top]
    above = [k for k, tip in enumerate(tips) if tip[2] > top and np.isclose(tip[:2], spots[2]).all()]
    assert met[1] - met[0] > 2 and above[0] < met[1] < above[-1]
    np.testing.assert_allclose(tips[met[1], :2], spots[2], atol=1e-9)
    assert plan.times[-1] == pytest.approx(6.0, abs=1e-6)


def test_sides_of_a_block_are_its_four_faces() -> None:
    part = block_with_square_hole((0.06, 0.04, 0.025))
    borders = sides(part, -0.01)
    assert [round(side.length, 6) for side in borders] == [0.06, 0.06, 0.04, 0.04]
    for side in borders:
        middle = 0.5 * (side.start + side.stop)
        np.testing.assert_allclose(side.normal, middle / np.linalg.norm(middle), atol=1e-9)
    normals = {tuple(np.round(side.normal).astype(int)) for side in borders}
    assert normals == {(1, 0), (-1, 0), (0, 1), (0, -1)}
    assert section(part, -0.01).area == pytest.approx(0.06 * 0.04 - 0.0165**2, rel=1e-6)


def test_a_top_without_room_and_a_height_outside_are_refused() -> None:
    part = block((0.01, 0.01, 0.02))
    for call in (lambda: points_on_top(part, round_peg(0.012, 0.05), 0.004), lambda: section(part, 0.5)):
        with pytest.raises(InputError) as caught:
            call()
        assert_one_sentence(str(caught.value))


# ---------------------------------------------------------------- plans


def plan_of(**changed: Any) -> Plan:
    given = {
        "name": "press",
        "times": np.array([0.0, 1.0, 2.0]),
        "world_from_peg": poses.identity(3).numpy(),
        "manners": ("free", "guarded"),
        "force": 4.0,
        "stiffness": np.full(6, 100.0),
        "damping": np.full(6, 1.0),
    }
    return Plan(**{**given, **changed})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"times": np.array([0.0])}, "1 times"),
        ({"world_from_peg": np.zeros((3, 6))}, r"poses \(3, 6\)"),
        ({"manners": ("free",)}, "1 manners"),
        ({"manners": ("free", "pushed")}, "'pushed'; give one of free, guarded, held"),
        ({"times": np.array([0.0, 2.0, 1.0])}, "times that do not increase"),
        ({"times": np.array([0.0, NAN, 1.0])}, "times that do not increase"),
        ({"world_from_peg": np.full((3, 7), NAN)}, "not finite"),
        ({"force": 0.0}, "stops at 0.0 N"),
        ({"force": NAN}, "stops at nan N"),
        ({"force": math.inf}, "stops at inf N"),
        ({"force": "4"}, "stops at '4' N"),
        ({"rate": 0.0}, "a rate of 0.0 a second"),
        ({"rate": "100"}, "a rate of '100' a second"),
        ({"sink": math.inf}, "a sink of inf m"),
        ({"times": 1.0}, "0 times"),
        ({"times": np.array([0.0, 900.0, 2000.0])}, "lasts 2000 s: .* milliseconds"),
        ({"world_from_peg": poses.identity(3).numpy() + 10.0 * np.eye(3, 7)}, "spans 10 m.* millimetres"),
        ({"world_from_peg": poses.identity(3).numpy() + 506.0 * np.eye(1, 7)}, "to 506 m .* millimetres"),
    ],
)
def test_a_plan_that_makes_no_sense_is_refused_by_name(changed: dict[str, Any], message: str) -> None:
    assert plan_of().manners == ("free", "guarded")
    with pytest.raises(InputError, match=rf"plan 'press' .*{message}") as caught:
        plan_of(**changed)
    assert_one_sentence(str(caught.value))


def test_a_plan_of_lists_is_one_of_arrays() -> None:
    plan = plan_of()
    lists = plan_of(times=plan.times.tolist(), world_from_peg=plan.world_from_peg.tolist())
    assert np.array_equal(lists.times, plan.times) and lists.world_from_peg.dtype == np.float64
    assert np.array_equal(lists.world_from_peg, plan.world_from_peg)


# ---------------------------------------------------------------- what is felt


def test_room_on_top_that_a_micrometre_separates_is_one() -> None:
    """The peg's axis may be in two squares that a neck of 1.5 micrometres joins."""
    squares = shapely.union_all(
        [shapely.box(-0.03, -0.01, -0.01, 0.01), shapely.box(0.01, -0.01, 0.03, 0.01)]
    )
    room = squares.union(shapely.box(-0.02, -0.75e-6, 0.02, 0.75e-6))
    assert isinstance(room, shapely.Polygon) and isinstance(room.buffer(-1e-6), shapely.MultiPolygon)
    points = boundary_points(room)
    assert {tuple(np.sign(point)) for point in points} >= {(-1, -1), (-1, 1), (1, -1), (1, 1)}
    assert np.abs(points).max(axis=0) == pytest.approx([0.03, 0.01], abs=1e-5)


def forces(*sizes: float) -> torch.Tensor:
    """Forces (T, 3) of these sizes in all directions."""
    torch.manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(len(sizes), 3, dtype=torch.float64), dim=1)
    return direction * torch.tensor(sizes, dtype=torch.float64)[:, None]


def test_contact_is_detected_above_one_force_and_excluded_below_another() -> None:
    at_once = ContactDetector(contact=1.5, free=0.8, mass=0.3, agreement=0.0)
    detected = at_once(forces(0.0, 0.79, 0.81, 1.49, 1.51, 40.0, NAN))
    np.testing.assert_array_equal(detected.numpy(), [0, 0, NAN, NAN, 1, 1, NAN])
    # Accelerating the tool takes force: 4 m/s^2 hide 1.2 N.
    np.testing.assert_array_equal(at_once(forces(2.6, 2.8, 0.1), 4.0).numpy(), [NAN, 1, 0])
    each = at_once(forces(2.6, 2.6), torch.tensor([4.0, 0.0], dtype=torch.float64))
    np.testing.assert_array_equal(each.numpy(), [NAN, 1])


def test_neighbours_must_agree_either_way_in_time() -> None:
    sizes = [0.1] * 6 + [1.0] + [3.0] * 7 + [0.1] * 5 + [9.0] + [0.1] * 4
    detected = ContactDetector(agreement=0.02)(forces(*sizes), step=0.01).numpy()
    expected = [0] * 4 + [NAN] * 5 + [1] * 3 + [NAN] * 4 + [0] * 1 + [NAN] * 5 + [0] * 2
    np.testing.assert_array_equal(detected, expected)
    backwards = ContactDetector(agreement=0.02)(forces(*sizes[::-1]), step=0.01).numpy()
    np.testing.assert_array_equal(backwards, detected[::-1])


def test_forces_and_numbers_that_make_no_sense_are_refused() -> None:
    with pytest.raises(InputError, match=r"shape \(5, 6\); give \(T, 3\)"):
        ContactDetector()(torch.zeros(5, 6))
    for numbers in ({"free": 2.0}, {"contact": 0.0}, {"mass": -1.0}, {"agreement": -1.0}):
        with pytest.raises(InputError):
            ContactDetector(**numbers)


# ---------------------------------------------------------------- 3-2-1


def about(scene: BenchScene, spread: float) -> Belief:
    """A belief about the truth, of so many metres."""
    torch.manual_seed(scene.seed)
    away = spread * torch.randn(40, 6, dtype=torch.float64)
    around = poses.retract(torch.from_numpy(scene.truth), away - away.mean(dim=0))
    return Belief(around, torch.zeros(40, dtype=torch.float64))


@functools.cache
def carried(seed: int) -> tuple[BenchScene, Plan, Execution]:
    """A plan for a belief that is the truth, as the bench carries it out."""
    scene = bench_scene(seed)
    plan = three_two_one(about(scene, 0.0), scene.part, scene.peg)
    return scene, plan, scene.execute(plan)[0]


SEEDS = (5, 7, 11)  # a square and a D-shaped hole in blocks, a round tray


@functools.cache
def gaps(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The gap to the true part of the commanded peg, and of where the peg truly was."""
    scene, _, motion = carried(seed)
    gap, truth = PegGap(scene.part, scene.peg), torch.from_numpy(scene.truth)[None]
    gaps = [gap(truth, torch.from_numpy(path)) for path in (motion.probe.command, motion.world_from_peg)]
    return gaps[0].distance[0].numpy(), gaps[1].distance[0].numpy()


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
def test_no_free_motion_touches_the_part_and_every_guarded_one_does(seed: int) -> None:
    _, plan, motion = carried(seed)
    commanded, _ = gaps(seed)
    times, pressed, released = motion.probe.command_times, 0, -1.0
    assert plan.manners.count("guarded") == 3
    for k, manner in enumerate(plan.manners):
        begin, end = plan.times[k], plan.times[k + 1]
        if manner == "free":
            # What was pressed on is let go of within 80 ms: the command's corners are rounded over 40.
            during = (times > max(begin, released + 0.08)) & (times < end)
            assert commanded[during].min(initial=1.0) > 0.0, k
        else:
            released = end
        if manner == "guarded":
            during = (times > begin) & (times < plan.times[k + 2])
            assert commanded[during].min() < -0.0005 and plan.manners[k + 1] == "held"
            pressed += 1
    assert pressed == 3 and motion.stops


@pytest.mark.parametrize("seed", SEEDS)
def test_the_first_contact_is_near_3_s_and_the_plan_ends_at_6(seed: int) -> None:
    scene, plan, motion = carried(seed)
    _, truly = gaps(seed)
    assert plan.times[-1] == pytest.approx(MetrologyParameters().duration) and plan.times[0] == 0.0
    assert abs(motion.probe.stamps[np.argmax(truly < 0.0)] - MetrologyParameters().first_contact) < 0.1
    assert truly.min() > -0.0003  # nothing is pressed farther in than steel would let it
    # It is felt on the top, on one side and on the next: three directions of the part's frame.
    turn = poses.rotation_matrix(torch.from_numpy(scene.truth)).numpy()
    held = poses.rotation_matrix(torch.from_numpy(motion.world_from_peg)).numpy()
    along = ((held @ motion.wrench[:, :3, None])[..., 0] @ turn)[truly < 0.0]
    strong = along[np.linalg.norm(along, axis=1) > 1.0]
    assert (np.eye(3)[np.abs(strong).argmax(axis=1)].sum(axis=0) >= 5).all()


def test_strokes_are_as_long_as_the_belief_is_unsure() -> None:
    scene, lengths = bench_scene(2), []
    for spread in (0.0, 0.0025, 0.02):
        plan = three_two_one(about(scene, spread), scene.part, scene.peg)
        strokes = [k for k, manner in enumerate(plan.manners) if manner == "guarded"]
        ways = np.linalg.norm(np.diff(plan.world_from_peg[:, :3], axis=0)[strokes], axis=1)
        lengths.append((ways.min(), ways.max()))
    shortest, longest = (
        2 * MetrologyParameters().shortest_half_stroke,
        2 * MetrologyParameters().longest_half_stroke,
    )
    assert lengths[0] == pytest.approx((shortest, shortest))
    assert lengths[2] == pytest.approx((longest, longest))
    assert shortest < lengths[1][1] < longest


@pytest.mark.long
@pytest.mark.parametrize("seed", SEEDS)
def test_a_rocked_peg_leans_and_turns_both_ways_about_its_tip_and_stays_in_contact(seed: int) -> None:
    scene = bench_scene(seed)
    plan = three_two_one(about(scene, 0.0), scene.part, scene.peg, ROCKED)
    truth, commanded = torch.from_numpy(scene.truth), torch.from_numpy(plan.world_from_peg)
    assert plan.times[-1] == pytest.approx(ROCKED.duration)
    turned = poses.local(truth, commanded)[:, 3:]
    leaning = turned.norm(dim=1) > 1e-9
    # At two sides twice about the side's tangent, twice about the peg's axis, once each way.
    assert int(leaning.sum()) == 8
    for four in turned[leaning].split(4):
        assert torch.allclose(four[0::2], -four[1::2], atol=1e-9)
        assert four[0].norm() == pytest.approx(ROCKED.lean) and abs(float(four[0, 2])) < 1e-9
        assert abs(float(four[2, 2])) == pytest.approx(ROCKED.turn)
    tip = torch.tensor([[0.0, 0.0, float(scene.peg.vertices[:, 2].min())]], dtype=torch.float64)
    tips = poses.transform(commanded, tip)[:, 0]
    for k in torch.nonzero(leaning)[:, 0].tolist():
        assert torch.allclose(tips[k], tips[k - 1], atol=1e-9)
    motion = scene.execute(plan)[0]
    gap = PegGap(scene.part, scene.peg)(truth[None], torch.from_numpy(motion.world_from_peg)).distance[0]
    stamps = motion.probe.stamps
    for k in torch.nonzero(leaning)[:, 0].tolist():
        during = (stamps > plan.times[k - 1]) & (stamps < plan.times[k])
        assert float(gap[torch.from_numpy(during)].max()) < 2e-4


@pytest.mark.parametrize("slope", [0.0, 0.3, 0.45, -0.3])
def test_a_touch_of_a_side_that_slopes_is_made_at_that_side(slope: float) -> None:
    normal = np.array([math.sqrt(1.0 - slope**2), 0.0, slope])
    wider = 0.03 * slope / normal[0]
    corners = [
        [x * w, y * w, z] for w, z in ((0.02, 0.0), (0.02 + wider, -0.03)) for x in (-1, 1) for y in (-1, 1)
    ]
    hull = trimesh.convex.convex_hull(np.array(corners))
    frustum = Part("frustum", np.array(hull.vertices), np.array(hull.faces), source="a test")
    place = SurfacePoint(np.array([0.02 + 0.002 * slope / normal[0], 0.0, -0.002]), normal)
    about_here = Belief(poses.identity(2), torch.zeros(2, dtype=torch.float64))
    peg = round_peg(0.01, 0.1)
    (pose, _), *_ = expected_contacts(touch(about_here, frustum, peg, place))
    gap = (peg.vertices + pose[:3] - place.position) @ normal
    assert gap.min() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("size", [0.25, 0.5])
def test_a_plan_around_a_large_part_is_no_faster_but_longer(size: float) -> None:
    part, limits = block_with_square_hole((size, size, 0.025)), MetrologyParameters()
    plan = three_two_one(Belief(poses.identity(4), torch.zeros(4).double()), part, box_peg(0.016, 0.08))
    speed = np.linalg.norm(np.diff(plan.world_from_peg[:, :3], axis=0), axis=1) / np.diff(plan.times)
    stated = {"free": limits.free_speed, "guarded": limits.guarded_speed, "held": limits.sliding_speed}
    assert (speed <= 1.0001 * np.array([stated[manner] for manner in plan.manners])).all()
    assert plan.times[-1] > 2.0 * limits.duration
    first = plan.manners.index("guarded")
    assert 0.5 * plan.times[first : first + 2].sum() == pytest.approx(limits.first_contact)


U_SHAPED = [(0, 0), (0, 0.1), (0.08, 0.1), (0.08, 0.08), (0.02, 0.08), (0.02, 0.02), (0.08, 0.02), (0.08, 0)]
T_SHAPED = [(0, 0.1), (0, 0.08), (0.04, 0.08), (0.04, 0), (0.06, 0), (0.06, 0.08), (0.1, 0.08), (0.1, 0.1)]


@pytest.mark.parametrize("corners", [U_SHAPED, T_SHAPED])
def test_slides_stay_on_a_concave_part(corners: list[tuple[float, float]]) -> None:
    """A side of a part's convex hull that crosses a recess is none of its own."""
    part, peg = extruded("concave", shapely.Polygon(corners), -0.02, 0.0), box_peg(0.008, 0.08)
    outline = shapely.Polygon(corners).exterior
    on_it = [outline.distance(shapely.Point(end)) for side in sides(part, -0.01) for end in side[:2]]
    assert max(on_it) < 3e-4
    plan = three_two_one(Belief(poses.identity(4), torch.zeros(4).double()), part, peg)
    gap, share = PegGap(part, peg), np.linspace(0.0, 1.0, 9)[:, None]
    for k, manner in enumerate(plan.manners):
        if manner == "held":
            way = (1.0 - share) * plan.world_from_peg[k] + share * plan.world_from_peg[k + 1]
            assert float(gap(poses.identity(1), torch.from_numpy(way)).distance.max()) < 0.0


def test_a_part_with_no_room_on_top_is_refused() -> None:
    belief = Belief(poses.identity(3), torch.zeros(3, dtype=torch.float64))
    with pytest.raises(InputError, match="no room for a peg") as caught:
        three_two_one(belief, block((0.01, 0.01, 0.02)), box_peg(0.03, 0.05))
    assert_one_sentence(str(caught.value))

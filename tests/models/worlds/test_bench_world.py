"""The world of the accuracy benchmark: its stated errors are true, and its arm executes the plan."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import shapely
import torch

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.errors import InputError
from bcppl.geometry.outlines import check_fit
from bcppl.models.worlds.bench.parameters import BenchParameters
from bcppl.models.worlds.bench.parts import PARTS, PEG_LENGTH, bench_part
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.models.worlds.guarded_motion import Execution
from bcppl.recordings import Recording
from bcppl.rendering.ray_casting import RayCaster
from bcppl.robot.commands import command_of
from bcppl.robot.motion import Probe
from bcppl.robot.plan import Plan

STIFFNESS = np.array([2500.0] * 3 + [150.0] * 3)
DAMPING = np.array([120.0] * 3 + [2.5] * 3)
FORCE = 4.0
# When (s), where the tip is to be (m, from the centre of the top face along the part's axes), and how.
KNOTS = (
    (0.0, (-0.02, -0.02, 0.030), "free"),
    (0.4, (-0.02, -0.02, 0.006), "free"),
    (1.0, (-0.02, -0.02, -0.006), "guarded"),
    (1.5, (-0.02, 0.005, -0.006), "held"),
    (1.7, (-0.02, 0.005, 0.006), "free"),
    (2.3, (0.02, -0.02, 0.006), "free"),
    (2.9, (0.02, -0.02, -0.006), "guarded"),
    (3.1, (0.02, -0.02, -0.006), "held"),
)


def plan_of(scene: BenchScene, name: str = "two presses", until: int = len(KNOTS)) -> Plan:
    """Two presses on the top and a slide, laid out upright over the true pose, raised by a millimetre."""
    times, places, manners = zip(*KNOTS[:until], strict=True)
    truth = torch.from_numpy(scene.truth)
    sensor = np.array(places) + np.array([0.0, 0.0, scene.kind.part_from_hole[2] + PEG_LENGTH + 0.001])
    world_from_peg = truth.expand(len(times), 7).clone()
    world_from_peg[:, :3] = poses.transform(truth, torch.from_numpy(sensor))
    return Plan(name, np.array(times), world_from_peg.numpy(), tuple(manners[1:]), FORCE, STIFFNESS, DAMPING)


@functools.cache
def scene(seed: int = 0, part: str = "square 8 mm") -> BenchScene:
    return bench_scene(seed, part=part)


@functools.cache
def carried(seed: int = 0, part: str = "square 8 mm") -> Execution:
    return scene(seed, part).execute(plan_of(scene(seed, part)))[0]


@functools.cache
def probed() -> Recording:
    return scene().probe(plan_of(scene()))


def between(first: float, last: float) -> slice:
    return slice(round(100 * first), round(100 * last))


def force(motion: Execution, rows: slice) -> np.ndarray:
    return np.linalg.norm(motion.wrench[rows, :3], axis=1)


def equal(one: Recording, other: Recording) -> None:
    """Bit for bit the same views, windows and truth."""
    assert len(one.measurements) == len(other.measurements)
    for a, b in zip(one.measurements, other.measurements, strict=True):
        if a.kind == "view":
            np.testing.assert_array_equal(a.observation.depth, b.observation.depth)
            np.testing.assert_array_equal(
                a.action.camera.world_from_camera, b.action.camera.world_from_camera
            )
        else:
            np.testing.assert_array_equal(a.observation.wrench, b.observation.wrench)
            np.testing.assert_array_equal(a.observation.world_from_peg, b.observation.world_from_peg)
            np.testing.assert_array_equal(a.action.probe.command, b.action.probe.command)
    np.testing.assert_array_equal(one.truth, other.truth)


def test_the_same_seed_gives_the_same_recording_and_another_seed_another() -> None:
    again = bench_scene(0, part="square 8 mm")
    equal(probed(), again.probe(plan_of(again)))
    other = bench_scene(1, part="square 8 mm")
    assert abs(other.truth - scene().truth).max() > 1e-4
    assert (other.friction, other.contact.time_constant) != (scene().friction, scene().contact.time_constant)


def test_a_given_part_or_clearance_changes_nothing_else_of_a_scene() -> None:
    drawn, given = bench_scene(4), bench_scene(4, part="round tray", clearance=0.0002)
    assert given.clearance == 0.0002 and given.kind.name == "round tray" and given.contact == drawn.contact
    np.testing.assert_array_equal(given.world_from_cameras, drawn.world_from_cameras)
    # The top face of each part is thought to be in the same place, about which both poses are drawn.
    for each in (drawn, given):
        top = poses.transform(
            torch.from_numpy(each.guess.world_from_part), torch.from_numpy(each.kind.part_from_hole[None, :3])
        )
        assert float(top[0, 2]) == pytest.approx(0.15)
    moved = [each.truth[:3] - each.guess.world_from_part[:3] for each in (drawn, given)]
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-15)


def test_looking_and_probing_share_the_views() -> None:
    views = replace(probed(), measurements=probed().measurements[:2])
    equal(scene().look(), views)
    windows = probed().measurements[2:]
    assert [(w.action.first, w.action.last) for w in windows] == [
        (k, min(k + 50, 310)) for k in range(0, 310, 50)
    ]
    assert len({id(w.action.probe) for w in windows}) == 1 and probed().peg is scene().peg


def test_the_truth_is_not_what_inference_draws_from_the_same_seed() -> None:
    from bcppl.distributions.poses import SwingTwistPose

    guess = scene().guess
    torch.manual_seed(0)
    prior = SwingTwistPose(torch.from_numpy(guess.world_from_part), guess.translation, guess.tilt, guess.yaw)
    drawn = prior.expand(torch.Size([75])).sample()
    assert float((drawn - torch.from_numpy(scene().truth)).abs().max(dim=-1).values.min()) > 1e-4


def test_the_measured_wrench_has_the_stated_errors() -> None:
    one = scene()
    motion, wrench, world_from_peg = one.execute(plan_of(one))
    error = wrench - motion.wrench
    # White noise doubles in differences; the walk adds 0.3 N / sqrt(600) to each, which is nothing.
    spread = np.diff(error, axis=0).std(axis=0) / np.sqrt(2.0)
    np.testing.assert_allclose(spread, [0.1] * 3 + [0.005] * 3, rtol=0.2)
    shift = 1000.0 * (world_from_peg - motion.world_from_peg)[:, :3].std(axis=0)
    np.testing.assert_allclose(shift, 0.05, rtol=0.2)
    # Over scenes: with 192 numbers of each axis together a standard deviation is known to a twentieth.
    quiet = BenchParameters(force_noise=0.0)
    forces = [bench_scene(seed, quiet).sensor_errors().sample(600, 100.0)[0][:, :3] for seed in range(64)]
    bias, drift = [force[0] for force in forces], [force[-1] - force[0] for force in forces]
    assert 0.85 < np.std(bias) < 1.15 and 0.25 < np.std(drift) < 0.35


def test_free_motion_has_no_contact_force_and_stops_no_guarded_motion() -> None:
    motion = carried()
    assert force(motion, between(0.0, 0.55)).max() < 0.5
    assert force(motion, between(1.85, 2.45)).max() < 0.5
    # Guarded motions that meet nothing are made to their end, as if they were free.
    raised = plan_of(scene(), until=6)
    raised.world_from_peg[:, 2] += 0.05
    guarded = replace(raised, manners=("free", *("guarded",) * 4))
    freely = replace(raised, manners=("free",) * 5)
    one, other = scene().execute(guarded)[0], scene().execute(freely)[0]
    assert not one.stops
    np.testing.assert_array_equal(one.probe.command, other.probe.command)


def test_a_plan_that_is_in_contact_while_the_wrench_is_tared_is_refused() -> None:
    lowered = plan_of(scene(), until=6)
    lowered.world_from_peg[:, 2] -= 0.030  # the tip begins at the top, and is driven into it
    with pytest.raises(InputError, match="while it was tared"):
        scene().execute(replace(lowered, manners=("free",) * 5))


@pytest.mark.parametrize("part", ["square 8 mm", "hexagon 12 mm", "rectangular tray"])
def test_a_guarded_press_ends_at_its_force_and_a_held_slide_continues_from_there(part: str) -> None:
    one, plan = scene(0, part), plan_of(scene(0, part))
    if part == "rectangular tray":  # its top is 25 mm wide
        plan = _narrowed(one, plan, 0.5)
    motion = one.execute(plan)[0]
    assert set(motion.stops) == {1, 5}
    for first, last in ((0.9, 1.0), (2.8, 3.1)):
        assert abs(force(motion, between(first, last)).mean() / FORCE - 1.0) < 0.5
    # What was left of the press stays undone during the slide and is forgotten by the free motion.
    times, command = motion.probe.command_times, motion.probe.command
    late = np.interp(times - 0.0175, plan.times, np.arange(len(plan.times)))
    left = command[:, :3] - np.stack(
        [np.interp(late, np.arange(len(plan.times)), plan.world_from_peg[:, k]) for k in range(3)], axis=1
    )
    slide = left[(times > 1.05) & (times < 1.5)]
    assert np.linalg.norm(slide[0]) > 0.002 and np.ptp(slide, axis=0).max() < 1e-6
    normal = poses.rotation_matrix(torch.from_numpy(one.truth)).numpy()[:, 2]
    assert abs(slide[0] @ normal / np.linalg.norm(slide[0]) - 1.0) < 1e-6
    assert abs(left[(times > 1.75) & (times < 2.0)]).max() < 1e-6
    np.testing.assert_allclose(command[0], plan.world_from_peg[0], atol=1e-12)


def _narrowed(one: BenchScene, plan: Plan, share: float) -> Plan:
    """The same plan, its tip nearer to the part's axis."""
    truth = torch.from_numpy(one.truth)
    inside = poses.transform(poses.inverse(truth), torch.from_numpy(plan.world_from_peg[:, :3]))
    inside[:, :2] *= share
    changed = plan.world_from_peg.copy()
    changed[:, :3] = poses.transform(truth, inside).numpy()
    return replace(plan, world_from_peg=changed)


def test_the_truth_explains_the_probe() -> None:
    """Its command replayed at the true pose is felt the same to the bit; a press ends on the top face."""
    one, motion = scene(), carried()
    physics = PegPhysics(one.part, one.peg, one.contact)
    rollout = physics.start(one.truth[None], motion.probe).advance(len(motion.probe.stamps))
    np.testing.assert_array_equal(rollout.wrench[0], motion.wrench)
    np.testing.assert_array_equal(rollout.world_from_peg[0], motion.world_from_peg)
    for first, last in ((0.9, 1.0), (2.8, 3.1)):
        sensor = torch.from_numpy(motion.world_from_peg[between(first, last)])
        tip = poses.transform(sensor, torch.tensor([[0.0, 0.0, -PEG_LENGTH]], dtype=torch.float64))[:, 0]
        height = poses.transform(poses.inverse(torch.from_numpy(one.truth)), tip)[:, 2]
        assert float(height.abs().max()) < 1e-4


def test_a_command_does_not_depend_on_later_contacts() -> None:
    plan = plan_of(scene())
    early, late = command_of(plan, {1: 0.8}), command_of(plan, {1: 0.8, 5: 2.7})
    same = early.command_times <= 2.7
    np.testing.assert_allclose(early.command[same], late.command[same], atol=1e-12)
    assert abs(early.command[~same] - late.command[~same]).max() > 1e-4
    speed = np.diff(late.command[:, :3], axis=0) / 0.005
    assert np.linalg.norm(np.diff(speed, axis=0) / 0.005, axis=1).max() < 0.2 / 0.035
    assert np.linalg.norm(speed[0]) < 0.02  # it begins at rest


def test_an_occluder_hides_a_third_of_the_part_from_one_camera_only() -> None:
    for seed in range(3):
        open_, hidden = bench_scene(seed), bench_scene(seed, BenchParameters(occluder=True))
        np.testing.assert_array_equal(open_.world_from_cameras, hidden.world_from_cameras)
        for k in range(2):
            camera = replace(open_.cameras[k], world_from_camera=open_.world_from_cameras[k])
            part = np.isfinite(RayCaster(open_.part).images(camera, open_.truth[None])[0])
            without, box = open_.true_depth(k), hidden.true_depth(k)
            if k == hidden.hidden_view:
                assert 0.25 < float((box < without - 0.05)[part].mean()) < 0.42
            else:
                np.testing.assert_array_equal(without, box)


def test_cameras_worse_than_stated_have_larger_errors_and_the_same_stated_poses() -> None:
    for seed in range(3):
        one, worse = bench_scene(seed), bench_scene(seed, BenchParameters(camera_error_factor=2.0))
        for k in range(2):
            stated = torch.from_numpy(one.cameras[k].world_from_camera)
            np.testing.assert_array_equal(stated, worse.cameras[k].world_from_camera)
            near, far = (poses.local(stated, torch.from_numpy(s.world_from_cameras[k])) for s in (one, worse))
            torch.testing.assert_close(2.0 * near, far, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", PARTS)
def test_every_part_takes_its_peg_at_every_clearance(name: str) -> None:
    """The narrowest gap to the hole of the mesh that is seen is the clearance, within 10 um."""
    kind = bench_part(name)
    kind.part.check()
    height = float(kind.part_from_hole[2]) - 0.01
    section = kind.part.mesh.section(plane_origin=[0.0, 0.0, height], plane_normal=[0.0, 0.0, 1.0])
    flat, _ = section.to_2D(to_2D=np.eye(4))
    (solid,) = flat.polygons_full
    hole = shapely.affinity.translate(shapely.Polygon(solid.interiors[0]), *-kind.part_from_hole[:2])
    for clearance in BenchParameters().clearances:
        peg = kind.peg(clearance)
        assert peg.vertices[:, 2].min() == -PEG_LENGTH and peg.vertices[:, 2].max() == 0.0
        outline = shapely.MultiPoint(peg.vertices[:, :2]).convex_hull
        assert check_fit(hole, outline) == pytest.approx(clearance, abs=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("name", PARTS)
def test_a_peg_in_its_hole_is_free_by_its_clearance_and_no_more(name: str) -> None:
    """Half a clearance to each side: at 0.4 of it nothing is felt, at 0.6 the wall is."""
    kind = bench_part(name)
    for clearance in BenchParameters().clearances:
        physics = PegPhysics(kind.part, kind.peg(clearance), ContactParameters())
        felt = []
        for share in (-0.4, -0.6):
            place = kind.part_from_hole.copy()
            place[:3] += 0.0, share * clearance, PEG_LENGTH - 0.01
            held = Probe("in", np.zeros(1), place[None], STIFFNESS, DAMPING, np.array([0.0, 0.05]))
            rollout = physics.start(poses.identity(1), held).advance(2)
            felt.append(np.linalg.norm(rollout.wrench[0, -1, :3]))
        assert felt[0] == 0.0 and felt[1] > 0.005, (clearance, felt)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": -1}, "the seed is -1"),
        ({"seed": 0, "part": "cube"}, "no part 'cube'; its parts are round tray"),
        ({"seed": 0, "clearance": 0.0}, "clearance"),
        ({"seed": 0, "part": "round 8 mm", "clearance": 0.01}, "leaves no peg"),
    ],
)
def test_impossible_scenes_are_refused(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        bench_scene(**options)


def test_a_plan_too_short_to_tare_is_refused() -> None:
    short = replace(plan_of(scene(), until=2), times=np.array([0.0, 0.1]))
    with pytest.raises(InputError, match="has 10 samples at 100 Hz"):
        scene().probe(short)

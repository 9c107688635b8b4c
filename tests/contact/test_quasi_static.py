"""Quasi-static motion against closed forms, contact physics and the bench's arm."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.contact.quasi_static import QuasiStaticMotion, WindowMotion
from bcppl.distributions.manifold import ContactManifold
from bcppl.geometry.extrusion import block, block_with_hole, block_with_square_hole, box_peg, peg_for
from bcppl.geometry.gap import PegGap
from bcppl.geometry.outlines import round_outline
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from bcppl.robot.motion import Probe, ProbeWindow
from bcppl.robot.plan import Plan, probe_of
from bcppl.sensors import View
from bcppl.sensors.candidates import action_of

LENGTH = 0.05
STIFF, DAMP = np.array([2500.0] * 3 + [150.0] * 3), np.array([120.0] * 3 + [2.5] * 3)


@functools.cache
def on_a_block() -> QuasiStaticMotion:
    return QuasiStaticMotion(PegGap(block((0.06, 0.06, 0.025)), box_peg(0.016, LENGTH)))


@functools.cache
def over_a_hole() -> tuple[QuasiStaticMotion, float]:
    outline, clearance = round_outline(0.016), 0.0005
    peg = peg_for(outline, clearance, 0.08)
    return QuasiStaticMotion(PegGap(block_with_hole(outline, offset=(0.007, 0.005)), peg)), 0.08


def way(*places: tuple[float, float, float], count: int = 15, tip: float = LENGTH) -> Tensor:
    """Commands (T, 7) of an upright peg whose tip goes from place to place."""
    knots = np.add(places, [0.0, 0.0, tip])
    at = np.linspace(0, len(knots) - 1, count * (len(knots) - 1) + 1)
    command = poses.identity(len(at))
    for axis in range(3):
        command[:, axis] = torch.from_numpy(np.interp(at, np.arange(len(knots)), knots[:, axis]))
    return command


def turned(*rotation: float) -> Tensor:
    return poses.retract(poses.identity(1), torch.tensor([[0.0, 0.0, 0.0, *rotation]], dtype=torch.float64))


@pytest.mark.parametrize("count", [2, 4, 40])
def test_a_peg_lowered_on_a_plane_stops_at_it_however_far_apart_the_stamps(count: int) -> None:
    heights = torch.tensor([0.0001, 0.0021, -0.0032], dtype=torch.float64)
    part = poses.identity(3)
    part[:, 2] = heights
    command = way((0, 0, 0.012), (0, 0, -0.012), count=count)
    peg = on_a_block()(part, command)
    expected = torch.maximum(command[:, 2], heights[:, None] + LENGTH)
    torch.testing.assert_close(peg[..., 2], expected, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(peg[..., [0, 1, 3, 4, 5, 6]], command[:, [0, 1, 3, 4, 5, 6]].expand(3, -1, -1))
    contact = command[:, 2] < expected - 1e-6
    assert (
        torch.equal(peg[..., 7] == 1.0, contact)
        and bool(contact[:, -1].all())
        and not bool(contact[:, 0].any())
    )


def test_a_held_peg_is_measured_once_and_one_that_turns_again() -> None:
    rules = QuasiStaticMotion(PegGap(block((0.06, 0.06, 0.025)), box_peg(0.016, LENGTH)))
    command = way((0, 0, 0.002), (0, 0, -0.004))
    held = torch.cat([command, command[-1:].expand(30, 7)])
    costs = []
    for each in (command, held):
        before = rules.gap.effort.copy()
        motion = rules(poses.identity(1), each)
        costs.append(rules.gap.effort.since(before).items)
    assert costs[0] == costs[1] > 0
    assert bool((motion[0, len(command) :] == motion[0, len(command) - 1]).all())
    # Turned where it stands it rests on an edge, which is farther from its grip than the flat end.
    angle = 0.1
    turning = held[-2:].clone()
    turning[1, 3:] = turned(angle, 0.0, 0.0)[0, 3:]
    height = rules(poses.identity(1), turning)[0, :, 2]
    edge = LENGTH * math.cos(angle) + 0.008 * math.sin(angle)
    np.testing.assert_allclose(height.numpy(), [LENGTH, edge], atol=1e-6)


def test_on_a_tilted_face_it_slides_to_where_the_spring_is_shortest() -> None:
    tilt = 0.1
    command = way((0, 0, 0.005), (0, 0, -0.004), (0.01, 0, -0.004))
    peg = on_a_block()(turned(0.0, tilt, 0.0), command)[0]
    normal = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    corner = np.array([0.008, 0.0, -LENGTH])  # which touches: the face falls off along x
    corner[0] = -0.008
    depth = np.minimum((command[:, :3].numpy() + corner) @ normal, 0.0)
    expected = command[:, :3].numpy() - depth[:, None] * normal
    np.testing.assert_allclose(peg[:, :3].numpy(), expected, atol=1e-6)
    assert depth.min() < -0.003 and (peg[:, 7].numpy() == (depth < -1e-6)).all()


def test_in_a_corner_both_walls_stop_it_and_it_comes_out_again() -> None:
    """Onto the top, over the edge, down beside the block, against its side, and up."""
    command = way((0, 0, 0.003), (0, 0, -0.004), (0.045, 0, -0.004), (0.03, 0, -0.004), (0.03, 0, 0.01))
    peg = on_a_block()(poses.identity(1), command)[0]
    gaps = on_a_block().gap(poses.identity(1), peg[:, :7]).distance[0]
    assert float(gaps.min()) > -2e-7
    beside = peg[45]
    np.testing.assert_allclose(beside[:3], [0.038, 0.0, LENGTH - 0.004], atol=1e-6)
    assert float(beside[7]) == 1.0
    # Held back by the side on its way up, then free, then at the command.
    torch.testing.assert_close(peg[-1, :3], command[-1, :3])
    assert float(peg[-1, 7]) == 0.0


def test_over_the_hole_it_goes_in_where_it_fits_and_stands_on_the_rim_elsewhere() -> None:
    rules, length = over_a_hole()
    command = way((0.007, 0.005, 0.004), (0.007, 0.005, -0.008), tip=length)
    off = torch.tensor([0.0, 1.5e-4, 6e-4, -2e-3], dtype=torch.float64)
    part = poses.identity(4)
    part[:, 0] = off
    depth = rules(part, command)[:, -1, 2] - length
    torch.testing.assert_close(
        depth, torch.tensor([-0.008, -0.008, 0.0, 0.0], dtype=torch.float64), atol=1e-6, rtol=0.0
    )
    # A slide with the peg pressed on finds the hole, and drops.
    slide = way((-0.004, 0.005, 0.002), (-0.004, 0.005, -0.003), (0.007, 0.005, -0.003), tip=length)
    dropped = rules(poses.identity(1), slide)[0, :, 2] - length
    assert float(dropped[20]) == pytest.approx(0.0, abs=1e-6) and float(dropped[-1]) == pytest.approx(
        -0.003, abs=1e-6
    )


def test_a_peg_that_begins_in_the_part_is_pushed_out_and_nan_poses_give_nan() -> None:
    command = way((0, 0, -0.004), (0.002, 0, -0.004))
    part = poses.identity(3)
    part[1, 0] = math.nan
    peg = on_a_block()(part, command)
    assert bool(torch.isnan(peg[1]).all()) and bool(torch.isfinite(peg[[0, 2]]).all())
    torch.testing.assert_close(
        peg[0, :, 2], torch.full((len(command),), LENGTH, dtype=torch.float64), atol=1e-6, rtol=0
    )
    own = command.expand(3, -1, -1).clone()
    own[2, 3, 4] = math.nan
    assert torch.isnan(on_a_block()(poses.identity(3), own)).all(dim=2).all(dim=1).tolist() == [
        False,
        False,
        True,
    ]


def test_particles_and_commands_together_are_each_alone_and_motions_of_the_world_change_nothing() -> None:
    rules, length = over_a_hole()
    rng = np.random.default_rng(0)
    part = poses.retract(poses.identity(6), torch.from_numpy(1e-3 * rng.normal(size=(6, 6))))
    starts = zip(rng.uniform(-0.01, 0.01, 6), (0.0015, 0.003, 0.006, 0.01, 0.02, 0.03), strict=True)
    commands = torch.stack(
        [
            way((x, 0.005, height), (x, 0.005, -0.004), (x + 4 * height, 0.007, -0.004), tip=length)
            for x, height in starts
        ]
    )
    together = rules(part, commands)
    alone = torch.cat([rules(part[k : k + 1], commands[k]) for k in range(6)])
    torch.testing.assert_close(together, alone, atol=1e-9, rtol=0.0)
    motion = poses.retract(
        poses.identity(), torch.tensor([0.3, -0.2, 0.1, 0.4, -0.5, 0.6], dtype=torch.float64)
    )
    moved = rules(poses.compose(motion, part), poses.compose(motion, commands))
    torch.testing.assert_close(
        moved[..., :3], poses.compose(motion, together[..., :7])[..., :3], atol=2e-5, rtol=0.0
    )


@pytest.mark.parametrize(
    "places",
    [
        [(0.0, -0.01, 0.004), (0.0, -0.01, -0.0015)],
        [(-0.02, 0, 0.004), (-0.02, 0, -0.001), (0.0, 0.01, -0.001)],
    ],
    ids=["touch", "slide"],
)
def test_slow_physics_is_quasi_static(places: list[tuple[float, float, float]]) -> None:
    rules = on_a_block()
    physics = PegPhysics(rules.gap.part, rules.gap.peg, ContactParameters(time_step=0.001, friction=0.0))
    command = way(*places, count=1).numpy()
    times = np.arange(len(command)) * 0.6
    stamps = np.arange(0.05, times[-1] - 1e-9, 0.05)
    probe = Probe("slow", times, command, STIFF, DAMP, stamps)
    part = poses.retract(
        poses.identity(2), torch.tensor([[0.0] * 6, [0, 0, 5e-4, 0.0, 0.01, 0.0]], dtype=torch.float64)
    )
    simulated = physics.start(part, probe).advance(len(stamps)).world_from_peg
    peg = WindowMotion(rules, ProbeWindow(probe, 0, len(stamps)), 1)(part).numpy()
    off = np.linalg.norm(peg[..., :3] - simulated[..., :3], axis=-1)
    assert np.median(off) < 5e-5 and off.max() < 6e-4  # at the impact


@functools.cache
def scene() -> BenchScene:
    return bench_scene(3, part="square 8 mm", clearance=0.0005)


def touch_plan() -> Plan:
    """Down on the top and along it, planned at the truth."""
    one = scene()
    tip = -float(one.peg.vertices[:, 2].min())
    places = np.array(
        [
            [0.02, 0.018, 0.01],
            [0.02, 0.018, 0.01],
            [0.02, 0.018, -0.006],
            [0.02, 0.018, -0.006],
            [0.02, -0.01, -0.006],
        ]
    )
    at = poses.compose(torch.from_numpy(one.truth), poses.identity(5))
    top = float(one.part.vertices[:, 2].max())
    at[:, :3] = poses.transform(
        torch.from_numpy(one.truth), torch.from_numpy(np.add(places, [0, 0, top + tip]))
    )
    manners = ("free", "guarded", "held", "held")
    return Plan("down", np.array([0.0, 0.2, 0.9, 1.0, 1.8]), at.numpy(), manners, 4.0, STIFF, DAMP)


def test_the_benchs_arm_gets_to_where_the_probe_of_its_plan_does() -> None:
    """The arm stops its guarded motion and goes on from there; the probe presses on, and slides the same."""
    plan, one = touch_plan(), scene()
    carried, _, _ = one.execute(plan)
    probe = probe_of(plan)
    np.testing.assert_array_equal(probe.stamps, carried.probe.stamps)
    window = action_of(plan)
    assert isinstance(window, ProbeWindow) and (window.first, window.last) == (0, len(probe.stamps))
    view = View(one.cameras[0])
    assert action_of(view) is view
    motion = WindowMotion(QuasiStaticMotion(PegGap(one.part, one.peg)), window, 5)
    peg = motion(torch.from_numpy(one.truth)[None])[0].numpy()
    simulated = carried.world_from_peg[::5]
    up = poses.rotation_matrix(torch.from_numpy(one.truth)).numpy()[:, 2]
    height = (peg[:, :3] - simulated[:, :3]) @ up
    contact = peg[:, 7] == 1.0
    assert 18 < contact.sum() < 30
    assert np.median(np.abs(height[contact])) < 1e-4
    # Friction and rounded corners hold it back along the slide.
    assert np.linalg.norm(peg[-1, :3] - simulated[-1, :3]) < 0.004


def test_a_window_in_the_middle_is_a_piece_of_the_whole_and_several_together_are_each_alone() -> None:
    plan = touch_plan()
    probe, part = probe_of(plan), torch.from_numpy(scene().truth).repeat(3, 1)
    part[:, 2] += torch.tensor([0.0, 0.001, -0.001])
    rules = QuasiStaticMotion(PegGap(scene().part, scene().peg))
    whole = WindowMotion(rules, ProbeWindow(probe, 0, len(probe.stamps)), 5)
    middle = WindowMotion(rules, ProbeWindow(probe, 60, 110), 5)
    together = WindowMotion.together([whole, middle], [part, part[:2]])
    torch.testing.assert_close(together[0], whole(part), atol=1e-9, rtol=0.0)
    torch.testing.assert_close(together[1], together[0][:2, 12:22], atol=1e-9, rtol=0.0)


def test_samples_of_a_manifold_with_a_motion_have_its_own_density() -> None:
    rules = on_a_block()
    rng = np.random.default_rng(1)
    spread = rng.normal(size=(400, 6)) * [1e-3, 1e-3, 1e-3, 0.02, 0.02, 0.02]
    part = poses.retract(poses.identity(400), torch.from_numpy(spread))
    command = way((0, 0, 0.006), (0, 0, -0.006), (0.01, 0, -0.006), count=8)
    noise, shared, sink = 7e-5, 3e-5, 2e-5
    site = ContactManifold(
        rules.gap, part, len(command), noise, shared, sink, motion=lambda pose: rules(pose, command)
    )
    torch.manual_seed(0)
    value = site.sample()
    distance = rules.gap(part, value[..., :7]).distance
    touching = value[..., 7] == 1.0
    errors = distance[touching] + sink
    assert abs(float(errors.mean())) < 5e-6
    assert float(errors.std()) == pytest.approx(math.hypot(noise, shared), rel=0.05)
    # A window's log-probability at the particle that gave it is that of one for each.
    each = torch.stack(
        [
            ContactManifold(rules.gap, part[k : k + 1], len(command), noise, shared, sink).log_prob(value[k])[
                0
            ]
            for k in range(20)
        ]
    )
    torch.testing.assert_close(site.log_prob(value)[:20], each)
    one = ContactManifold(rules.gap, part[:1], len(command), noise, shared, sink).quadratic(value[0])
    torch.testing.assert_close(site.quadratic(value).information[:1], one.information)
    lost = value.clone()
    lost[5] = math.nan
    assert torch.isnan(site.log_prob(lost)).nonzero().flatten().tolist() == [5]
    # Elsewhere it is less likely.
    away = ContactManifold(rules.gap, part.roll(1, 0), len(command), noise, shared, sink)
    assert float((site.log_prob(value) > away.log_prob(value)).double().mean()) > 0.95


def test_stamps_far_apart_lead_through_no_wall() -> None:
    """The peg is commanded to the other side of the block within one stamp, across and at a slant."""
    for end in ((0.0, 0.0, -0.2), (0.09, 0.02, -0.01)):
        command = way((-0.08, 0, -0.01) if end[0] else (0, 0, 0.05), end, count=1)
        peg = on_a_block()(poses.identity(1), command)[0]
        assert float(on_a_block().gap(poses.identity(1), peg[:, :7]).distance.min()) > -2e-7
        assert peg[-1, 7] == 1.0
        assert float(peg[-1, 2]) > LENGTH - 2e-7 if not end[0] else float(peg[-1, 0]) < -0.03


@pytest.mark.parametrize("depth", [0.0003, 0.0009, 0.005])
def test_from_a_shallow_hole_a_peg_does_not_jump(depth: float) -> None:
    """Its play is half a millimetre: leaning on one wall it is led against the next one."""
    solid = QuasiStaticMotion(
        PegGap(block_with_square_hole((0.06, 0.06, 0.025), 0.0165), box_peg(0.016, LENGTH))
    )
    command = way((0, 0, -depth), (0.004, 0, -depth), (0.004, 0.004, -depth), count=100)
    expected = torch.tensor([0.00025, 0.00025, LENGTH - depth], dtype=torch.float64)
    torch.testing.assert_close(solid(poses.identity(1), command)[0, -1, :3], expected, atol=2e-6, rtol=0.0)


def test_a_peg_that_turned_far_away_stops_as_it_is_turned_then() -> None:
    lean = turned(0.3, 0.1, 0.0)[0, 3:]
    command = torch.cat([way((0, 0, 0.08)), way((0, 0, 0.08), (0, 0, 0.03), (0, 0, -0.03), count=1)])
    leant = command.clone()
    leant[:, 3:] = lean
    command[1:, 3:] = lean
    peg = on_a_block()(poses.identity(1), command)[0]
    torch.testing.assert_close(peg[-1], on_a_block()(poses.identity(1), leant)[0, -1], atol=1e-6, rtol=0.0)
    assert abs(float(on_a_block().gap(poses.identity(1), peg[-1:, :7]).distance)) < 1e-6


def test_its_turn_is_the_commands() -> None:
    command = way((0, 0, 0.004), (0, 0, -0.004))
    turn = Rotation.from_rotvec(np.linspace(0, 0.3, len(command))[:, None] * [1.0, 0.5, 0.0])
    command[:, 3:] = torch.from_numpy(turn.as_quat()[:, [3, 0, 1, 2]])
    peg = on_a_block()(poses.identity(1), command)[0]
    torch.testing.assert_close(peg[:, 3:7], command[:, 3:])
    assert float(on_a_block().gap(poses.identity(1), peg[:, :7]).distance.min()) > -2e-7

"""Contact physics: the spring's force, places and times of contact, and that chunks change nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, block_with_square_hole, box_peg, round_peg
from bcppl.geometry.parts import Part, Piece
from bcppl.robot.commands import interpolated_command
from bcppl.robot.motion import Probe
from tests.contact.contact_probes import DAMPING, HOLE, SEARCH, STIFFNESS, path, same

SQUARE = box_peg(0.016, 0.05)


def at(*translations: tuple[float, float, float]) -> torch.Tensor:
    pose = torch.zeros(len(translations), 7, dtype=torch.float64)
    pose[:, :3] = torch.tensor(translations)
    pose[:, 3] = 1.0
    return pose


def ball(radius: float, length: float) -> Part:
    """A stick that ends in a ball, as an icosphere's hull with a vertex at the bottom."""
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices = sphere.vertices - sphere.vertices[np.argmin(sphere.vertices[:, 2])] * [1, 1, 0]
    vertices[:, 2] -= length - radius
    return Part("ball", vertices, np.asarray(sphere.faces), [Piece("hull", vertices)])


@pytest.mark.parametrize("peg", [SQUARE, round_peg(0.008, 0.05), ball(0.008, 0.05)], ids=lambda p: p.name)
def test_pressing_on_a_plane_gives_the_spring_s_force_upwards(peg: Part) -> None:
    probe = path((0, 0, 0, 0.055), (0.5, 0, 0, 0.047), (1.5, 0, 0, 0.047))
    rollout = PegPhysics(block((0.1, 0.1, 0.02)), peg).start(at((0, 0, 0)), probe).advance(150)
    force = rollout.wrench[0, -1, 2]
    assert force == pytest.approx(2000 * 0.003, rel=0.02)
    assert force == pytest.approx(2000 * (rollout.world_from_peg[0, -1, 2] - 0.047), rel=1e-3)
    assert rollout.world_from_peg[0, -1, 2] == pytest.approx(0.05, abs=5e-5)


def test_the_spring_acts_along_the_commanded_axes_and_the_wrench_is_in_the_peg_s() -> None:
    # The peg lies along the world's -x: its tip, at z = -50 mm in its frame, points to +x, its x axis down.
    turn = Rotation.from_euler("y", 90, degrees=True).inv()
    probe = path((0, -0.06, 0, 0.0), (0.5, -0.047, 0, 0.0), (1.5, -0.047, 0, 0.0), turn=turn)
    part = block((0.1, 0.1, 0.1))
    rollout = PegPhysics(part, SQUARE).start(at((0.05, 0.0, 0.05)), probe).advance(150)
    np.testing.assert_allclose(turn.apply([0, 0, -1]), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rollout.wrench[0, -1, :3], [0, 0, 2000 * 0.003], atol=0.12)
    np.testing.assert_allclose(rollout.world_from_peg[0, -1, :3], [-0.05, 0, 0], atol=5e-5)


def test_a_side_touch_stops_at_the_face() -> None:
    # The wall's face is at x = 30 mm, the peg's side 8 mm from its axis; it is pushed 4 mm beyond touch.
    stiff = np.array([1500.0, 1000.0, 2000.0, 6000.0, 6000.0, 6000.0])
    probe = path((0, 0, 0, 0), (1.0, 0.026, 0, 0), (2.0, 0.026, 0, 0), stiffness=stiff, damping=9 * DAMPING)
    rollout = PegPhysics(block((0.1, 0.1, 0.1)), SQUARE).start(at((0.08, 0, -0.02)), probe).advance(200)
    force, torque = rollout.wrench[0, -1, :3], rollout.wrench[0, -1, 3:]
    assert rollout.world_from_peg[0, -1, 0] == pytest.approx(0.022, abs=1e-4)
    assert force[0] == pytest.approx(-1500 * 0.004, rel=0.02)
    # (r x f)_y = r_z f_x: the contact lies between the wall's top edge and the peg's tip.
    assert -0.05 - 1e-4 <= torque[1] / force[0] <= -0.02 + 1e-4


@pytest.mark.parametrize("friction", [0.1, 0.6])
def test_a_contact_s_normal_is_the_face_s_and_not_the_force_s(friction: float) -> None:
    """A peg is pressed on a leaning block and dragged along it: its force leans by the friction's angle."""
    lean = Rotation.from_euler("y", 10, degrees=True)
    pose = at((0.0, 0.0, 0.0))
    pose[0, 3:] = torch.from_numpy(lean.as_quat(scalar_first=True))
    probe = path((0, 0, 0, 0.06), (0.5, 0, 0, 0.047), (1.5, 0.01, 0, 0.047))
    physics = PegPhysics(block((0.1, 0.1, 0.02)), ball(0.008, 0.05), ContactParameters(friction=friction))
    rollout = physics.start(pose, probe).advance(150)
    assert (rollout.normals[0, :10] == 0.0).all(), "in free motion there is none"
    np.testing.assert_allclose(rollout.normals[0, 100], lean.apply([0, 0, 1]), atol=0.02)
    force = rollout.wrench[0, 100, :3]
    across = np.linalg.norm(np.cross(force, lean.apply([0, 0, 1]))) / np.linalg.norm(force)
    assert across == pytest.approx(np.sin(np.arctan(friction)), rel=0.1)


def test_free_motion_is_read_at_the_right_time() -> None:
    probe = path((0, 0, 0, 0.2), (1.0, 0.2, 0, 0.2), (2.0, 0.2, 0.1, 0.2), stamps=np.arange(0.5, 1.0, 0.0137))
    rollout = PegPhysics(block((0.1, 0.1, 0.02)), SQUARE).start(at((0, 0, 0)), probe).advance(30)
    expected, twist = interpolated_command(probe, probe.stamps[:30])
    np.testing.assert_allclose(twist[0], [0.2, 0, 0, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rollout.world_from_peg[0], expected, atol=1e-6)


def test_turning_commands_are_followed_along_the_geodesic() -> None:
    probe = path((0, 0, 0, 0.2), (1.0, 0, 0, 0.2))
    probe.command[1, 3:] = Rotation.from_rotvec([0.5, 0.3, -0.4]).as_quat()[[3, 0, 1, 2]]
    rollout = PegPhysics(block((0.1, 0.1, 0.02)), SQUARE).start(at((0, 0, 0)), probe).advance(100)
    turned = Rotation.from_quat(rollout.world_from_peg[0, 90, [4, 5, 6, 3]]).as_rotvec()
    np.testing.assert_allclose(turned, 0.9 * np.array([0.5, 0.3, -0.4]), atol=2e-3)


def test_the_wrench_and_the_pose_are_of_the_same_moment() -> None:
    # At 0.2 m/s a step of 2 ms is 0.4 mm: contact begins where the faces meet, not a step off.
    probe = path((0, 0, 0, 0.09), (0.4, 0, 0, 0.01), (0.5, 0, 0, 0.01), stamps=np.arange(0.0, 0.5, 0.002))
    rollout = PegPhysics(block((0.1, 0.1, 0.02)), SQUARE).start(at((0, 0, 0)), probe).advance(240)
    height, force = rollout.world_from_peg[0, :, 2], rollout.wrench[0, :, 2]
    first = int(np.argmax(force > 5.0))
    assert height[first - 1] > 0.05 >= height[first] - 1e-9


def test_a_peg_enters_an_aligned_hole_and_not_one_that_is_off_by_a_millimetre() -> None:
    part = block_with_square_hole(hole=0.017, offset=(0.004, -0.003))
    probe = path((0, 0.004, -0.003, 0.055), (0.5, 0.004, -0.003, 0.04), (1.0, 0.004, -0.003, 0.04))
    rollout = PegPhysics(part, SQUARE).start(at((0, 0, 0), (0.001, 0, 0)), probe).advance(100)
    depth = 0.05 - rollout.world_from_peg[:, -1, 2]
    assert depth[0] == pytest.approx(0.01, abs=1e-4)
    assert depth[1] == pytest.approx(0.0, abs=1e-4)
    assert abs(rollout.wrench[0, -1]).max() < 0.01
    assert rollout.wrench[1, -1, 2] > 5.0


def test_a_peg_slides_without_chatter() -> None:
    probe = path((0, -0.015, 0.003, 0.055), (0.6, -0.015, 0.003, 0.047), (1.6, -0.005, 0.001, 0.047))
    rollout = PegPhysics(block((0.1, 0.1, 0.02)), SQUARE).start(at((0, 0, 0)), probe).advance(150)
    force = rollout.wrench[0, 100:]
    assert force[:, 2].std() < 0.01
    # Sliding along +x: friction pulls back with 0.3 of the normal force.
    np.testing.assert_allclose(np.hypot(force[:, 0], force[:, 1]), 0.3 * force[:, 2], rtol=0.01)
    assert (force[:, 0] < 0).all() and (force[:, 1] > 0).all()


@cache
def poses(count: int = 7) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    pose = at(*[(0.0, 0.0, 0.0)] * count)
    pose[:, :3] += 0.002 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    pose[0, 0] = 1.0  # out of reach
    return pose


def test_chunks_batches_order_and_shared_free_motion_change_nothing() -> None:
    physics = PegPhysics(HOLE, SQUARE)
    whole = physics.start(poses(), SEARCH).advance(120)
    effort = physics.effort.copy()
    assert (abs(whole.wrench[1:, :, 2]).max(axis=1) > 1.0).all()
    chunked = physics.start(poses(), SEARCH)
    for count in (1, 2, 40, 41, 77, 120):
        chunked.advance(count)
    same(whole, chunked)
    apart = PegPhysics(HOLE, SQUARE, share_free_motion=False)
    same(whole, apart.start(poses(), SEARCH).advance(120))
    assert apart.effort.amount == pytest.approx(7 * 1.192, abs=0.02)
    assert effort.amount < 0.75 * apart.effort.amount and effort.items == 7
    order = torch.tensor([4, 1, 6, 1])
    same(whole[order], physics.start(poses()[order], SEARCH).advance(120))
    same(whole[order], physics.start(poses(), SEARCH).advance(60)[order].advance(120))
    copies = torch.arange(7).repeat_interleave(3)
    many = physics.start(poses(), SEARCH).advance(60)[copies]
    assert len(many) == 21 and many.count == 60
    same(whole[order], many[3 * order].advance(120))
    same(whole[copies][12:15], many[copies == 4].advance(120))
    same(whole[copies], many.advance(120))
    odd = replace(SEARCH, stamps=np.sort(np.r_[0.0033:1.19:0.0071, 0.6004]))
    one = physics.start(poses(), odd).advance(100)
    two = physics.start(poses(), odd)
    for count in range(1, 101, 3):
        two.advance(count)
    same(one, two)


def test_what_diverges_is_tried_at_half_the_step_and_then_counted() -> None:
    probe = path((0, 0, 0, 0.3), (0.2, 0.01, 0, 0.3))
    # The spring is unstable beyond time_step = 2 / sqrt(stiffness / mass).
    for factor, fails in ((1.5, False), (3.0, True)):
        step = factor * 2.0 / np.sqrt(2000.0 / 2.2)
        times = np.arange(0.0, 100 * step, step)
        long = Probe(
            "long", np.array([0.0, 0.1, times[-1]]), probe.command[[0, 1, 1]], STIFFNESS, 0 * DAMPING, times
        )
        parameters = ContactParameters(time_step=step, arm_inertia=50.0)
        rollout = PegPhysics(block((0.1, 0.1, 0.02)), SQUARE, parameters).start(
            at((0, 0, 0), (0, 0, 0)), long
        )
        if fails:
            with pytest.warns(RuntimeWarning, match="2 of 2 rollouts"):
                rollout.advance(100)
        else:
            rollout.advance(100)
        assert rollout.diverged.tolist() == [fails, fails]
        assert np.isfinite(rollout.wrench).all() != fails


def test_bad_input_is_refused() -> None:
    hollow = Part("hollow", HOLE.vertices, HOLE.faces)
    with pytest.raises(InputError, match="'hollow' has no convex pieces"):
        PegPhysics(hollow, SQUARE)
    hull = Part("hull", SQUARE.vertices, SQUARE.faces)
    one = PegPhysics(HOLE, hull).start(poses(), SEARCH).advance(60)
    two = PegPhysics(HOLE, SQUARE).start(poses(), SEARCH).advance(60)
    np.testing.assert_allclose(one.world_from_peg, two.world_from_peg, atol=2e-4)
    with pytest.raises(InputError, match="shape"):
        PegPhysics(HOLE, SQUARE).start(poses()[:, :6], SEARCH)
    with pytest.raises(InputError, match="has stiffness"):
        PegPhysics(HOLE, SQUARE).start(poses(), path((0, 0, 0, 0), stiffness=np.full(6, -1.0)))

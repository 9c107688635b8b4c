"""What happens unreported on the foreign world is what it is named, and what is apparently true after it."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bcppl.recordings import problems

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from foreign import check, mechanisms, world
from foreign.arm import composed, inverse

SEED = 1  # contacts stiffer than nominal: pressed in by less than 10 um
EVERY = 60  # ticks between pressed stamps that are checked
UPRIGHT = np.array([0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def scene():
    scene = world.scene_of(SEED)
    assert mechanisms.IN_TURN[SEED % 3] == "stiffer"
    return scene


@pytest.fixture(scope="module")
def plain(scene):
    return mechanisms.made(scene, "none")


@pytest.fixture(scope="module")
def grasped(scene):
    return mechanisms.made(scene, "grasp")


@pytest.fixture(scope="module")
def slid(scene):
    return mechanisms.made(scene, "slide")


def joined(made, name):
    return np.concatenate([getattr(m.observation, name) for m in made.recording.measurements[2:]])


def gaps(made, world_from_peg):
    """Of a peg at poses (T, 7) to the part at the recording's truth, at pressed ticks."""
    pressed = np.flatnonzero(np.linalg.norm(made.trace.force, axis=1) > check.PRESSED)[::EVERY]
    assert len(pressed) > 20
    seen = [composed(inverse(made.recording.truth), pose) for pose in world_from_peg[pressed]]
    turns = [Rotation.from_quat(pose[3:], scalar_first=True) for pose in seen]
    part, peg = made.recording.part, made.recording.peg
    return np.array([check._gap(part, peg, p[:3], turn) for p, turn in zip(seen, turns, strict=True)])


def felt(scene, name, force):
    """What seven touches of 0.4 s with a force (3,) on an upright peg do."""
    reality = mechanisms.Reality(scene, mechanisms.MECHANISMS[name])
    point = scene.truth[:3]
    for tick in range(7 * 600 + 1):
        pressed = tick % 600 >= 200
        reality.felt(UPRIGHT, np.array(force) if pressed else np.zeros(3), point)
    return reality.trace


def middles(scene, trace):
    """The part's middle (T, 3) in the world, tick by tick."""
    poses, middle = trace.world_from_part, scene.foreign.part.vertices.mean(axis=0)
    return poses[:, :3] + Rotation.from_quat(poses[:, 3:], scalar_first=True).apply(middle)


def turned(first, last):
    """The angle between two poses (7,), rad."""
    turns = [Rotation.from_quat(pose[3:], scalar_first=True) for pose in (first, last)]
    return (turns[0].inv() * turns[1]).magnitude()


@pytest.mark.long
def test_without_a_mechanism_the_recording_is_that_of_the_foreign_world(scene, plain):
    log = world.log_of(scene, "presses", "stiffer")
    usual = world.recording_of(scene, "presses", "stiffer", mechanisms.RATE, log)
    for name in ("times", "wrench", "world_from_peg"):
        expected = np.concatenate([getattr(m.observation, name) for m in usual.measurements[2:]])
        np.testing.assert_array_equal(joined(plain, name), expected)
    np.testing.assert_allclose(plain.apparent, scene.truth, atol=1e-12)
    assert problems(plain.recording) == []


@pytest.mark.long
def test_a_peg_that_is_off_in_the_hand_touches_where_it_is_and_not_where_it_is_measured(grasped):
    assert np.abs(gaps(grasped, grasped.world_from_true_peg)).max() < 2e-5
    assert np.abs(gaps(grasped, grasped.log.world_from_peg)).max() > 1e-4
    held = grasped.trace.stated_from_peg[0]
    grip = composed(held, np.append(mechanisms.GRIP, [1.0, 0.0, 0.0, 0.0]))[:3]
    assert np.linalg.norm(grip - mechanisms.GRIP) == pytest.approx(4e-4)
    assert turned(mechanisms.turned_about_grip(np.zeros(3), np.zeros(3)), held) == pytest.approx(
        np.radians(0.5)
    )


@pytest.mark.long
def test_a_sudden_slide_moves_the_part_in_one_pressed_touch(scene, slid):
    way = middles(scene, slid.trace)
    moving = np.flatnonzero(np.linalg.norm(np.diff(way, axis=0), axis=1))
    assert len(moving) == 10 and moving[-1] - moving[0] == 9
    assert np.linalg.norm(way[-1] - way[0]) == pytest.approx(3e-4) and way[-1, 2] == pytest.approx(way[0, 2])
    assert turned(*slid.trace.world_from_part[[0, -1]]) == pytest.approx(np.radians(0.5))
    assert np.linalg.norm(slid.trace.force[moving[0]]) > 2.0
    np.testing.assert_array_equal(slid.recording.truth, scene.truth)
    assert np.abs(gaps(slid, slid.world_from_true_peg)).max() < 2e-5
    assert np.abs(gaps(slid, slid.log.world_from_peg)).max() > 5e-5


def test_small_slides_move_the_part_a_little_in_every_touch(scene):
    way = middles(scene, felt(scene, "small_slides", [3.0, 0.0, 4.0]))
    moving = np.flatnonzero(np.linalg.norm(np.diff(way, axis=0), axis=1))
    spans = np.split(moving, 1 + np.flatnonzero(np.diff(moving) > 1))
    assert len(spans) == 7
    for span in spans:
        slide = way[span[-1] + 1] - way[span[0]]
        assert 5e-5 < np.linalg.norm(slide) < 1e-4
        assert slide[0] < 0.0 and slide[2] == pytest.approx(0.0, abs=1e-12)  # the peg pushes along -x


@pytest.mark.parametrize("force", [[3.0, 0.0, 0.0], [0.0, 0.0, 5.0], [0.0, -3.0, 4.0]])
def test_a_peg_that_creeps_gives_by_300_um_at_its_tip_along_the_force(scene, force):
    held = felt(scene, "creep", force).stated_from_peg
    tip = np.array([0.0, 0.0, -world.LENGTH, 1.0, 0.0, 0.0, 0.0])
    given = composed(held[-1], tip)[:3] - tip[:3]
    expected = 3e-4 * np.array(force) / np.linalg.norm(force)
    np.testing.assert_allclose(given, expected, atol=5e-6)
    assert turned(held[0], held[-1]) == pytest.approx(0.5 * np.linalg.norm(expected[:2]) / 0.06, rel=0.01)


def test_play_is_taken_up_by_the_force_and_given_back_without_one():
    force = np.zeros((200, 3))
    force[50:150] = [0.0, -3.0, 4.0]
    away = mechanisms.taken_up(force)
    np.testing.assert_allclose(away[149], 1e-4 * np.array([0.0, -0.6, 0.8]), atol=1e-8)
    np.testing.assert_allclose(away[[49, 199]], 0.0, atol=1e-7)


def test_a_rough_field_is_the_same_after_a_period_and_other_before_it(scene):
    measured = mechanisms.rough_kinematics(np.random.default_rng(0))
    along = np.random.default_rng(0)
    along.uniform(size=6)
    axis = Rotation.from_rotvec(along.standard_normal(3)).inv().apply([mechanisms.PERIOD, 0.0, 0.0])
    poses = np.tile(scene.truth, (3, 1))
    poses[1, :3], poses[2, :3] = poses[0, :3] + 0.25 * axis, poses[0, :3] + axis
    off = measured(poses) - poses
    np.testing.assert_allclose(off[2], off[0], atol=1e-12)
    assert 1e-5 < np.linalg.norm(off[1, :3] - off[0, :3]) < 2 * np.sqrt(3) * 2e-4
    assert all(
        0.0 < turned(*pair) < np.radians(0.02 * 3**0.5) for pair in zip(poses, measured(poses), strict=True)
    )


@pytest.mark.parametrize("name", ["grasped", "slid"])
def test_who_takes_the_peg_to_be_where_it_is_measured_inserts_it_by_the_apparent_pose(request, name):
    made = request.getfixturevalue(name)
    after, held = made.trace.world_from_part[-1], made.trace.stated_from_peg[-1]
    true = composed(inverse(after), composed(made.world_from_peg, held))
    np.testing.assert_allclose(composed(inverse(made.apparent), made.world_from_peg), true, atol=1e-12)
    tip = composed(made.world_from_peg, np.array([0.0, 0.0, -world.LENGTH, 1.0, 0.0, 0.0, 0.0]))
    hole = 1e-3 * np.array(mechanisms.HOLES[made.recording.part.name])
    np.testing.assert_allclose(composed(inverse(after), tip)[:3], hole, atol=1e-12)
    off = np.linalg.norm((made.apparent - made.recording.truth)[:3])
    assert 1e-4 < off < 2e-3


def test_a_mechanism_is_drawn_the_same_alone_and_with_another(scene, grasped):
    both = mechanisms.Reality(scene, mechanisms.MECHANISMS["grasp_and_slide"])
    np.testing.assert_array_equal(both.stated_from_peg, grasped.trace.stated_from_peg[0])

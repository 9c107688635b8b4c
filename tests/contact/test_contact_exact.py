"""Contact against closed form: location, force, momentum, friction, and which peg fits into which hole.

Each case runs with the fine settings that worlds are simulated with and with the coarser ones of inference.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics, Rollout
from bcppl.contact.sensing.location import ContactSensing
from bcppl.geometry.extrusion import block, block_with_hole, box_peg, cylinder_peg, peg_for
from bcppl.geometry.holes import hole_of
from bcppl.geometry.outlines import named_outline
from bcppl.geometry.parts import Part, Piece
from bcppl.models.parts import insert_peg, insert_tray
from bcppl.robot.motion import Probe

FINE = ContactParameters(time_step=0.0005, friction=0.2, time_constant=0.003)
COARSE = ContactParameters()
both = pytest.mark.parametrize("parameters", [FINE, COARSE], ids=["fine", "coarse"])
SOFT, STIFF = (3 * [2000.0] + 3 * [60.0]), (3 * [2000.0] + 3 * [2000.0])


def pressed(
    part: Part,
    peg: Part,
    parameters: ContactParameters,
    *knots: tuple[float, float, float, float],
    stiffness: list[float] = STIFF,
    turn: Rotation | None = None,
    stamps: Array | None = None,
) -> Rollout:
    """A peg led through (time, x, y, z) of its origin at a fixed rotation, read at the end or at stamps."""
    path = np.array(knots)
    command = np.zeros((len(path), 7))
    command[:, :3] = path[:, 1:]
    command[:, 3:] = (Rotation.identity() if turn is None else turn).as_quat()[[3, 0, 1, 2]]
    k = np.array(stiffness)
    damping = 2.0 * np.sqrt(k * np.array(3 * [2.2] + 3 * [0.02]))
    read = path[-1:, 0] - 0.002 if stamps is None else stamps
    probe = Probe("press", path[:, 0], command, k, damping, read)
    pose = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64)
    return PegPhysics(part, peg, parameters, share_free_motion=False).start(pose, probe).advance(len(read))


def located(peg: Part, wrench: Array) -> Array:
    return np.asarray(ContactSensing(peg, rate=100.0).locate(wrench[None])[0])


def ball(radius: float, length: float) -> Part:
    """A stick's ball, an icosphere with a corner at its lowest point, 50 mm below the sensor."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    lowest = sphere.vertices[np.argmin(sphere.vertices[:, 2])]
    turn, _ = Rotation.align_vectors([[0.0, 0.0, -1.0]], [lowest / radius])
    vertices = turn.apply(sphere.vertices) - [0.0, 0.0, length - radius]
    return Part("ball", vertices, np.asarray(sphere.faces), [Piece("hull", vertices)])


@both
def test_a_sphere_pressed_on_a_plane(parameters: ContactParameters) -> None:
    peg = ball(0.008, 0.05)
    slope = Rotation.from_euler("y", 20.0, degrees=True)
    for turn in (Rotation.identity(), slope):
        # The lowest point of the ball, wherever the stick leans, is below the ball's centre.
        down, centre = turn.inv().apply([0.0, 0.0, -1.0]), np.array([0.0, 0.0, -0.042])
        height = 0.008 - turn.apply(centre)[2]
        path = (
            (0.0, 0.0, 0.0, height + 0.001),
            (0.3, 0.0, 0.0, height - 0.003),
            (1.0, 0.0, 0.0, height - 0.003),
        )
        rollout = pressed(block((0.1, 0.1, 0.02)), peg, parameters, *path, turn=turn)
        wrench = rollout.wrench[0, 0]
        force = turn.apply(wrench[:3])
        assert force[2] == pytest.approx(2000.0 * 0.003, rel=0.02)
        np.testing.assert_allclose(located(peg, wrench), centre + 0.008 * down, atol=1e-4)


@both
@pytest.mark.parametrize("overhang", [0.004, 0.012])
def test_a_peg_on_a_ledge(parameters: ContactParameters, overhang: float) -> None:
    # Only a strip of the tip, 16 mm wide less the overhang, stands on the ledge; the peg tips over its edge.
    part, peg = block((0.1, 0.1, 0.02)), box_peg(0.016, 0.05)
    x = 0.05 - 0.008 + overhang
    path = ((0.0, x, 0.0, 0.051), (0.3, x, 0.0, 0.047), (1.0, x, 0.0, 0.047))
    # Held about its own end so softly that it tilts until the edge alone carries it.
    rollout = pressed(part, peg, parameters, *path, stiffness=[200.0, 2e4, 2000.0, 20.0, 0.5, 20.0])
    wrench, pose = rollout.wrench[0, 0], rollout.world_from_peg[0, 0]
    turn = Rotation.from_quat(pose[[4, 5, 6, 3]])
    edge = turn.inv().apply(np.array([0.05, 0.0, 0.0]) - pose[:3])
    tilt = turn.as_rotvec()[1]
    if overhang > 0.008:  # beyond the middle: it stands on the ledge's edge alone
        assert abs(tilt) > 0.002
        assert located(peg, wrench)[0] == pytest.approx(edge[0], abs=1e-4)
        assert turn.apply(wrench[:3])[2] == pytest.approx(2000.0 * (pose[2] - 0.047), rel=0.02)
    else:  # the spring's moment about the middle keeps it flat
        assert abs(tilt) < 0.002
        assert turn.apply(wrench[:3])[2] == pytest.approx(2000.0 * 0.003, rel=0.02)


@both
def test_a_peg_that_leans_on_two_points(parameters: ContactParameters) -> None:
    # Two rails, 30 and 14 mm from the pressing line, carry a flat peg like a beam.
    rails = []
    for x in (-0.03, 0.014):
        foot = [[x + side, y, -0.02] for side in (-0.01, 0.01) for y in (-0.01, 0.01)]
        rails.append(Piece("hull", np.array([[x, -0.01, 0.0], [x, 0.01, 0.0], *foot])))
    mesh = trimesh.util.concatenate([trimesh.convex.convex_hull(r.size) for r in rails])
    part = Part("rails", np.asarray(mesh.vertices), np.asarray(mesh.faces), rails)
    peg = box_peg(0.08, 0.05, breadth=0.01)
    free = [2000.0, 2000.0, 2000.0, 20.0, 1e-6, 20.0]  # free to turn about y: pure statics
    path = ((0.0, 0.0, 0.0, 0.051), (0.3, 0.0, 0.0, 0.047), (2.0, 0.0, 0.0, 0.047))
    rollout = pressed(part, peg, parameters, *path, stiffness=free)
    wrench = rollout.wrench[0, 0]
    assert wrench[2] == pytest.approx(6.0, rel=0.02)
    # Nothing holds the peg about y, so the two forces' resultant passes through the sensor's axis.
    assert located(peg, wrench)[0] == pytest.approx(0.0, abs=1e-4)
    # Held against tilting and turned by an angle, the moment shifts the resultant by moment over force.
    stiff = [2000.0, 2000.0, 2000.0, 20.0, 50.0, 20.0]
    for angle in (-0.001, 0.0005):
        rollout = pressed(
            part, peg, parameters, *path, stiffness=stiff, turn=Rotation.from_rotvec([0.0, angle, 0.0])
        )
        wrench, pose = rollout.wrench[0, 0], rollout.world_from_peg[0, 0]
        moment = 50.0 * (angle - Rotation.from_quat(pose[[4, 5, 6, 3]]).as_rotvec()[1])
        pulled = 2000.0 * pose[0]  # sideways by the spring, 50 mm above the tip
        assert wrench[4] == pytest.approx(-moment, rel=0.02)
        assert located(peg, wrench)[0] == pytest.approx((moment - 0.05 * pulled) / wrench[2], abs=1e-4)
        lever = (0.03 + located(peg, wrench)[0]) / 0.044
        assert 0.0 < lever < 1.0  # the right rail's share of the force: both carry


@both
def test_the_impulse_of_a_free_impact_is_the_change_of_momentum(parameters: ContactParameters) -> None:
    # A held peg runs at 0.1 m/s against a floor; the arm lets it rebound: over any stretch of time,
    # the impulses of the environment and of the spring add up to the change of momentum.
    stamps = np.arange(0.0, 0.6, parameters.time_step)
    path = ((0.0, 0.0, 0.0, 0.06), (0.3, 0.0, 0.0, 0.03), (0.601, 0.0, 0.0, 0.03))
    soft = [50.0, 50.0, 50.0, 60.0, 60.0, 60.0]
    rollout = pressed(
        block((0.1, 0.1, 0.02)), box_peg(0.016, 0.05), parameters, *path, stiffness=soft, stamps=stamps
    )
    height, sensed = rollout.world_from_peg[0, :, 2], rollout.wrench[0, :, 2]
    speed = np.gradient(height, stamps)
    commanded = np.interp(stamps, [0.0, 0.3, 0.6], [0.06, 0.03, 0.03])
    rate = np.where(stamps < 0.3, -0.1, 0.0)
    spring = 50.0 * (commanded - height) + 2.0 * math.sqrt(50.0 * 2.2) * (rate - speed)
    hit = int(np.argmax(height < 0.05))
    first, last = hit - int(0.02 / parameters.time_step), hit + int(0.05 / parameters.time_step)
    # The sensor is between arm and tool: arm's momentum = sensed by it + spring.
    impulse = np.sum(sensed[first:last] + spring[first:last]) * parameters.time_step
    assert speed[first] < -0.08
    assert impulse == pytest.approx(parameters.arm_mass * (speed[last] - speed[first]), rel=0.02)


@both
@pytest.mark.parametrize("reach", [0.0002, 0.004])
def test_friction_stays_in_its_cone_and_sliding_is_on_it(parameters: ContactParameters, reach: float) -> None:
    path = (
        (0.0, 0.0, 0.0, 0.051),
        (0.3, 0.0, 0.0, 0.047),
        (0.5, 0.0, 0.0, 0.047),
        (1.0, reach, 0.5 * reach, 0.047),
        (1.2, reach, 0.5 * reach, 0.047),
    )
    stamps = np.arange(0.4, 1.2, 0.01)
    rollout = pressed(block((0.1, 0.1, 0.02)), box_peg(0.016, 0.05), parameters, *path, stamps=stamps)
    force = rollout.wrench[0, :, :3]
    ratio = np.hypot(force[:, 0], force[:, 1]) / force[:, 2]
    # Where the command starts and stops the sensor also measures the tool's inertial force.
    steady = (stamps < 0.5) | ((stamps > 0.65) & (stamps < 1.0)) | (stamps > 1.1)
    assert (ratio[steady] <= 1.01 * parameters.friction).all()
    moved = rollout.world_from_peg[0, -1, 0]
    if reach > 0.001:  # the spring's 2000 N/m overcome friction: it slides, on the cone, against the motion
        sliding = (stamps > 0.8) & (stamps < 0.995)
        np.testing.assert_allclose(ratio[sliding], parameters.friction, rtol=0.02)
        np.testing.assert_allclose(force[sliding, 1] / force[sliding, 0], 0.5, rtol=0.02)
        assert (force[sliding, 0] < 0).all()
        # Peg and command move alike, so only the spring pulls: its deflection is that of friction.
        lag = reach * (stamps[sliding] - 0.5) / 0.5 - rollout.world_from_peg[0, sliding, 0]
        np.testing.assert_allclose(lag, 0.003 * parameters.friction / math.hypot(1, 0.5), rtol=0.03)
        assert 0.0 < reach - moved < 1.01 * lag.mean()
    else:  # it does not: the peg sticks, and friction is the spring's force
        assert moved < 5e-6
        assert -force[-1, 0] == pytest.approx(2000.0 * (reach - moved), rel=0.02)


def depth_reached(
    part: Part, peg: Part, parameters: ContactParameters, offset: Array, top: float, stiffness: float
) -> Array:
    """The share (N,) of 8 mm that a peg goes in that is led straight down, off by offsets (N, 2).

    It is pressed with 8 N at the most. A lateral stiffness of 2e5 N/m holds it: to be pushed by the 0.1 mm
    that 0.15 mm of offset lack, it takes 20 N, more than a chamfer of 45 degrees makes of 8 N.
    """
    tip, depth = 0.05 + top, 0.008
    path = np.array([[0.0, tip + 0.0005], [0.03, tip + 0.0005], [0.23, tip - depth], [0.45, tip - depth]])
    command = np.zeros((4, 7))
    command[:, 2], command[:, 3] = path[:, 1], 1.0
    k = np.array([stiffness, stiffness, 1000.0, 500.0, 500.0, 500.0])
    damping = 2.0 * np.sqrt(k * np.array(3 * [2.2] + 3 * [0.02]))
    probe = Probe("insert", path[:, 0], command, k, damping, np.array([0.448]))
    pose = torch.zeros(len(offset), 7, dtype=torch.float64)
    pose[:, 3], pose[:, :2] = 1.0, torch.from_numpy(offset)
    rollout = PegPhysics(part, peg, parameters, share_free_motion=False).start(pose, probe).advance(1)
    assert not rollout.diverged.any()
    return np.asarray((tip - rollout.world_from_peg[:, -1, 2]) / depth)


OFFSETS = np.array([[0.0, 0.0], [0.00015, 0.0], [0.0, -0.00015], [0.00004, 0.0]])


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        *((name, COARSE) for name in ("round", "cylinder", "square", "hexagon", "keyway")),
        ("cylinder", FINE),
        ("hexagon", FINE),
    ],
)
def test_a_hole_of_a_tenth_of_clearance_admits_its_peg_aligned_only(
    name: str, parameters: ContactParameters
) -> None:
    hole = named_outline("round" if name == "cylinder" else name, 0.0161)
    peg = cylinder_peg(0.016, 0.05) if name == "cylinder" else peg_for(hole, 0.0001, 0.05)
    reached = depth_reached(block_with_hole(hole), peg, parameters, OFFSETS, 0.0, 2e5)
    assert (reached[[0, 3]] > 0.9).all()
    assert (reached[1:3] < 0.02).all()


@pytest.mark.parametrize(
    ("shape", "parameters"), [("round", COARSE), ("rectangular", COARSE), ("rectangular", FINE)]
)
def test_the_insert_trays_admit_a_peg_of_a_tenth_of_clearance_aligned_only(
    shape: str, parameters: ContactParameters
) -> None:
    tray = insert_tray(shape)
    peg = peg_for(hole_of(tray).outline.simplify(5e-6), 0.0001, 0.05)
    reached = depth_reached(tray, peg, parameters, OFFSETS[:2], 0.028, 2e5)
    assert reached[0] > 0.9
    assert reached[1] < 0.15  # it stands on the chamfer, 1 mm deep
    own = depth_reached(tray, insert_peg(shape), parameters, 2.0 * OFFSETS[:2], 0.028, 2e5)
    assert (own > 0.9).all()  # its own peg has a millimetre of clearance

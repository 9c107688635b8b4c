"""Nuisance parameters: exact presses and slides, frames, and that equal values change nothing."""

from __future__ import annotations

import warnings
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses
from bcppl.contact import stepping
from bcppl.contact.nuisances import Nuisances
from bcppl.contact.particle_models import ParticleModels
from bcppl.contact.physics import PegPhysics, Rollout
from bcppl.contact.probe_rollout import ProbeRollout
from bcppl.contact.sensing.location import ContactSensing
from bcppl.distributions.contact import ChamferContacts
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, box_peg
from bcppl.geometry.parts import Part, Piece
from bcppl.robot.motion import Probe
from tests.contact.contact_probes import DAMPING, HOLE, SEARCH, STIFFNESS, path, same

PEG = box_peg(0.016, 0.05)
TABLE = block((0.1, 0.1, 0.02))
PRESS = path((0, 0, 0, 0.055), (0.5, 0, 0, 0.047), (1.5, 0, 0, 0.047))


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def pressed(nuisances: Nuisances, particles: int, probe: Probe = PRESS, part: Part = TABLE) -> Rollout:
    return (
        PegPhysics(part, PEG)
        .start(poses.identity(particles), probe, nuisances)
        .advance(len(probe.stamps) - 1)
    )


@cache
def around() -> Tensor:
    generator = torch.Generator().manual_seed(3)
    shifts = torch.zeros(6, 6, dtype=torch.float64)
    shifts[:, :3] = 0.002 * torch.randn(6, 3, generator=generator, dtype=torch.float64)
    return poses.retract(poses.identity(6), shifts)


def mixed() -> Nuisances:
    """Every unknown, different for every particle."""
    step = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)
    turn = torch.stack([step, -step, 0.5 * step, 10 * step, -5 * step, 30 * step], dim=1) * 0.002
    return Nuisances(
        friction=0.2 + 0.2 * step,
        time_constant=0.004 + 0.004 * step,
        damping_ratio=1.0 + 0.3 * step,
        stiffness=0.8 + 0.4 * step,
        damping=(1.0 + 0.2 * step)[:, None].expand(6, 6),
        grasp_compliance=1e-5 * step[:, None] * numbers(1, 1, 1, 50, 50, 50),
        grip_from_peg=poses.retract(poses.identity(6), turn),
    )


@pytest.mark.parametrize("skip", [True, False])
def test_equal_values_change_nothing_to_the_bit(skip: bool) -> None:
    physics = PegPhysics(HOLE, PEG, share_free_motion=skip)
    plain, one = physics.start(around(), SEARCH).advance(120), torch.ones(6, dtype=torch.float64)
    known = physics.parameters
    in_contact = Nuisances(
        friction=known.friction * one,
        time_constant=known.time_constant * one,
        damping_ratio=known.damping_ratio * one,
        grip_from_peg=poses.identity(6),
    )
    same(plain, physics.start(around(), SEARCH, in_contact).advance(120))
    rigid = torch.zeros(6, 6, dtype=torch.float64)
    everything = {"stiffness": one, "damping": one, "grasp_compliance": rigid}
    same(plain, physics.start(around(), SEARCH, Nuisances(**in_contact.given, **everything)).advance(120))
    same(plain, physics.start(around(), SEARCH, Nuisances()).advance(120))
    # What was set for one program is not left behind for the next.
    physics.start(around(), SEARCH, Nuisances(friction=0.0 * one)).advance(120)
    same(plain, physics.start(around(), SEARCH).advance(120))
    same(plain, physics.start(around(), SEARCH, Nuisances(stiffness=one)).advance(120))


def merged_where(mask: Tensor, one: Nuisances, other: Nuisances) -> Nuisances:
    pairs = [(name, value, other.given[name]) for name, value in one.given.items()]
    return Nuisances(**{n: torch.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b) for n, a, b in pairs})


def test_many_particles_share_a_bounded_number_of_models(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = PegPhysics(HOLE, PEG).start(around(), SEARCH, mixed()).advance(120)
    made, copied = [], ParticleModels._copied
    monkeypatch.setattr(ParticleModels, "_copied", lambda self: made.append(self) or copied(self))
    monkeypatch.setattr(stepping, "_COPIES", 4)
    same(whole, PegPhysics(HOLE, PEG).start(around(), SEARCH, mixed()).advance(50).advance(120))
    assert max(map(made.count, made)) == 4


def test_chunks_order_and_merging_change_nothing() -> None:
    physics, nuisances = PegPhysics(HOLE, PEG), mixed()
    whole = physics.start(around(), SEARCH, nuisances).advance(120)
    assert (abs(whole.wrench[..., 2]).max(axis=1) > 1.0).all()
    for particle in (0, 5):
        alone = physics.start(around()[[particle]], SEARCH, nuisances[torch.tensor([particle])]).advance(120)
        same(whole[torch.tensor([particle])], alone)
    order = torch.tensor([4, 1, 5, 1])
    same(whole[order], physics.start(around(), SEARCH, nuisances).advance(50)[order].advance(73).advance(120))
    mask = torch.tensor([True, False, True, True, False, False])
    back = nuisances[torch.arange(5, -1, -1)]
    one, two = physics.start(around(), SEARCH, nuisances), physics.start(around(), SEARCH, back)
    before = one.advance(40).wrench.copy()
    merged = one.where(mask, two.advance(70)).advance(120)
    same(merged, physics.start(around(), SEARCH, merged_where(mask, nuisances, back)).advance(120))
    np.testing.assert_array_equal(one.wrench[:, :40], before)
    same(one.advance(120), whole)
    with pytest.raises(ValueError, match="cannot be merged"):
        one.where(mask, physics.start(around(), SEARCH))


def test_shared_free_motion_changes_nothing_and_saves_time() -> None:
    some, every = around()[:3], mixed()[torch.tensor([1, 3, 5])].given
    shared = {n: every[n] for n in ("friction", "time_constant", "damping_ratio", "grip_from_peg")}
    for given, saves in ((shared, True), ({"stiffness": every["stiffness"]}, False), (every, False)):
        skipping, whole = PegPhysics(HOLE, PEG), PegPhysics(HOLE, PEG, share_free_motion=False)
        one = skipping.start(some, SEARCH, Nuisances(**given)).advance(120)
        same(one, whole.start(some, SEARCH, Nuisances(**given)).advance(120))
        assert (skipping.effort.amount < 0.8 * whole.effort.amount) == saves


def test_the_free_motion_of_a_displaced_peg_ends_before_contact() -> None:
    # 20 mm lower than planned, or lying on its side, the peg touches long before a planned one would.
    offset = poses.identity(3)
    offset[1, 2] = -0.02
    offset[2, 3:] = numbers(*Rotation.from_euler("y", 90, degrees=True).as_quat()[[3, 0, 1, 2]])
    part = poses.identity(3)
    part[2, :3] = numbers(-0.08, 0.0, 0.06)
    probe = path((0, 0, 0, 0.09), (0.5, 0, 0, 0.047), (1.0, 0, 0, 0.047))
    one, two = (
        PegPhysics(TABLE, PEG, share_free_motion=skip)
        .start(part, probe, Nuisances(grip_from_peg=offset))
        .advance(100)
        for skip in (True, False)
    )
    same(one, two)
    first = (abs(two.wrench[..., 2]) > 1.0).argmax(axis=1) / 100
    # Lowered at 86 mm/s, from 90 mm to where each one's lowest point meets the part.
    np.testing.assert_allclose(first, np.array([0.04, 0.02, 0.022]) / 0.086, atol=0.02)


def test_friction_doubled_doubles_the_sliding_force() -> None:
    probe = path((0, -0.015, 0, 0.055), (0.6, -0.015, 0, 0.047), (1.6, -0.005, 0, 0.047))
    force = pressed(Nuisances(friction=numbers(0.1, 0.2, 0.0)), 3, probe).wrench[:, 130:150]
    np.testing.assert_allclose(-force[:2, :, 0], [[0.1], [0.2]] * force[:2, :, 2], rtol=0.01)
    assert abs(force[2, :, 0]).max() < 0.01


def test_the_force_of_a_press_is_the_unknown_stiffness_times_the_displacement() -> None:
    factors = torch.ones(4, 6, dtype=torch.float64)
    factors[:, 2] = numbers(1.0, 0.5, 2.0, 3.0)
    rollout = pressed(Nuisances(stiffness=factors), 4)
    force, height = rollout.wrench[:, -1, 2], rollout.world_from_peg[:, -1, 2]
    np.testing.assert_allclose(force, 2000 * factors[:, 2].numpy() * (height - 0.047), rtol=1e-3)
    np.testing.assert_allclose(force, 2000 * factors[:, 2].numpy() * 0.003, rtol=0.03)
    same(
        pressed(Nuisances(stiffness=numbers(2.0)), 1),
        pressed(Nuisances(stiffness=torch.full((1, 6), 2.0)), 1),
    )


def test_damping_slows_the_peg_and_moves_no_place_of_rest() -> None:
    start = path((0, 0, 0, 0.2), (0.001, 0.01, 0, 0.2), (1.5, 0.01, 0, 0.2))
    start = Probe("step", start.command_times, start.command, STIFFNESS, DAMPING, start.stamps)
    place = pressed(Nuisances(damping=numbers(1.0, 6.0)), 2, start).world_from_peg[..., 0]
    # 6 * 80 N s/m against 1500 N/m: a time constant of about 0.3 s, where 80 N s/m follows within 0.1 s.
    assert abs(place[0, 30:] - 0.01).max() < 5e-4 and abs(place[0, 145] - 0.01) < 1e-6
    slow = np.log(abs(place[1, 60] - 0.01) / abs(place[1, 30] - 0.01)) / 0.3
    roots = np.roots([2.2, 480.0, 1500.0])
    assert slow == pytest.approx(roots.real.max(), rel=0.02)


def test_a_grasp_s_compliance_is_in_series_with_the_controller() -> None:
    compliance = torch.zeros(4, 6, dtype=torch.float64)
    compliance[:, 2] = numbers(0.0, 1e-5, 1e-4, 5e-4)
    rollout = pressed(Nuisances(grasp_compliance=compliance), 4)
    force, height = rollout.wrench[:, -1, 2], rollout.world_from_peg[:, -1, 2]
    np.testing.assert_allclose(force, 0.003 / (1 / 2000 + compliance[:, 2].numpy()), rtol=0.015)
    # The hand is where the controller's own spring puts it, and nearer to the table than the peg's length.
    np.testing.assert_allclose(force, 2000 * (height - 0.047), rtol=1e-3)
    np.testing.assert_allclose(height[0] - height, compliance[:, 2].numpy() * force, atol=1e-5)


def test_a_grasp_that_turns_changes_the_wrench_at_the_sensor() -> None:
    # Pushed 4 mm into a wall, the peg's tip stays and the hand turns about it as both springs allow.
    probe = path((0, 0, 0, 0), (1.0, 0.026, 0, 0), (3.0, 0.026, 0, 0))
    wall = poses.identity(2)
    wall[:, :3] = numbers(0.08, 0.0, -0.04)
    compliance = torch.zeros(2, 6, dtype=torch.float64)
    compliance[1, 4] = 0.02
    rollout = PegPhysics(block((0.1, 0.1, 0.1)), PEG).start(
        wall, probe, Nuisances(grasp_compliance=compliance)
    )
    wrench, grip = rollout.advance(300).wrench[:, -1], rollout.world_from_peg[:, -1]
    turned = Rotation.from_quat(grip[:, [4, 5, 6, 3]]).as_rotvec()
    # At rest the controller's springs carry all of the wrench, which is in the grip's own axes.
    force = Rotation.from_quat(grip[:, [4, 5, 6, 3]]).apply(wrench[:, :3])
    np.testing.assert_allclose(force[:, 0], 1500 * (grip[:, 0] - 0.026), rtol=1e-3)
    np.testing.assert_allclose(wrench[:, 4], 50 * turned[:, 1], rtol=0.01)
    lever = wrench[:, 4] / wrench[:, 0]
    expected = 0.004 / (1 / 1500 + lever**2 * (1 / 50 + compliance[:, 4].numpy()))
    np.testing.assert_allclose(-wrench[:, 0], expected, rtol=0.01)
    # The peg leans in the hand by compliance times torque: its lower end is still at the wall's face.
    held = turned[:, 1] + compliance[:, 4].numpy() * wrench[:, 4]
    np.testing.assert_allclose(grip[:, 0] + 0.008 + lever * np.sin(held), 0.03, atol=3e-4)


def moved(part: Part, offset: Tensor) -> Part:
    """A part whose surface is placed elsewhere in its frame."""
    vertices = poses.transform(offset, torch.from_numpy(part.vertices)).numpy()
    return Part("moved", vertices, part.faces, [Piece("hull", vertices)])


@pytest.mark.parametrize("twist", [[1, 0, 0, 0, 0, 0], [0, 2, -1, 0, 0, 0], [1, -1, 1, 20, -30, 200]])
def test_an_offset_in_the_hand_is_a_peg_whose_surface_is_elsewhere(twist: list[float]) -> None:
    offset = poses.retract(poses.identity(), 0.001 * numbers(*twist))
    hull = moved(PEG, poses.identity())
    probe = path((0, 0.03, 0, 0.05), (0.8, 0.02, 0, 0.046), (1.2, 0.02, 0, 0.044), (2.0, 0.015, 0.003, 0.044))
    nuisances = Nuisances(grip_from_peg=offset[None])
    one = PegPhysics(HOLE, hull).start(poses.identity(1), probe, nuisances).advance(200)
    two = PegPhysics(HOLE, moved(PEG, offset)).start(poses.identity(1), probe).advance(200)
    assert abs(two.wrench[0, 100:, 2]).min() > 1.0
    # The tool's mass goes with the surface in the one, and not in the other: seen only where it is swung.
    apart = abs(one.world_from_peg - two.world_from_peg).max()
    np.testing.assert_allclose(one.wrench[0, 190], two.wrench[0, 190], atol=0.03)
    plain = PegPhysics(HOLE, hull).start(poses.identity(1), probe).advance(200)
    assert apart < 0.1 * abs(plain.world_from_peg - two.world_from_peg).max() and apart < 3e-5
    # A box in the hand and its hull are the same peg, but MuJoCo puts a flat contact's points elsewhere.
    boxed = PegPhysics(HOLE, PEG).start(poses.identity(1), probe, nuisances).advance(200)
    np.testing.assert_allclose(boxed.world_from_peg, one.world_from_peg, atol=5e-4)


def test_an_impossible_stiffness_diverges_alone_and_counts_as_impossible() -> None:
    part, sensing = poses.identity(4), ContactSensing(PEG, rate=100.0)
    factors = numbers(1.0, 1e7, 1.1, 1e9)
    rollout = ProbeRollout.start(PegPhysics(TABLE, PEG), sensing, part, PRESS, Nuisances(stiffness=factors))
    with pytest.warns(RuntimeWarning, match="2 of 4 rollouts of probe 'probe' diverged"):
        wrench = rollout.wrench(0, 150)
    assert rollout.diverged.tolist() == [False, True, False, True]
    assert torch.isnan(wrench[[1, 3], -1]).all() and torch.isfinite(wrench[[0, 2]]).all()
    seen = rollout.window(100, 150)[0][0]
    log_prob = ChamferContacts(rollout, 100, 150, 0.001, 1e-5).log_prob(seen)
    assert log_prob[[1, 3]].tolist() == [-np.inf] * 2 and log_prob[0] == 0.0 and torch.isfinite(log_prob[2])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = pressed(Nuisances(stiffness=factors[[0, 2]]), 2)
    np.testing.assert_array_equal(alone.wrench, wrench[[0, 2]].numpy())


def test_rollouts_are_indexed_and_merged_like_all_their_inputs() -> None:
    physics, sensing, nuisances = PegPhysics(HOLE, PEG), ContactSensing(PEG, rate=100.0), mixed()
    other = nuisances[torch.arange(5, -1, -1)]

    def start(nuisances: Nuisances, count: int) -> ProbeRollout:
        return ProbeRollout.start(physics, sensing, around(), SEARCH, nuisances).advance(count)

    def equal(one: ProbeRollout, two: ProbeRollout, rows: Tensor | slice = slice(None)) -> None:
        """The first goes on to the end; the second is whole."""
        assert torch.equal(one.wrench(0, 120), two.wrench(0, 120)[rows])
        for mine, theirs in zip(one.window(0, 120), two.window(0, 120), strict=True):
            torch.testing.assert_close(mine, theirs[rows], rtol=0, atol=0, equal_nan=True)
        for mine, theirs in zip(one.inputs, two.inputs, strict=True):
            assert torch.equal(mine, theirs[rows])

    whole, part, index = start(nuisances, 120), start(nuisances, 60), torch.tensor([3, 0, 3])
    assert len(whole.inputs) == 8 and whole.inputs[1] is nuisances.friction
    assert bool(torch.isfinite(whole.window(0, 120)[0]).any())
    equal(part[index], whole, index)
    mask = torch.tensor([True, False, True, False, False, True])
    merged = part.where(mask, start(other, 100))
    assert part.count == 100
    equal(merged, start(merged_where(mask, nuisances, other), 120))


@pytest.mark.parametrize(
    ("nuisances", "message"),
    [
        (Nuisances(friction=numbers(0.3)), r"friction .* shape \(1,\); give \(2,\)"),
        (Nuisances(friction=numbers(0.3, -0.1)), "friction .* negative"),
        (Nuisances(stiffness=numbers(1.0, np.nan)), "stiffness .* not finite"),
        (Nuisances(time_constant=numbers(0.004, 0.0)), "time_constant .* or 0"),
        (Nuisances(damping=torch.ones(2, 3)), r"\(2,\) or \(2, 6\)"),
        (Nuisances(grip_from_peg=torch.ones(2, 7)), "quaternion of length 2"),
    ],
)
def test_impossible_values_are_refused(nuisances: Nuisances, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PegPhysics(TABLE, PEG).start(poses.identity(2), PRESS, nuisances)

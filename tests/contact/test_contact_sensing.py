"""Contact locations from wrenches: known contacts, frames, chunks, and simulated recordings."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from bcppl import poses
from bcppl.contact.mujoco_model import ContactParameters
from bcppl.contact.physics import PegPhysics
from bcppl.contact.probe_rollout import ProbeRollout
from bcppl.contact.sensing.location import ContactSensing
from bcppl.contact.touch import Touch
from bcppl.distributions.contact import ChamferContacts, ContactsInTime, PegPose
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block, block_with_square_hole, box_peg, round_peg
from bcppl.robot.motion import Probe

PEG = box_peg(0.016, 0.05)
PLAIN = ContactSensing(PEG, rate=100.0, tare=0, cutoff=None)
STIFFNESS = np.array([1000.0, 1000.0, 1000.0, 50.0, 50.0, 50.0])
DAMPING = np.array([80.0, 80.0, 80.0, 2.0, 2.0, 2.0])


def wrench(point: np.ndarray, force: np.ndarray) -> np.ndarray:
    return np.concatenate([force, np.cross(point, force)], axis=-1)


def random_contacts(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points (500, 3) on the peg, and forces that push into it, up to 45 degrees off the normal."""
    rng = np.random.default_rng(seed)
    points, faces = PEG.mesh.sample(500, return_index=True, seed=seed)
    inward = -PEG.mesh.face_normals[faces]
    side = np.cross(inward, rng.normal(size=(500, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return np.asarray(points), 7.0 * (inward + rng.uniform(0, 1, (500, 1)) * side)


def test_a_contact_is_located_where_the_force_enters_the_peg() -> None:
    points, force = random_contacts()
    located = PLAIN.locate(wrench(points, force))
    np.testing.assert_allclose(located, points, atol=1e-9)
    # Mutants: a flipped force or torque, and a wrench in the wrong frame, are located elsewhere, if at all.
    turn = Rotation.from_euler("zx", [90, 30], degrees=True)
    turned = np.concatenate([turn.apply(force), turn.apply(np.cross(points, force))], axis=1)
    flip = wrench(points, force) * [-1, -1, -1, 1, 1, 1]
    for mutant in (-wrench(points, force), flip, turned):
        off = np.linalg.norm(np.nan_to_num(PLAIN.locate(mutant), nan=1.0) - points, axis=1)
        assert np.mean(off > 1e-3) > 0.8


def test_a_line_that_misses_by_little_is_located_on_the_nearest_edge() -> None:
    points = np.array(
        [[0.009, 0.002, -0.03], [0.0085, -0.0085, -0.03], [0.0081, 0.0, -0.0501], [0.011, 0, -0.03]]
    )
    force = np.array([[0, -5.0, 0], [-1.0, -1.0, 0], [-1.0, 0, -1.0], [0, -5.0, 0]])
    located = PLAIN.locate(wrench(points, force))
    np.testing.assert_allclose(located[0, [0, 2]], [0.008, -0.03], atol=1e-9)
    np.testing.assert_allclose(located[1], [0.008, -0.008, -0.03], atol=1e-9)
    np.testing.assert_allclose(located[2], [0.008, located[2, 1], -0.05], atol=1e-9)
    assert np.isnan(located[3]).all()


def test_taring_and_filtering_in_chunks_equal_the_whole() -> None:
    rng = np.random.default_rng(1)
    points, force = random_contacts()
    signal = wrench(points, force).reshape(5, 100, 6).cumsum(axis=1) / 10 + rng.normal(size=(5, 1, 6))
    sensing = ContactSensing(PEG, rate=100.0, tare=12, cutoff=10.0)
    whole, state = sensing.contacts(signal, sensing.start(5))
    assert np.isnan(whole[:, :12]).all() and np.isfinite(whole[:, 12:]).any()
    chunks, running = [], sensing.start(5)
    for first, last in ((0, 5), (5, 13), (13, 14), (14, 70), (70, 100)):
        located, running = sensing.contacts(signal[:, first:last], running)
        chunks.append(located)
    np.testing.assert_array_equal(np.concatenate(chunks, axis=1), whole)
    np.testing.assert_array_equal(running.filter, state.filter)
    rows = np.array([3, 0, 3])
    some, _ = sensing.contacts(signal[rows], sensing.start(3))
    np.testing.assert_array_equal(some, whole[rows])
    half = sensing.contacts(signal[:, :50], sensing.start(5))[1]
    some, _ = sensing.contacts(signal[rows, 50:], half[rows])
    np.testing.assert_array_equal(some, whole[rows, 50:])


def test_an_offset_of_the_sensor_changes_nothing() -> None:
    signal = np.zeros((1, 60, 6))
    signal[:, 20:] = wrench(np.array([0.003, -0.002, -0.05]), np.array([0.5, 0, 8.0]))
    sensing = ContactSensing(PEG, rate=100.0, tare=10, cutoff=20.0)
    plain, _ = sensing.contacts(signal, sensing.start(1))
    zero = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])
    offset, _ = sensing.contacts(signal + zero, sensing.start(1))
    np.testing.assert_allclose(plain[0, 40:], np.tile([0.003, -0.002, -0.05], (20, 1)), atol=1e-9)
    np.testing.assert_allclose(offset, plain, atol=1e-9)


def lean(angle: float, yaw: float = 0.0) -> Probe:
    """A peg leaning about its y axis, then turned about the world's z, pressed straight down."""
    turn = Rotation.from_euler("yz", [angle, yaw], degrees=True)
    command = np.zeros((3, 7))
    command[:, 2] = [0.06, 0.046, 0.046]
    command[:, 3:] = turn.as_quat()[[3, 0, 1, 2]]
    stamps = np.arange(0.0, 1.5, 0.01)
    stiff = STIFFNESS * [1, 1, 1, 100, 100, 100]
    return Probe("lean", np.array([0.0, 0.7, 1.5]), command, stiff, 9 * DAMPING, stamps)


@pytest.mark.parametrize("yaw", [0.0, 120.0])
def test_a_leaning_peg_touches_with_its_lowest_edge(yaw: float) -> None:
    probe = lean(20.0, yaw)
    sensing = ContactSensing(PEG, rate=100.0, tare=10, cutoff=20.0)
    part = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64)
    rollout = ProbeRollout.start(PegPhysics(block((0.2, 0.2, 0.02)), PEG), sensing, part, probe)
    contacts, pose = rollout.window(130, 150)
    local, _ = sensing.contacts(rollout.wrench(0, 150).numpy(), sensing.start(1))
    # Turned by +20 degrees about y, the edge at x = +8 mm is the lowest.
    np.testing.assert_allclose(local[0, 130:], np.tile([0.008, 0.0, -0.05], (20, 1)), atol=1e-4)
    np.testing.assert_array_equal(local[:, 130:], contacts)
    # In the world, that edge lies on the block's top face.
    np.testing.assert_allclose(poses.transform(pose[0, 0], contacts[0])[:, 2], 0.0, atol=1e-4)


def test_a_peg_on_the_rim_of_a_hole_is_in_contact_with_the_material_beneath_it() -> None:
    # Half of the peg stands over the hole: flat contact along x < 0 only, so its middle is at x <= 0.
    part = block_with_square_hole(size=(0.1, 0.1, 0.02), hole=0.03, offset=(0.015, 0.0))
    command = np.array([[0, 0, 0.055, 1, 0, 0, 0], [0, 0, 0.047, 1, 0, 0, 0]], dtype=np.float64)
    stamps = np.arange(0.0, 1.5, 0.01)
    probe = Probe("rim", np.array([0.0, 0.7]), command, STIFFNESS * 10, DAMPING * 5, stamps)
    for peg, tolerance in ((PEG, 1e-5), (round_peg(0.008, 0.05), 1e-3)):
        sensing = ContactSensing(peg, rate=100.0)
        pose = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64)
        contacts, _ = ProbeRollout.start(PegPhysics(part, peg), sensing, pose, probe).window(120, 150)
        assert (contacts[0, :, 0] < 1e-4).all() and (contacts[0, :, 0] > -0.0081).all()
        np.testing.assert_allclose(contacts[0, :, 1], 0.0, atol=tolerance)


def test_a_measured_recording_is_read_by_the_same_code() -> None:
    probe = lean(10.0, 30.0)
    sensing = ContactSensing(PEG, rate=100.0)
    part = torch.tensor([[0.0, 0, 0.001, 1, 0, 0, 0]], dtype=torch.float64)
    rollout = ProbeRollout.start(PegPhysics(block((0.2, 0.2, 0.02)), PEG), sensing, part, probe)
    whole, pose = rollout.window(0, 150)
    touches = [
        Touch(probe.stamps[a:b], rollout.wrench(a, b)[0].numpy(), rollout.window(a, b)[1][0].numpy())
        for a, b in ((0, 40), (40, 90), (90, 150))
    ]
    measured = sensing.measure(touches)
    np.testing.assert_array_equal(torch.cat([m[0] for m in measured]), whole[0])
    np.testing.assert_array_equal(torch.cat([m[1] for m in measured]), pose[0])
    kept = np.r_[0:7, 15:40]
    lost = Touch(touches[0].times[kept], touches[0].wrench[kept], touches[0].world_from_peg[kept])
    assert len(sensing.measure([lost])[0][0]) == len(kept)
    with pytest.raises(InputError, match="samples per second"):
        ContactSensing(PEG, rate=500.0).measure(touches)
    with pytest.raises(InputError, match="cutoff"):
        ContactSensing(PEG, rate=30.0)


def test_a_missing_wrench_is_refused_where_a_filter_would_carry_it_on() -> None:
    sensing, times = ContactSensing(PEG, rate=100.0), np.arange(80) / 100.0
    pose, signal = np.tile([0.0, 0, 0, 1, 0, 0, 0], (80, 1)), np.zeros((80, 6))
    signal[20:] = wrench(np.array([0.003, -0.002, -0.05]), np.array([0.5, 0, 8.0]))

    def windows(row: int, column: int) -> list[Touch]:
        bad = signal.copy()
        bad[row, column] = np.nan if column else np.inf
        return [Touch(times[a:b], bad[a:b], pose[a:b]) for a, b in ((0, 30), (30, 80))]

    for row, column, message in ((50, 4, "window 1 .* row 20"), (4, 0, "window 0 .* row 4")):
        with pytest.raises(
            InputError, match=f"{message}; fill it by interpolation, or cut the recording there"
        ):
            sensing.measure(windows(row, column))
    # Without a filter no later sample depends on it, unless it is in the tare.
    tared = torch.cat(sensing.tared(windows(50, 4)))
    assert torch.isnan(tared).any(dim=1).nonzero().flatten().tolist() == [*range(10), 50]
    with pytest.raises(InputError, match=r"window 0 .* row 4"):
        sensing.tared(windows(4, 0))
    # A simulation that diverged has no contact from there on.
    lost, _ = sensing.contacts(np.where(np.arange(80)[:, None] < 50, signal, np.nan)[None], sensing.start(1))
    assert torch.from_numpy(lost[0]).isfinite().all(dim=-1).nonzero().max() == 49
    pose[7, 2] = np.nan
    with pytest.raises(InputError, match="window 0 has a peg pose that is not finite at row 7"):
        sensing.measure(windows(50, 4))


@pytest.mark.parametrize(
    "bad",
    [
        {"friction": math.nan},
        {"friction": -1.0},
        {"miss_tolerance": math.nan},
        {"threshold": math.inf},
        {"tare": 2.5},
        {"tare": -1},
        {"rate": math.nan},
    ],
)
def test_settings_out_of_range_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"sensing has {next(iter(bad))} = "):
        ContactSensing(PEG, **({"rate": 100.0} | bad))


def test_a_peg_may_be_doubled_at_its_seams_but_not_open() -> None:
    with pytest.raises(InputError, match="open mesh"):
        ContactSensing(replace(PEG, faces=PEG.faces[:-2]), rate=100.0)
    seams = replace(
        PEG, vertices=PEG.vertices[PEG.faces].reshape(-1, 3), faces=np.arange(PEG.faces.size).reshape(-1, 3)
    )
    points, force = random_contacts()
    np.testing.assert_allclose(
        ContactSensing(seams, rate=100.0).locate(wrench(points, force)),
        PLAIN.locate(wrench(points, force)),
        atol=1e-12,
    )


def test_contacts_are_those_of_the_window_s_wrench() -> None:
    probe, sensing = lean(20.0), ContactSensing(PEG, rate=100.0)
    part = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0], [0.0, 0, -1, 1, 0, 0, 0]], dtype=torch.float64)
    rollout = ProbeRollout.start(PegPhysics(block((0.2, 0.2, 0.02)), PEG), sensing, part, probe)
    late = rollout.wrench(100, 150)
    assert late.shape == (2, 50, 6) and rollout.count == 150
    whole = torch.cat([rollout.wrench(0, 100), late], dim=1)
    np.testing.assert_array_equal(
        sensing.contacts(whole.numpy(), sensing.start(2))[0], rollout.window(0, 150)[0]
    )
    # The block pushes the peg up: along the world's z, which leans by 20 degrees in the peg's frame.
    force = late[0, -1, :3].numpy()
    np.testing.assert_allclose(
        force / np.linalg.norm(force), [-np.sin(0.349066), 0, np.cos(0.349066)], atol=0.3
    )
    assert float(late[1].abs().max()) < 0.05


def test_the_truth_explains_its_own_recording_best() -> None:
    # Recorded with steps four times as fine, and with a sensor that is noisy and not at zero.
    rng = np.random.default_rng(5)
    hole = block_with_square_hole()
    # Against the block's side 10 mm below its top, back, over it, and down onto its top, sliding.
    corners = np.array(
        [
            [0.0, -0.045, 0.0, 0.04],
            [0.3, -0.045, 0.0, 0.04],
            [1.3, -0.033, 0.001, 0.04],
            [1.6, -0.045, 0.0, 0.04],
            [1.8, -0.045, 0.0, 0.06],
            [2.3, -0.015, 0.003, 0.06],
            [2.9, -0.015, 0.003, 0.047],
            [3.5, -0.010, 0.002, 0.047],
        ]
    )
    command = np.tile(np.array([0, 0, 0, 1, 0, 0, 0], dtype=np.float64), (8, 1))
    command[:, :3] = corners[:, 1:]
    stamps = np.arange(0.0, 3.5, 0.01)
    probe = Probe("side, then top", corners[:, 0], command, STIFFNESS, DAMPING, stamps)
    truth = torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]], dtype=torch.float64)
    real = PegPhysics(hole, PEG, ContactParameters(time_step=0.0005)).start(truth, probe).advance(350)
    noise = rng.normal(size=(350, 6)) * ([0.1] * 3 + [0.003] * 3) + [1.0, -1, 2, 0.1, 0, 0.1]
    sensing = ContactSensing(PEG, rate=100.0, tare=20)
    contacts, pose = sensing.measure([Touch(stamps, real.wrench[0] + noise, real.world_from_peg[0])])[0]

    offsets = torch.tensor([[0.0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1], [3, 0, 0], [0, 0, 3]])
    part = truth.repeat(len(offsets), 1)
    part[:, :3] += 0.001 * offsets
    rollout = ProbeRollout.start(PegPhysics(hole, PEG), sensing, part, probe)
    # A flush touch looks the same in the peg's frame at any depth: contacts must not speak against the truth,
    # where the peg stood has to speak for it.
    for likelihood, value, margin in (
        (ChamferContacts(rollout, 0, 350, 0.001, 18e-6), contacts, -1.0),
        (ContactsInTime(rollout, 0, 350, 0.001), contacts, -1.0),
        (PegPose(rollout, 0, 350, 0.0002, 0.001), pose, 0.1),
    ):
        log_prob = likelihood.log_prob(value)
        assert (log_prob[0] > log_prob[1:] + margin).all()
        assert (log_prob[[5, 6]] < log_prob[[1, 3]]).all()


def test_a_press_beside_the_tip_is_located_at_the_tip() -> None:
    """A line along the peg passes the tip's edge and the upper end's equally near; only the tip is pushed."""
    located = PLAIN.locate(wrench(np.array([[0.0085, 0.002, -0.05]]), np.array([[0.1, 0.0, 8.0]])))
    np.testing.assert_allclose(located, [[0.008, 0.002, -0.05]], atol=1e-4)

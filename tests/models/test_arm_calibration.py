"""Calibration by a ball in sockets: the density of the measured angles, and real recordings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.importance import importance_sampling
from bcppl.models.arm_calibration import (
    Arm,
    arm_calibration,
    corrected_joints,
    laplace_proposal,
    observations,
    read_seatings,
    remaining_error,
    sockets,
)
from bcppl.models.robots import load_robot
from bcppl.robot.correction import corrected
from bcppl.robot.kinematics import Robot
from bcppl.sensors.likelihoods.bench_profiles import profile_named
from bcppl.traces import generate
from tests.command_line import Ran
from tests.models.scene_contents import contents

DATA = Path(__file__).parents[3] / "shared/data/ball_in_socket"
needed = pytest.mark.skipif(not DATA.is_dir(), reason=f"the ball-in-socket recordings are not at {DATA}")

PLACES = {"panda_2_clean": ("front_left", "mid-high"), "panda_3": ("backcenter", "frontleft")}


def scatter(robot: Robot, angles: Tensor) -> float:
    """Root mean square distance of the ball from its mean position, mm."""
    places = robot.position("ball_link", angles)
    return 1e3 * float((places - places.mean(dim=0)).square().sum(dim=1).mean().sqrt())


def apart(robot: Robot, pair: list[Tensor]) -> float:
    first, second = (robot.position("ball_link", q).mean(dim=0) for q in pair)
    return 1e3 * float((first - second).norm())


@needed
@pytest.mark.parametrize("name", ["panda_2", "panda_3"])
def test_recordings_scatter_as_their_publication_reports(name: str) -> None:
    folder = DATA / "data" / {"panda_2": "panda_2_clean"}.get(name, name)
    pairs = [read_seatings(place) for place in sorted(folder.iterdir())]
    nominal = Robot(DATA / "urdf/panda.urdf", tip="ball_link")
    calibrated = Robot(DATA / f"calibrated_urdf/{name}/panda_calibrated.urdf", tip="ball_link")
    assert min(scatter(nominal, q) for pair in pairs for q in pair) > 3.0
    assert max(scatter(calibrated, q) for pair in pairs for q in pair) < 0.6
    assert all(46.5 < apart(nominal, pair) < 53.0 for pair in pairs)
    assert np.mean([apart(calibrated, pair) for pair in pairs]) == pytest.approx(50.0, abs=0.1)


@pytest.mark.long
@needed
@pytest.mark.parametrize("name", PLACES)
def test_two_positions_calibrate_the_distance_at_the_others(name: str) -> None:
    arm = Arm(Robot(DATA / "urdf/panda.urdf", tip="ball_link"))
    data = {p.name: read_seatings(p) for p in sorted((DATA / "data" / name).iterdir())}
    seen = [q for place in PLACES[name] for q in data[place]]
    torch.manual_seed(0)
    population = importance_sampling(
        arm_calibration, (arm, seen), observations(seen), 200, laplace_proposal(arm, seen)
    )
    assert population.effective_sample_size > 30.0
    weights = population.log_weights.softmax(dim=0)
    off, spread = [], []
    for place, pair in data.items():
        if place not in PLACES[name]:
            first, second = (sockets(arm, population.trace, q) for q in pair)
            distance = 1e3 * (first - second).norm(dim=1)
            off.append(float(weights @ distance) - 50.0)
            spread.append(float((weights @ (distance - distance @ weights) ** 2).sqrt()))
    assert max(map(abs, off)) < 0.4
    assert 0.05 < np.mean(spread) < 0.3
    assert max(abs(o) / s for o, s in zip(off, spread, strict=True)) < 3.5


def arm_and_seating() -> tuple[Arm, Tensor]:
    robot = load_robot("panda", tip="panda_hand_tcp")
    middle = torch.tensor([0.0, 0.3, 0.2, -1.8, 0.1, 2.2, 0.6], dtype=torch.float64)
    angles = middle + 0.4 * torch.rand(6, 7, generator=torch.Generator().manual_seed(0)).double()
    return Arm(robot, link="panda_hand_tcp"), angles


def test_the_volume_is_that_of_the_angles_jacobian() -> None:
    arm, angles = arm_and_seating()
    torch.manual_seed(1)
    values = {a: s * torch.randn(3, *s.shape, dtype=torch.float64) for a, s in arm.spread.items()}
    step, columns = 1e-6, []
    for k in range(7):
        moved = step * torch.eye(7, dtype=torch.float64)[k]
        ahead, back = arm.positions(values, angles + moved), arm.positions(values, angles - moved)
        columns.append((ahead - back) / (2.0 * step))
    jacobian = torch.stack(columns, dim=-1)
    expected = torch.log(torch.linalg.svdvals(jacobian)).sum(dim=(1, 2))
    assert torch.allclose(arm.log_volume(values, angles), expected, atol=1e-6)


def test_the_density_of_angles_does_not_depend_on_the_unit_of_positions() -> None:
    """An arm of twice the size with twice the noise has the same density, but for the flat prior."""
    arm, angles = arm_and_seating()
    robot = arm.robot
    values = {a: torch.zeros(1, *s.shape, dtype=torch.float64) for a, s in arm.spread.items()}
    reach = robot.position("panda_hand_tcp", angles)
    # Doubled joint origins: an arm of twice the size.
    shifts = torch.stack([torch.from_numpy(j.parent_from_child[:3, 3].copy()) for j in robot.joints])
    hand = torch.tensor([0.0, 0.0, 0.107 + 0.1034], dtype=torch.float64)
    twice = dict(values)
    twice["errors"] = torch.cat([shifts, torch.zeros(7, 3)], dim=1)[None].double()
    twice["ball"] = hand[None]
    assert torch.allclose(arm.positions(twice, angles)[0], 2.0 * reach, atol=1e-12)
    gain = arm.log_volume(twice, angles) - arm.log_volume(values, angles)
    assert float(gain) == pytest.approx(3 * len(angles) * math.log(2.0))


def test_a_rotation_about_the_base_is_not_identified() -> None:
    arm, angles = arm_and_seating()
    start = {a: torch.zeros(2, *s.shape, dtype=torch.float64) for a, s in arm.spread.items()}
    start["offsets"][1, 0] = 0.3
    start["noise"] = torch.full((2,), 3e-4, dtype=torch.float64)
    given = {a: v for a, v in start.items()}
    trace, _ = generate(arm_calibration, (arm, [angles]), {**observations([angles])}, 2, given)
    both = trace.log_prob("seating_0", "volume_0")
    assert float(both[0]) == pytest.approx(float(both[1]), rel=1e-9)


def test_simulated_offsets_are_recovered() -> None:
    arm, angles = arm_and_seating()
    truth = torch.tensor([0.0, 0.01, -0.012, 0.008, -0.01, 0.012, 0.0], dtype=torch.float64)
    seatings = []
    for seed in range(3):
        # Postures in one socket: Newton's method with least-norm steps.
        q = (
            angles.repeat(4, 1)
            + 0.3 * torch.rand(24, 7, generator=torch.Generator().manual_seed(seed)).double()
        )
        goal = arm.robot.position("panda_hand_tcp", q[:1] + truth)
        for _ in range(20):
            moved = q.clone().requires_grad_()
            places = arm.robot.position("panda_hand_tcp", moved + truth)
            rows = [torch.autograd.grad(places[:, k].sum(), moved, retain_graph=True)[0] for k in range(3)]
            q = q + (torch.linalg.pinv(torch.stack(rows, 1)) @ (goal - places.detach())[..., None])[..., 0]
        noise = 1e-5 * torch.randn(24, 7, generator=torch.Generator().manual_seed(seed)).double()
        seatings.append(q + noise)
    known = Arm(arm.robot, "panda_hand_tcp", offset=0.02, shift=0.0, turn=0.0, mount=1e-4, noise=2e-5)
    torch.manual_seed(0)
    population = importance_sampling(
        arm_calibration, (known, seatings), observations(seatings), 300, laplace_proposal(known, seatings)
    )
    weights = population.log_weights.softmax(dim=0)
    mean = (weights[:, None] * population["offsets"]).sum(dim=0)
    assert population.effective_sample_size > 30.0
    # The first offset rotates the arm about the base, the last one the ball about itself.
    assert float((mean - truth)[1:6].abs().max()) < 5e-4
    spread = (weights[:, None] * (population["offsets"] - mean) ** 2).sum(dim=0).sqrt()
    assert float(spread[0]) > 0.01 > 20.0 * float(spread[1:6].max())


def test_invalid_recordings_are_refused(tmp_path: Path) -> None:
    for text in (None, "1,2,x\n", "0.1,0.2,0.3\n"):
        if text is not None:
            (tmp_path / "hole_0.csv").write_text(text)
        with pytest.raises(InputError, match=r"hole_0\.csv"):
            read_seatings(tmp_path)


def test_seatings_are_ordered_by_number(tmp_path: Path) -> None:
    for number in range(12):
        (tmp_path / f"hole_{number}.csv").write_text(f"{number},0\n{number},1\n")
    (tmp_path / "hole_notes.csv").write_text("a,b\n")
    assert [int(q[0, 0]) for q in read_seatings(tmp_path)] == list(range(12))


def test_another_number_of_joints_is_refused() -> None:
    arm = Arm(load_robot("panda", tip="panda_hand"), "panda_hand")
    with pytest.raises(InputError, match="has 6 angles for each stamp; give 7, in the order panda_joint1,"):
        laplace_proposal(arm, [torch.zeros(5, 6).double()])


def test_nothing_is_written_into_the_arm() -> None:
    arm = Arm(load_robot("panda", tip="panda_hand"), link="panda_hand")
    torch.manual_seed(0)
    middle = torch.tensor([0.0, 0.2, 0.0, -1.5, 0.0, 1.8, 0.5], dtype=torch.float64)
    seatings = [middle + 0.3 * torch.randn(6, 7, dtype=torch.float64) for _ in range(2)]
    before, observed = contents(arm), observations(seatings)
    importance_sampling(arm_calibration, (arm, seatings), observed, 5, laplace_proposal(arm, seatings))
    assert len(before) > 40 and contents(arm) == before


# ---- bcppl calibrate arm


@needed
def test_a_calibrated_arm_and_its_profile_are_written(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    """The written arm seats the ball as the posterior mean does, at places that were not calibrated on."""
    places = ("backcenter", "frontleft", "frontright")
    for place in places:
        (tmp_path / "seated" / place).mkdir(parents=True)
        for file in (DATA / "data/panda_3" / place).glob("hole_*.csv"):
            (tmp_path / "seated" / place / file.name).write_bytes(file.read_bytes())
    urdf = DATA / "urdf/panda.urdf"
    ran = bcppl("calibrate", "arm", "seated", "--urdf", urdf, "--particles", 100, "-o", "mine")
    assert ran.code == 0, ran.err
    arm, nominal = Robot("mine.urdf", tip="ball_link"), Robot(urdf, tip="ball_link")
    others = [p for p in sorted((DATA / "data/panda_3").iterdir()) if p.name not in places]
    pairs = [read_seatings(place) for place in others]
    assert max(scatter(arm, q) for pair in pairs for q in pair) < 0.8
    assert min(scatter(nominal, q) for pair in pairs for q in pair) > 3.0
    assert all(abs(apart(arm, pair) - 50.0) < 0.5 for pair in pairs)
    profile = profile_named("mine.json")
    assert profile is not None and 0.0001 < profile.kinematics[0] < 0.0006
    assert 0.02 < profile.kinematics[1] <= 1.0 and profile.delay == 0.045
    (tmp_path / "wrong.json").write_text('{"format": "bcppl bench profile", "grasp": [1, 2]}')
    with pytest.raises(InputError, match=r"wrong.json has grasp \[1, 2\]; give 3 numbers"):
        profile_named("wrong.json")
    (tmp_path / "wrong.json").write_text('{"format": "bcppl bench profile", "grip": 1}')
    with pytest.raises(InputError, match="has 'grip'; fields of a profile are grasp"):
        profile_named("wrong.json")


def test_corrected_joints_lead_to_the_same_places_as_offsets_and_errors(tmp_path: Path) -> None:
    """At any values the corrected file's arm, without offsets, is the nominal one's with them."""
    file = Path(str(files("bcppl.models.robots") / "panda/panda.urdf"))
    robot = Robot(file, tip="panda_hand")
    arm = Arm(robot, "panda_hand")
    torch.manual_seed(4)
    trace, _ = generate(lambda arm: _prior(arm), (arm,), {}, 1)
    (tmp_path / "new.urdf").write_text(corrected(file, corrected_joints(arm, trace, torch.ones(1).double())))
    angles = torch.stack([j.lower + (j.upper - j.lower) * torch.rand(6).double() for j in robot.joints], 1)
    expected = arm.positions({a: trace[a] for a in arm.spread}, angles)[0]
    found = Robot(tmp_path / "new.urdf", tip="panda_hand").position("panda_hand", angles)
    assert float((found - expected).abs().max()) < 1e-9
    assert float((robot.position("panda_hand", angles) - expected).abs().max()) > 1e-3


MIMICKING = """<robot name="geared"><link name="base"/><link name="upper"/><link name="lower"/>
<link name="slide"/><link name="ball_link"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0.1 0 0.3"
rpy="0.3 -1.2 0.2"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.3 0 0.1"
rpy="-1 0.5 0.2"/><axis xyz="0 1 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
<mimic joint="shoulder" multiplier="-1.5" offset="0.2"/></joint>
<joint name="rail" type="prismatic"><parent link="lower"/><child link="slide"/><origin xyz="0 0.1 0"/>
<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="elbow"/></joint>
<joint name="seat" type="fixed"><parent link="slide"/><child link="ball_link"/>
<origin xyz="0.03 0 0.1"/></joint>
</robot>"""


def test_offsets_are_passed_on_to_mimicking_joints(tmp_path: Path) -> None:
    """Also to one that mimics a mimicking one."""
    (tmp_path / "nominal.urdf").write_text(MIMICKING)
    robot = Robot(tmp_path / "nominal.urdf", tip="ball_link")
    arm, angles = Arm(robot), torch.linspace(-0.8, 0.8, 5, dtype=torch.float64)[:, None]
    torch.manual_seed(1)
    trace, _ = generate(_prior, (arm,), {}, 1)
    written = corrected(tmp_path / "nominal.urdf", corrected_joints(arm, trace, torch.ones(1).double()))
    (tmp_path / "new.urdf").write_text(written)
    expected = arm.positions({a: trace[a] for a in arm.spread}, angles)[0]
    found = Robot(tmp_path / "new.urdf", tip="ball_link").position("ball_link", angles)
    assert float((found - expected).abs().max()) < 1e-9
    assert float((robot.position("ball_link", angles) - expected).abs().max()) > 1e-4


def test_a_ball_on_a_link_that_a_joint_moves_is_refused() -> None:
    """Its position would not be in the written file, while it counts in what is left uncertain."""
    with pytest.raises(InputError, match="'panda_joint7' of panda moves the ball's link 'panda_link7'"):
        Arm(load_robot("panda", tip="panda_link7"), link="panda_link7")


class Unsure:
    """Balls of which each is known to a standard deviation of 1 mm, and what is written scatters by 3 mm."""

    link, spread = "ball", Mapping
    robot = SimpleNamespace(position=lambda link, q: torch.zeros(len(q), 3).double())
    written = SimpleNamespace(position=lambda link, q: torch.tensor([[3e-3, 0.0, 0.0], [-3e-3, 0.0, 0.0]]))

    def __init__(self, sockets: int) -> None:
        torch.manual_seed(sockets)
        self.place = torch.rand(sockets, 3).double()
        self.spread = {"off": torch.ones(sockets, 3)}
        self.draws = {"off": 1e-3 * torch.randn(2000, sockets, 3).double()}

    def positions(self, values: Mapping[str, Tensor], angles: Tensor) -> Tensor:
        return self.place + values["off"]

    def left(self) -> Any:
        seatings = [torch.zeros(2, 6).double() for _ in self.place]
        weights = torch.full((2000,), 1.0 / 2000).double()
        return remaining_error(self, self.written, self.draws, weights, seatings)  # type: ignore[arg-type]


@pytest.mark.parametrize("sockets", [3, 4, 10])
def test_what_is_left_uncertain_is_that_of_single_places(sockets: int) -> None:
    """Whatever their number, though a motion of the whole arm fits three places better than ten."""
    left = Unsure(sockets).left()
    assert (left.before, left.after) == (0.0, pytest.approx(0.003))
    assert left.deviation**2 - left.after**2 / 3.0 == pytest.approx(1e-6, rel=0.06)


@pytest.mark.parametrize("sockets", [1, 2])
def test_fewer_than_three_sockets_are_refused(sockets: int) -> None:
    with pytest.raises(InputError, match=f"by {sockets} seatings?, .* seat the ball in 3 sockets at least"):
        Unsure(sockets).left()


def _prior(arm: Arm) -> None:
    for address, spread in arm.spread.items():
        pyro.sample(address, dist.Normal(torch.zeros_like(spread), spread).to_event(spread.ndim))

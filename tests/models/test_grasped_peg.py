"""A peg that sits off in the hand: its touches, and the hand turned to discriminate peg from part."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.cli import loading
from bcppl.errors import InputError
from bcppl.models import grasped_peg, part_in_view, peg_in_hole
from bcppl.models.worlds import grasped_peg as world
from bcppl.recordings import Recording, View
from bcppl.rendering.rasterisation import Rasteriser
from bcppl.rendering.ray_casting import RayCaster
from bcppl.traces import Trace, extend, generate, simulate, update


@functools.cache
def recorded() -> Recording:
    return world.simulate_recording(0)


@functools.cache
def scene() -> grasped_peg.GraspScene:
    return grasped_peg.prepare(recorded())


def constrained(hole: Tensor, grip: Tensor) -> Trace:
    """The program's trace for given poses (N, 7) of part and peg, given all measurements."""
    measurements = recorded().measurements
    empty, _ = generate(grasped_peg.grasped_peg, (scene(), []), {}, len(hole))
    moved = update(empty, {"hole": hole, "grip_from_peg": grip}).trace
    values = scene().observed(measurements)
    return extend(moved, (scene(), [m.action for m in measurements]), values)[0]


def touches(trace: Trace, first: int = 0, last: int = 99) -> Tensor:
    chosen = [a for a in trace.addresses if a.startswith(("contacts", "peg"))]
    return trace.log_prob(*[a for a in chosen if first <= int(a.split("_")[1]) < last])


def test_the_truth_explains_the_touches_and_no_other_place_in_the_hand_does_better() -> None:
    truth, grip = torch.from_numpy(recorded().truth), world.grip_from_peg(0)
    step = torch.zeros(8, 6, dtype=torch.float64)
    for axis in range(3):
        step[1 + 2 * axis, axis], step[2 + 2 * axis, axis] = 0.003, -0.003
    step[7] = poses.local(grip, poses.identity())
    trace = constrained(truth.expand(8, 7).clone(), poses.retract(grip.expand(8, 7).clone(), step))
    score = touches(trace)
    assert (score[0] > score[1:] + 5.0).all(), score
    assert float(trace.log_prob("depth_0").std()) == 0.0, "no camera feels the hand"


def test_only_touching_with_the_hand_turned_discriminates_the_peg_s_pose_from_the_part_s() -> None:
    """While the hand is not turned, 2 mm of the one are 2 mm of the other the other way."""
    truth, grip = torch.from_numpy(recorded().truth), world.grip_from_peg(0)
    hole, held = truth.expand(2, 7).clone(), grip.expand(2, 7).clone()
    hole[1, 0] += 0.002
    # The hand is upright within the look's error of the block, which is turned by its yaw.
    turn = poses.rotation_matrix(truth)
    held[1, :3] += turn.T @ torch.tensor([0.002, 0.0, 0.0], dtype=torch.float64)
    trace = constrained(hole, held)
    # Measurements 2 to 5 are before the turn (3.2 s of the probe), 7 and 8 after it.
    before, after = touches(trace, 2, 6), touches(trace, 7, 9)
    assert abs(float(before[0] - before[1])) < 5.0, before
    assert float(after[0] - after[1]) > 20.0, after


def test_a_peg_held_as_planned_is_that_of_peg_in_hole() -> None:
    pose = torch.from_numpy(recorded().truth).expand(2, 7).clone()
    pose[1, 2] += 0.001
    held = constrained(pose, poses.identity(2))
    own = {"evidence": ("contacts", "pose"), "normal_scale": 0.0003}
    plain_scene, measurements = peg_in_hole.prepare(recorded(), **own), recorded().measurements
    empty, _ = generate(peg_in_hole.peg_in_hole, (plain_scene, []), {}, 2)
    moved = update(empty, {"hole": pose}).trace
    values = plain_scene.observed(measurements)
    plain, _ = extend(moved, (plain_scene, [m.action for m in measurements]), values)
    for address in (a for a in values if not a.startswith("depth")):
        assert torch.equal(held.log_prob(address), plain.log_prob(address)), address


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"grip_shift": 1.5}, "in metres .* grip_shift is 1.5; .* at most 0.08"),
        ({"grip_turn": 5.0}, "grip_turn is 5.0; .* at most 3.14"),
        ({"grip_shift": 0.0}, r"positive .* \(peg_in_hole takes it to be exact\); grip_shift is 0.0"),
        ({"grip_turn": float("nan")}, "grip_turn is nan"),
        ({"grip_shift": "1"}, "grip_shift is '1'"),
        ({"scale": 0.0}, "scale = 0.0; give a finite number above 0"),
        ({"normal_scale": 0.0}, "normal_scale = 0.0; give a finite number above 0"),
        ({"contact_scale": -0.003}, "contact_scale = -0.003"),
        ({"pose_every": 0}, "pose_every = 0"),
    ],
)
def test_what_cannot_be_a_spread_is_refused_before_anything_is_built(settings: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        grasped_peg.prepare(recorded(), **settings)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", [part_in_view, peg_in_hole, grasped_peg])
def test_a_model_accepts_another_renderer(model: Any) -> None:
    """The same scene drawn in place of cast: the depth's density agrees to single precision."""
    views = [m for m in recorded().measurements if isinstance(m.action, View)]
    seen = replace(recorded(), measurements=views)
    compared = []
    for options in ({"renderer": RayCaster}, {}):
        torch.manual_seed(0)  # which errors the cameras have
        # Without errors the image sees the part where it is, so that both see it at one pose.
        exact: dict[str, Any] = {"shift": 0.0} if model is part_in_view else {}
        prepared = model.prepare(seen, **options, **exact)
        site = model.model.pose
        truth = torch.from_numpy(seen.truth).expand(2, 7).clone()
        empty, _ = generate(model.model.program, (prepared, []), {}, 2)
        trace = update(empty, {site: truth}).trace
        values = prepared.observed(views)
        trace, _ = extend(trace, (prepared, [m.action for m in views]), values)
        compared.append((type(prepared.likelihoods["view"].renderer), trace.log_prob(*values)))
    (cast, rays), (drawn, triangles) = compared
    assert issubclass(cast, RayCaster) and issubclass(drawn, Rasteriser)
    torch.testing.assert_close(rays, triangles, rtol=0.0, atol=0.5)


def test_it_is_offered_by_name_and_simulates_what_it_explains() -> None:
    assert loading.model("grasped_peg") is grasped_peg.model
    torch.manual_seed(0)
    simulated = simulate(
        grasped_peg.grasped_peg, (scene(), [m.action for m in recorded().measurements[:4]]), 2
    )
    assert simulated["grip_from_peg"].shape == (2, 7) and simulated["peg_3"].shape == (2, 80, 7)
    assert recorded().model == "grasped_peg"

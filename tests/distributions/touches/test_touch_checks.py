"""Predictive checks of touches: p values in closed form, outliers counted, a part that moved."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.distributions.checks import THRESHOLD
from bcppl.distributions.touch import ForceDirection, OnsetLocation, Path
from bcppl.distributions.touch.outliers import touch_check
from bcppl.inference import infer
from bcppl.inference.criticism.predictive import surprise
from bcppl.inference.population import Population
from bcppl.models.point_probe import model
from bcppl.sensors import Measurement
from bcppl.traces import generate
from tests.distributions.touches.exact_boxes import Boxes

BOX = Boxes((0.05, 0.1, 0.15))
PATH = Path(torch.tensor([[-0.06 + 0.0005 * k, 0.0, 0.0] for k in range(41)], dtype=torch.float64))


def never_called() -> Any:
    raise AssertionError("a touch is checked in closed form")


def test_onsets_of_the_model_have_uniform_tails() -> None:
    torch.manual_seed(0)
    site = OnsetLocation(BOX, poses.identity(3000), PATH, 0.0002, 0.0005, 0.0)
    tail = site.tail(site.sample())
    quantiles = torch.quantile(tail, torch.tensor([0.05, 0.25, 0.5, 0.75, 0.95], dtype=torch.float64))
    assert quantiles.tolist() == pytest.approx([0.05, 0.25, 0.5, 0.75, 0.95], abs=0.03)


def test_directions_of_the_model_have_uniform_tails() -> None:
    torch.manual_seed(0)
    tip, motion = PATH.points[20], torch.tensor([1.0, 0.3, 0.0], dtype=torch.float64)

    def p_value(angle: float) -> float:
        site = ForceDirection(BOX, poses.identity(2), tip, motion, 0.4, 0.05, 0.01)
        check = site.predictive_check(torch.tensor(angle, dtype=torch.float64), never_called)
        assert check is not None
        return check.probability

    many = ForceDirection(BOX, poses.identity(400), tip, motion, 0.4, 0.05, 0.01).sample()
    values = np.array([p_value(float(angle)) for angle in many])
    assert float((values < 0.2).mean()) == pytest.approx(0.2, abs=0.06)
    assert p_value(3.0) == pytest.approx(0.01, abs=1e-3)


def test_an_onset_that_only_an_outlier_explains() -> None:
    site = OnsetLocation(BOX, poses.identity(2), PATH, 0.0, 0.0005, 0.01)
    early = site.predictive_check(PATH.at(torch.tensor(0.004, dtype=torch.float64)), never_called)
    assert early.probability == pytest.approx(0.01) and early.excess > 5.0
    late = site.tail(PATH.at(torch.tensor(0.018, dtype=torch.float64)))
    assert late.tolist() == pytest.approx([0.0, 0.0], abs=1e-12)
    never = torch.full((3,), torch.nan, dtype=torch.float64)
    assert site.tail(never).tolist() == pytest.approx([0.0, 0.0], abs=1e-12)


def test_outliers_are_counted() -> None:
    far, near = torch.zeros(1, dtype=torch.float64), torch.full((1, 9), 0.6, dtype=torch.float64)
    assert touch_check(far, 0.01).probability == pytest.approx(0.01)
    assert touch_check(far, 0.01, near).probability == pytest.approx(1.0 - 0.99**10)
    near[0, :2] = 0.0
    three = sum(c * 0.01**k * 0.99 ** (10 - k) for k, c in ((3, 120), (4, 210), (5, 252), (6, 210), (7, 120)))
    assert touch_check(far, 0.01, near).probability == pytest.approx(three, rel=1e-6)
    assert three < THRESHOLD
    # A touch that is as it should be does not fail because others do not.
    assert touch_check(torch.full((1,), 0.6, dtype=torch.float64), 0.01, near).probability > 0.1


def at_truth(recording: Any, moved: float) -> dict[str, Any]:
    """Checks at the true pose, of a part that stood `moved` metres off in the second half of the touches."""
    scene = model.prepare(recording)
    shifted = [
        m if k < len(recording.measurements) // 2 else _moved(m, moved)
        for k, m in enumerate(recording.measurements)
    ]
    observed = scene.observed(shifted)
    truth = torch.as_tensor(recording.truth)[None].expand(4, 7)
    args = scene, [m.action for m in shifted]
    trace, _ = generate(model.program, args, observed, 4, {"part": truth})
    checks = surprise(Population(trace, torch.zeros(4)))
    return {a: c for a, c in checks.items() if a.startswith("onset")}


def _moved(measurement: Measurement, by: float) -> Measurement:
    tip = measurement.action.world_from_tip.copy()
    tip[:, 0] += by
    return replace(measurement, action=replace(measurement.action, world_from_tip=tip))


@pytest.mark.long
def test_a_part_that_moves_between_touches_is_named_and_one_that_stays_is_not() -> None:
    warned = 0
    for seed in range(10):
        recording = model.simulate_recording(seed, pushes=10)
        assert min(c.probability for c in at_truth(recording, 0.02).values()) < THRESHOLD
        still = at_truth(recording, 0.0)
        assert len(still) == 10
        warned += min(c.probability for c in still.values()) < THRESHOLD
    assert warned == 0


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
def test_a_belief_of_a_part_that_moved_is_named_or_has_both_places(seed: int) -> None:
    """Where particles explain either half of the touches, no single touch is off to all of them."""
    recording = model.simulate_recording(seed, pushes=10)
    halves = [m if k < 5 else _moved(m, 0.02) for k, m in enumerate(recording.measurements)]
    *_, step = infer(model, replace(recording, measurements=halves), seed=seed)
    named = min(check.probability for check in surprise(step.population).values()) < THRESHOLD
    assert named or float(step.belief.covariance[0, 0].sqrt()) > 0.005

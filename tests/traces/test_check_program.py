"""`check_program` names the mistake and the site of each wrong program, and refuses no right one."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from bcppl.errors import InputError
from bcppl.models import (
    arm_calibration,
    arm_in_view,
    camera_error,
    grasped_peg,
    look_and_touch,
    part_in_view,
    peg_in_hole,
    point_probe,
    which_hole,
)
from bcppl.traces import Fault, Model, ProgramError, Series, check_program
from tests.models.test_arm_calibration import arm_and_seating
from tests.models.test_arm_in_view import drawn
from tests.traces.right_programs import RIGHT
from tests.wrong_programs import WRONG
from tests.wrong_programs.catalogue import normal


@pytest.mark.parametrize("name", WRONG)
def test_the_mistake_and_the_site_are_named(name: str) -> None:
    wrong = WRONG[name]
    with pytest.raises(ProgramError) as caught:
        check_program(wrong.program, wrong.args, wrong.observations, steps=wrong.steps)
    assert (caught.value.fault, caught.value.site) == (wrong.fault, wrong.site), str(caught.value)
    assert str(caught.value).endswith(".") and (wrong.site is None or repr(wrong.site) in str(caught.value))


def test_every_kind_of_mistake_is_shown() -> None:
    assert {wrong.fault for wrong in WRONG.values()} == set(Fault)


@pytest.mark.parametrize("name", RIGHT)
def test_a_right_program_passes(name: str) -> None:
    right = RIGHT[name]
    check_program(right.program, right.args, right.observations, steps=right.steps)


@pytest.mark.long
@pytest.mark.parametrize("name", RIGHT)
def test_a_right_program_passes_whatever_is_drawn(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    runs, right = sys.modules["bcppl.traces.checks.runs"], RIGHT[name]
    seed = runs.seed
    for other in range(10):
        monkeypatch.setattr(runs, "seed", lambda number, other=other: seed(number + 10_000 * (other + 1)))
        check_program(right.program, right.args, right.observations, steps=right.steps)


# Of each shipped model, a recording of its own world.
SHIPPED = {
    "point_probe": point_probe,
    "look_and_touch": look_and_touch,
    "which_hole": which_hole,
    "camera_error": camera_error,
    "peg_in_hole": peg_in_hole,
    "grasped_peg": grasped_peg,
}


def few(model: Model, measurements: int) -> Any:
    assert model.simulate_recording is not None
    recording = model.simulate_recording(0)
    return replace(recording, measurements=list(recording.measurements)[:measurements])


@pytest.mark.parametrize("name", ["point_probe"])
def test_a_shipped_model_passes(name: str) -> None:
    check_program(SHIPPED[name].model, few(SHIPPED[name].model, 2), particles=4)


@pytest.mark.long
@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_model_passes(name: str) -> None:
    check_program(SHIPPED[name].model, few(SHIPPED[name].model, 4), particles=5)


@pytest.mark.long
def test_the_shipped_programs_for_arms_and_clutter_pass() -> None:
    arm, angles = arm_and_seating()
    given = {**arm_calibration.observations([angles])}
    check_program(arm_calibration.arm_calibration, (arm, [angles]), given, 5)
    scene, seen = drawn(0.01)
    check_program(arm_in_view.arm_in_view, (scene, len(seen)), seen, 5)
    recording = few(look_and_touch.model, 1)
    check_program(part_in_view.model, replace(recording, model="part_in_view"), particles=5)


def model_of(program: Any) -> Model:
    """A model whose recordings are lists of numbers with their actions."""
    return Model(
        program=program,
        prepare=lambda recording: 1.0,
        observe=lambda scene, measurements: {f"y_{k}": each.seen for k, each in enumerate(measurements)},
        pose="x",
    )


@dataclass(frozen=True)
class Seen:
    action: float
    seen: float


RECORDING = SimpleNamespace(measurements=[Seen(0.1, 0.3), Seen(0.2, 0.5)])


def test_a_model_is_checked_with_what_it_makes_of_a_recording() -> None:
    def program(scene: float, actions: list[float], wrong: bool = False) -> None:
        x = normal("x", 0.0, scene)
        for k, action in enumerate(actions):
            normal(f"y_{k}", x + action - wrong * (k == 1) * x.mean())

    check_program(model_of(program), RECORDING)
    with pytest.raises(ProgramError, match="site 'y_1'"):
        check_program(model_of(partial(program, wrong=True)), RECORDING)


def test_a_model_of_a_series_is_checked_step_by_step() -> None:
    def init(scene: float, actions: list[float]) -> Any:
        return normal("x", 0.0, scene)

    def step(x: Any, scene: float, actions: list[float], wrong: bool = False) -> Any:
        (action,) = actions
        normal("y_0", x + action - wrong * (action == 0.2) * x.mean())
        return x

    check_program(model_of(Series(init, step)), RECORDING)
    with pytest.raises(ProgramError, match="site 'y_0'"):
        check_program(model_of(Series(init, partial(step, wrong=True))), RECORDING)


def states() -> list[Any]:
    return [torch.get_rng_state().tolist(), np.random.get_state()[1].tolist(), random.getstate()]  # type: ignore[index, union-attr]


def good() -> None:
    normal("y", normal("x"))


@pytest.mark.parametrize("program", [good, WRONG["torch_noise"].program])
def test_the_generators_are_as_before(program: Callable[[], None]) -> None:
    before = states()
    with suppress(ProgramError):
        check_program(program, (), {"y": 0.3})
    assert states() == before


def test_too_few_particles_are_refused() -> None:
    with pytest.raises(InputError, match="checked with 2 particles; give 3 or more"):
        check_program(good, (), {"y": 0.3}, 2)

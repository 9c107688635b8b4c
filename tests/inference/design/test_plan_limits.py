"""What a plan is said to keep to, it keeps to: speeds, forces, the path that is looked at for collisions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bcppl.arguments import pose_problem
from bcppl.cli.candidates import planned
from bcppl.errors import InputError
from bcppl.geometry.extrusion import round_peg
from bcppl.inference.planning.metrology import three_two_one
from bcppl.inference.planning.metrology_parameters import MetrologyParameters
from bcppl.inference.planning.motion_constraints import above_table, not_from_below
from bcppl.inference.planning.motions import free_path, pressing_force
from bcppl.models.worlds.bench.scene import bench_scene
from bcppl.robot.plan import Manner, Plan
from tests.inference.design.test_touch_planning import about

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def led(*heights: float, manner: Manner = "held") -> Plan:
    """At rest, then from height to height (m), half a second each."""
    knots = np.array([[0.0, 0.0, height, *UPRIGHT] for height in (heights[0], *heights)])
    times, manners = 0.5 * np.arange(len(knots)), ("free", *(manner,) * (len(knots) - 2))
    return Plan("press", times, knots, manners, 4.0, np.full(6, 1000.0), np.ones(6))


def test_a_press_in_three_motions_is_as_strong_as_in_one() -> None:
    assert pressing_force(led(0.0, -0.003, -0.006, -0.009)) == pytest.approx(9.0)
    assert pressing_force(led(0.0, -0.009)) == pytest.approx(9.0)
    assert pressing_force(led(0.0, 0.0, -0.009, 0.0)) == pytest.approx(9.0)


def test_a_way_that_only_turns_is_looked_at_between_its_ends() -> None:
    plan = led(0.0, 0.0, manner="free")
    turned = plan.world_from_peg.copy()
    turned[-1, 3:] = 0.0, 1.0, 0.0, 0.0
    path = free_path(replace(plan, world_from_peg=turned))
    cosines = np.abs(np.sum(path[1:, 3:] * path[:-1, 3:], axis=1)).clip(0.0, 1.0)
    assert np.degrees(2.0 * np.arccos(cosines)).max() < 2.01 and len(path) > 90


def turning(degrees: float) -> Plan:
    """A peg whose origin stays while it turns about x, as far to the one side as to the other."""
    plan = led(0.0, 0.0, manner="free")
    knots = plan.world_from_peg.copy()
    for k, sign in enumerate((-1.0, -1.0, 1.0)):
        half = 0.5 * sign * np.radians(degrees)
        knots[k, 3:] = np.cos(half), np.sin(half), 0.0, 0.0
    return replace(plan, world_from_peg=knots)


def test_a_turning_peg_is_held_above_the_table_and_from_above_amid_its_turn() -> None:
    peg = round_peg(0.01, 0.1)  # amid the turn it is upright, its tip 0.1 m below its origin
    assert list(above_table(peg, -0.11).satisfied([turning(60.0)])) == [True]
    assert list(above_table(peg, -0.07).satisfied([turning(60.0)])) == [False]
    assert list(not_from_below().satisfied([turning(60.0), turning(110.0)])) == [True, False]


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"free_speed": -0.1}, "3-2-1 touches has free_speed -0.1; give a finite number above 0"),
        ({"guarded_speed": 0.0}, "has guarded_speed 0.0"),
        ({"lean": -0.1}, "has lean -0.1 radians"),
        ({"first_contact": 0.2}, "first_contact = 0.2 s, and the way there takes"),
    ],
)
def test_parameters_of_three_two_one_are_checked(changed: dict[str, Any], words: str) -> None:
    scene = bench_scene(5)
    with pytest.raises(InputError, match=words):
        three_two_one(about(scene, 0.001), scene.part, scene.peg, MetrologyParameters()._replace(**changed))


def test_without_a_peg_views_keep_above_the_table_too() -> None:
    scene = bench_scene(5)
    recording = replace(scene.look(), peg=None)
    with pytest.raises(InputError, match="lead into the table"):
        planned({"view": 3}, about(scene, 0.001), recording, [], 10.0, 0)


def test_the_quaternion_that_is_wrong_is_named() -> None:
    wrong = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0]])
    assert "quaternion of length 2;" in (pose_problem("a pose", wrong) or "")

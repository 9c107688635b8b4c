"""`bcppl insert`: which hole and mode it plans for, how sure it is of them, and what an arm can follow."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
import torch
from shapely.affinity import translate

from bcppl import Belief, Part, poses
from bcppl.cli import candidates
from bcppl.errors import InputError
from bcppl.geometry.extrusion import block_with_hole, extruded, peg_for
from bcppl.geometry.outlines import rectangular_outline, round_outline
from bcppl.models import load_recording
from bcppl.recordings.action_file import load_actions
from bcppl.robot.plan import Plan
from tests.command_line import Ran

OUTLINE = round_outline(0.010)
PEG = peg_for(OUTLINE, 0.0002, 0.08)
PANDA = ("--robot", "panda", "--link", "panda_hand", "--link-from-peg", "0 0 0.1 0 1 0 0")


def about(pose: tuple[float, ...], spread: tuple[float, ...], count: int = 200) -> torch.Tensor:
    """Poses (N, 7) about one, with standard deviations (6,) in its tangent space."""
    away = torch.randn(count, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return poses.retract(poses.as_pose(pose).expand(count, 7), away * torch.tensor(spread).double())


@pytest.fixture
def planned(
    bcppl: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[Ran, dict[str, object]]]:
    """Runs the command on poses of a part, equally probable, as if they were of a recording."""

    def run(part: Part, world_from_part: torch.Tensor, *words: object) -> tuple[Ran, dict[str, object]]:
        belief = Belief(world_from_part, torch.zeros(len(world_from_part)).double())
        now = SimpleNamespace(
            population=SimpleNamespace(belief=lambda pose: belief),
            model=SimpleNamespace(pose="part"),
            recording=SimpleNamespace(part=part, peg=PEG),
        )
        monkeypatch.setattr("bcppl.cli.posterior.posterior", lambda *arguments: now)
        ran = bcppl("insert", "any.h5", "--simulations", 0, "--json", *words)
        return ran, json.loads(ran.out) if ran.code == 0 else {}

    return run


def test_it_is_as_sure_of_a_hole_far_from_the_parts_origin_as_the_yaw_allows(planned: Callable) -> None:
    part = block_with_hole(OUTLINE, (0.3, 0.06, 0.025), (0.12, 0.0))
    turn = math.radians(0.5)
    world_from_part = about((0.5, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0), (5e-5, 5e-5, 5e-5, 0.0, 0.0, turn))
    ran, written = planned(part, world_from_part)
    assert ran.code == 0, ran.err
    across, along = written["deviation_mm"]
    assert across == pytest.approx(120.0 * turn, rel=0.1) and along == pytest.approx(0.05, rel=0.1)


def test_the_heaviest_mode_is_tried_and_its_weight_stated(planned: Callable) -> None:
    part = block_with_hole(OUTLINE, (0.06, 0.06, 0.025))
    spread = (5e-5, 5e-5, 5e-5, 0.0, 0.0, 0.0)
    here = about((0.5, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0), spread, 140)
    there = about((0.516, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0), spread, 60)
    ran, written = planned(part, torch.cat([here, there]))
    np.testing.assert_allclose(written["world_from_hole"][:3], here[:, :3].mean(dim=0), atol=1e-9)
    assert "several modes of the belief, with 70 % of its weight" in ran.err
    ran, written = planned(part, here)
    assert "modes" not in ran.err and written["mass"] == pytest.approx(1.0)


def test_one_of_several_holes_is_chosen(planned: Callable) -> None:
    holes = [translate(OUTLINE, x).exterior for x in (-0.015, 0.015)]
    plate = extruded("plate", shapely.Polygon(rectangular_outline(0.08, 0.04).exterior, holes), -0.02, 0.0)
    world_from_part = about((0.5, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0), (1e-4,) * 3 + (0.0,) * 3)
    _, written = planned(plate, world_from_part, "--inside", "0.014 0.001")
    assert written["world_from_hole"][0] == pytest.approx(0.515, abs=1e-4)
    for words, message in (
        ((), "2 holes in its top"),
        (("--inside", "0 0"), "no hole around"),
        (("--inside", "0.014"), "give two numbers in metres: x y"),
    ):
        ran, _ = planned(plate, world_from_part, *words)
        assert ran.code == 2 and message in ran.err, ran.err


def test_candidates_that_search_are_for_the_hole_that_is_chosen() -> None:
    holes = [translate(OUTLINE, x).exterior for x in (-0.015, 0.015)]
    plate = extruded("plate", shapely.Polygon(rectangular_outline(0.08, 0.04).exterior, holes), -0.02, 0.0)
    world_from_part = about((0.5, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0), (1e-4,) * 3 + (0.0,) * 3)
    belief = Belief(world_from_part, torch.zeros(200, dtype=torch.float64))
    recording = replace(load_recording("peg_probe"), part=plate, peg=PEG, measurements=[])
    for x in (-0.015, 0.015):
        searches = candidates.planned({"search": 2}, belief, recording, [], None, 0, (x, 0.001))
        for each in searches:
            middle = each.world_from_peg[each.manners.index("searching"), 0]
            assert middle == pytest.approx(0.5 + x, abs=1e-3)
    with pytest.raises(InputError, match="2 holes in its top"):
        candidates.planned({"search": 2}, belief, recording, [], None, 0)


@pytest.mark.long
def test_an_insertion_that_an_arm_cannot_follow_is_refused(planned: Callable) -> None:
    part = block_with_hole(OUTLINE, (0.06, 0.06, 0.025))
    world_from_part = about((0.5, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0), (1e-4,) * 3 + (0.0,) * 3)
    ran, _ = planned(part, world_from_part, *PANDA, "--world-from-base", "2 0 0 1 0 0 0")
    assert ran.code == 2 and "search are out of panda's reach" in ran.err, ran.err
    ran, _ = planned(part, world_from_part, *PANDA)
    assert ran.code == 0, ran.err
    assert all(isinstance(plan, Plan) for plan in load_actions("insertion.json"))

"""The insertion of the examples, by a simulated arm that a program commands directly."""

from __future__ import annotations

import importlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from bcppl.inference.planning.insertion import insertion_plan
from bcppl.models.worlds.bench.scene import BenchScene, bench_scene
from tests.inference.design.test_insertion import believed
from tests.robot.robot_examples import FOLDER, importable

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="examples/ stands in a checkout only")
TICK = 0.01  # s


class DirectArm:
    """An arm whose clock goes on with each reading."""

    ahead, settles = TICK, 0.0

    def __init__(self, scene: BenchScene) -> None:
        self._simulated = importlib.import_module("simulated_arm").SimulatedArm(scene, TICK)
        self._reading = importlib.import_module("readings").Reading
        self._stamp = 1000.0
        self.command = self._simulated.command

    def read(self) -> list[Any]:
        pose, wrench = self._simulated.advance()
        self._stamp += TICK
        return [self._reading(self._stamp, wrench, self._stamp, pose)]


@pytest.mark.long
@pytest.mark.parametrize("away", [0.0, 0.3])
def test_a_peg_is_inserted_and_not_pushed_where_there_is_no_part(
    away: float, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = bench_scene(3, part="square 8 mm", clearance=0.0002)
    belief = believed(scene, 3, 0.0001, np.radians(0.1))
    elsewhere = belief.moved(belief.world_from_part + away * torch.eye(7)[1])
    live = SimpleNamespace(
        recording=SimpleNamespace(peg=scene.peg, guess=scene.guess),
        settle=lambda: None,
        insertion=lambda: insertion_plan(elsewhere, scene.part, scene.peg),
    )
    with importable():
        program, arm = importlib.import_module("touch_and_insert"), DirectArm(scene)
        if away:
            with pytest.raises(SystemExit, match="'search' felt no contact"):
                program.touch_and_insert(arm, live, 0)
        else:
            assert program.touch_and_insert(arm, live, 0) > 0.02
            assert capsys.readouterr().out.startswith("inserted")

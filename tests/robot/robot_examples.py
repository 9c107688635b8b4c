"""A short guarded descent that each example of a robot executes, and what has to be true of it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.inference.live import Filter
from bcppl.models.look_and_touch import model
from bcppl.models.worlds.bench.scene import BenchScene
from bcppl.robot.execution import Executor
from bcppl.robot.plan import Plan

FOLDER = Path(__file__).parents[2] / "examples"
OWN = "readings", "simulated_arm", "touch_and_insert", "ur", "franka", "ros2", "pylibfranka"


@contextmanager
def importable(*folders: Path) -> Iterator[None]:
    """Examples can be imported, as from their own folder, and are forgotten afterwards."""
    with pytest.MonkeyPatch.context() as patch:
        for each in (FOLDER, *folders):
            patch.syspath_prepend(each)
        importlib.invalidate_caches()
        _forget()
        try:
            yield
        finally:
            _forget()


def _forget() -> None:
    for name in [each for each in sys.modules if each.split(".")[0] in OWN]:
        del sys.modules[name]


def descent(start: np.ndarray) -> Plan:
    """From a pose (7,) down by 80 mm, or as far as the part, and up again: 3.3 s."""
    knots = np.tile(start, (5, 1))
    knots[2, 2] -= 0.08
    manners = ("free", "guarded", "free", "free")
    stiffness = np.array([2500.0] * 3 + [150.0] * 3)
    return Plan("down", [0.0, 0.3, 2.3, 2.8, 3.3], knots, manners, 4.0, stiffness, np.ones(6))


def stopped_on_the_part(executor: Executor, scene: BenchScene) -> None:
    """The tip stopped on the part as it truly lies: a point of the tip's plane is on its surface."""
    assert executor.state == "finished" and list(executor.stops) == [1]
    assert executor.contact_pose is not None
    tip = float(scene.peg.vertices[:, 2].min())
    corners = torch.from_numpy(scene.peg.vertices[scene.peg.vertices[:, 2] < tip + 1e-6])
    at = poses.transform(torch.from_numpy(executor.contact_pose), corners)
    seen = poses.transform(poses.inverse(torch.from_numpy(scene.truth)), at).numpy()
    assert -0.0005 < seen[:, 2].min() < 0.0005


def touches_once(program: Any, arm: Any, live: Filter, scene: BenchScene) -> None:
    """A belief that has seen the part is surer of its height after a descent, and it is the true one."""
    before, seen = live.settle().belief, len(live.recording.measurements)
    executor = program.touch(arm, live, descent(arm.read()[-1].world_from_peg))
    stopped_on_the_part(executor, scene)
    belief = live.settle().belief
    windows = live.recording.measurements[seen:]
    assert sum(w.action.last - w.action.first for w in windows) == len(executor.probe.stamps)
    assert not any(each.fault for each in live.updates)
    assert float(belief.spread[2]) < float(before.spread[2])
    error = float(belief.mean[2] - scene.truth[2])
    assert abs(error) < max(0.001, 3.0 * float(belief.spread[2]))


def live_belief(scene: BenchScene, views: int = 1) -> Filter:
    """A live belief of few particles, which has seen so many views."""
    recording = scene.look()
    return Filter(model, replace(recording, measurements=recording.measurements[:views]), particles=20)

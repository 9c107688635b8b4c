"""The examples of robots, run by the robots' own libraries against an arm that speaks their protocol."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.inference.live import Sampler
from bcppl.models.worlds import bench_scene
from bcppl.robot.execution import Executor
from bcppl.robot.plan import Plan, probe_of

FOLDER = Path(__file__).parents[1] / "examples/ur"
pytest.importorskip("rtde_receive", reason="ur_rtde is not installed")
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="examples/ stands in a checkout only")


@pytest.fixture
def programs(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.syspath_prepend(FOLDER)
    return {name: importlib.import_module(name) for name in ("arm", "touch_and_insert")}


@pytest.fixture
def connected(programs: dict[str, Any], tmp_path: Path) -> Iterator[Any]:
    """An arm in a process of its own, whose clock goes on with each command: ur_rtde keeps Python's lock."""
    words = [sys.executable, FOLDER / "stand_in.py", "--pace", "client", "--look", tmp_path / "look.h5"]
    with subprocess.Popen(list(map(str, words)), stdout=subprocess.PIPE, text=True) as stand_in:
        try:
            assert stand_in.stdout is not None and "listening" in stand_in.stdout.readline()
            arm = programs["arm"].URArm("127.0.0.1")
            yield arm
            arm.close()
        finally:
            stand_in.kill()


def test_a_guarded_descent_through_ur_rtde_stops_on_the_part(
    programs: dict[str, Any], connected: Any
) -> None:
    arm, scene = connected, bench_scene(31000)
    start = arm.read().world_from_peg
    tip = float(scene.peg.vertices[:, 2].min())
    knots = np.tile(start, (5, 1))
    knots[2, 2] -= 0.08
    stiffness, damping = np.array([2500.0] * 3 + [150.0] * 3), np.ones(6)
    manners = ("free", "guarded", "free", "free")
    plan = Plan("down", [0.0, 0.3, 2.3, 2.8, 3.3], knots, manners, 4.0, stiffness, damping)
    readings: list[Any] = []
    executor, last = programs["touch_and_insert"].execute(arm, plan, readings.append)
    assert isinstance(executor, Executor) and executor.state == "finished" and list(executor.stops) == [1]
    stamps = np.diff([each.stamp for each in readings])
    assert len(readings) > 1000 and np.median(stamps) == pytest.approx(0.002)
    # The tip stopped on the part as it truly lies: a point of the tip's plane is on its surface.
    assert executor.contact_pose is not None
    corners = torch.from_numpy(scene.peg.vertices[scene.peg.vertices[:, 2] < tip + 1e-6])
    at = poses.transform(torch.from_numpy(executor.contact_pose), corners)
    seen = poses.transform(poses.inverse(torch.from_numpy(scene.truth)), at).numpy()
    assert -0.0005 < seen[:, 2].min() < 0.0005
    force = np.array([each.wrench[2] for each in readings])
    assert abs(force[:50].mean()) < 0.1 and force.max() > 4.0  # the part pushes the peg up
    assert np.abs(last.world_from_peg[:3] - start[:3]).max() < 0.0005
    # And what was read makes windows, every stamp of the probe once.
    sampler = Sampler(probe_of(Plan(**{**vars(plan), "times": plan.times + readings[0].stamp + 0.02})))
    windows = [
        w
        for each in readings
        for w in (
            *sampler.wrench(each.stamp, each.wrench),
            *sampler.pose(each.stamp, each.world_from_peg),
        )
    ]
    windows += sampler.finish()
    assert sum(w.action.last - w.action.first for w in windows) == len(executor.probe.stamps)
    assert sampler.counts["wrench"].repeated == 0

"""The example of UR arms, run by the robots' own library against an arm that speaks their protocol."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bcppl.inference.live import Sampler
from bcppl.models.worlds import bench_scene
from bcppl.robot.plan import Plan, probe_of
from tests.robot.robot_examples import FOLDER, descent, importable, stopped_on_the_part

pytest.importorskip("rtde_receive", reason="ur_rtde is not installed")
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="examples/ stands in a checkout only")


@pytest.fixture
def programs() -> Iterator[dict[str, Any]]:
    with importable():
        yield {name: importlib.import_module(name) for name in ("ur.arm", "touch_and_insert")}


@pytest.fixture
def connected(programs: dict[str, Any], tmp_path: Path) -> Iterator[Any]:
    """An arm in a process of its own, whose clock goes on with each command: ur_rtde keeps Python's lock."""
    words = [sys.executable, "-m", "ur.stand_in", "--pace", "client", "--look", str(tmp_path / "look.h5")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=FOLDER) as stand_in:
        try:
            assert stand_in.stdout is not None and "listening" in stand_in.stdout.readline()
            arm = programs["ur.arm"].URArm("127.0.0.1")
            yield arm
            arm.close()
        finally:
            stand_in.kill()


@pytest.mark.long
def test_a_guarded_descent_through_ur_rtde_stops_on_the_part(
    programs: dict[str, Any], connected: Any
) -> None:
    arm, scene = connected, bench_scene(31000)
    start = arm.read()[-1].world_from_peg
    plan = descent(start)
    arm.command(start, plan.stiffness)  # from here on the clock waits for commands
    readings: list[Any] = []
    executor, last = programs["touch_and_insert"].execute(arm, plan, readings.append)
    stopped_on_the_part(executor, scene)
    stamps = np.diff([each.stamp for each in readings])
    assert len(readings) > 1000 and np.median(stamps) == pytest.approx(0.002)
    force = np.array([each.wrench[2] for each in readings])
    assert abs(force[:50].mean()) < 0.1 and force.max() > 4.0  # the part pushes the peg up
    assert np.abs(last.world_from_peg[:3] - start[:3]).max() < 0.0005
    # And what was read makes windows, every stamp of the probe once.
    sampler = Sampler(probe_of(Plan(**{**vars(plan), "times": plan.times + readings[0].stamp + 0.02})))
    windows = [
        w
        for each in readings
        for w in (*sampler.wrench(each.stamp, each.wrench), *sampler.pose(each.posed, each.world_from_peg))
    ]
    windows += sampler.finish()
    assert sum(w.action.last - w.action.first for w in windows) == len(executor.probe.stamps)
    assert sampler.counts["wrench"].repeated == 0

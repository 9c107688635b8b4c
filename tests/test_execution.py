"""A plan executed against a wall of springs: where motions stop, and what aborts them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.robot.execution import Executor, Limits
from bcppl.robot.plan import Plan

SPRING = 2000.0  # N/m of the arm, whose command leads the peg into a wall
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def descent(force: float = 4.0, speed: float = 0.02, **fields: object) -> Plan:
    """At rest, then 40 mm down guarded, then up."""
    heights = np.array([0.0, 0.0, -0.04, 0.0])
    times = np.array([0.0, 0.2, 0.2 + 0.04 / speed, 0.4 + 0.04 / speed])
    knots = np.column_stack([np.zeros((4, 2)), heights, np.tile(UPRIGHT, (4, 1))])
    plan = Plan("down", times, knots, ("free", "guarded", "free"), force, np.ones(6), np.ones(6))
    return replace(plan, **fields)


def executed(
    executor: Executor, wall: float, bias: float = 3.0, hits: dict[int, float] | None = None
) -> Array:
    """The heights (T,) of a peg that cannot go below a wall; `hits` are forces (N) at single samples."""
    heights = []
    while executor.state == "moving":
        number, led = executor.taken, executor.commanded()
        height = max(float(led[2]), wall)
        force = SPRING * (height - float(led[2])) + bias + (hits or {}).get(number, 0.0)
        pose = np.concatenate([led[:2], [height], led[3:]])
        executor.sample(np.array([0.0, 0.0, force]), lambda pose=pose: pose)
        heights.append(height)
    return np.array(heights)


@pytest.mark.parametrize("wall", [-0.01, -0.025])
def test_a_guarded_motion_stops_at_its_force_and_the_rest_goes_on_as_planned(wall: float) -> None:
    plan = descent()
    executor = Executor(plan)
    heights = executed(executor, wall)
    assert executor.state == "finished" and len(heights) == len(executor.probe.stamps)
    deepest = executor.probe.command[:, 2].min()
    # Two samples beyond the force, and the rounded corner after them: at 20 mm/s less than 2 mm.
    assert wall - plan.force / SPRING - 0.002 < deepest < wall - plan.force / SPRING + 1e-9
    assert executor.contact_pose is not None and executor.contact_pose[2] == pytest.approx(wall)
    assert executor.stops.keys() == {1}
    assert executor.probe.command[-1, 2] > executor.probe.command[:, 2].min() + 0.5 * abs(wall)


def test_without_contact_nothing_stops_whatever_the_sensors_zero() -> None:
    executor = Executor(descent())
    executed(executor, wall=-1.0, bias=30.0)
    assert not executor.stops and executor.contact_pose is None


def test_a_single_sample_stops_nothing() -> None:
    executor = Executor(descent(), limits=Limits(force=20.0))
    executed(executor, wall=-1.0, hits={60: 50.0, 90: 10.0})
    assert executor.state == "finished" and not executor.stops


def test_one_first_sample_of_a_stated_tare_is_not_two_in_a_row() -> None:
    free, tare = descent(manners=("free", "free", "free")), np.array([0.0, 0.0, 3.0])
    executor = Executor(free, tare=tare, limits=Limits(force=20.0))
    executed(executor, wall=-1.0, hits={0: 100.0})
    assert executor.state == "finished"
    executor = Executor(free, tare=tare, limits=Limits(force=20.0))
    executed(executor, wall=-1.0, hits={0: 100.0, 1: 100.0})
    assert executor.state == "aborted" and executor.taken == 2


def test_a_force_beyond_the_limit_aborts_and_holds_the_peg_where_it_is() -> None:
    free = descent(manners=("free", "free", "free"))
    executor = Executor(free, limits=Limits(force=15.0))
    executed(executor, wall=-0.01)
    assert executor.state == "aborted" and "force exceeded the limit of 15 N" in executor.reason
    assert executor.commanded()[2] == pytest.approx(-0.01)
    assert executor.commanded(time=1.0)[2] == pytest.approx(-0.01)


def test_a_plan_that_is_too_fast_or_too_short_is_refused() -> None:
    with pytest.raises(InputError, match=r"motion 1 of plan 'down' is guarded at 20 mm/s"):
        Executor(descent(), limits=Limits(speed=0.01))
    with pytest.raises(InputError, match="motion 2 of plan 'down' is free at 200 mm/s"):
        Executor(descent(), limits=Limits(free_speed=0.1))
    with pytest.raises(InputError, match="longer than 10 samples"):
        Executor(replace(descent(), rate=4.0))
    with pytest.raises(InputError, match=r"limit of force is -1"):
        Executor(descent(), limits=Limits(force=-1.0))

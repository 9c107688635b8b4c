"""A plan executed against a wall of springs: where motions stop, and what aborts them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.robot.execution import Executor, Limits
from bcppl.robot.plan import InsertionPlan, Plan

SPRING = 2000.0  # N/m of the arm, whose command leads the peg into a wall
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def descent(force: float = 4.0, speed: float = 0.02, **fields: object) -> Plan:
    """At rest, then 40 mm down guarded, then up."""
    heights = np.array([0.0, 0.0, -0.04, 0.0])
    times = np.array([0.0, 0.2, 0.2 + 0.04 / speed, 0.4 + 0.04 / speed])
    knots = np.column_stack([np.zeros((4, 2)), heights, np.tile(UPRIGHT, (4, 1))])
    plan = Plan("down", times, knots, ("free", "guarded", "free"), force, np.ones(6), np.ones(6))
    return replace(plan, **fields)


def search(**fields: object) -> Plan:
    """At rest, 20 mm down guarded, 4 mm farther held, and 5 mm along x searching, in ten motions."""
    times = np.array([0.0, 0.2, 1.2, 1.4, *np.linspace(1.5, 2.4, 10)])
    knots = np.tile([0.0, 0.0, 0.0, *UPRIGHT], (14, 1))
    knots[2:, 2], knots[3:, 2], knots[4:, 0] = -0.02, -0.024, np.linspace(0.0005, 0.005, 10)
    manners = ("free", "guarded", "held", *("searching",) * 10)
    plan = Plan("search", times, knots, manners, 4.0, np.ones(6), np.ones(6), sink=0.001)
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


def test_a_search_that_feels_no_contact_is_in_no_hole() -> None:
    """As without a part, or with a sensor that reads nothing."""
    executor = Executor(search(), stop_at_hole=True)
    executed(executor, wall=-1.0)
    assert executor.state == "no contact" and not executor.stops and "felt no contact" in executor.reason
    # A probe that need not find a hole goes on to its end.
    executor = Executor(search())
    executed(executor, wall=-1.0)
    assert executor.state == "finished" and not executor.stops


@pytest.mark.parametrize(("ends", "state"), [(150, "in hole"), (400, "finished")])
def test_a_peg_is_in_a_hole_once_it_sinks_below_its_contact(ends: int, state: str) -> None:
    executor = Executor(search(), stop_at_hole=True)
    while executor.state == "moving":
        led, wall = executor.commanded(), -0.01 if executor.taken < ends else -1.0
        height = max(float(led[2]), wall)
        pose = np.array([led[0], led[1], height, *UPRIGHT])
        executor.sample(np.array([0.0, 0.0, SPRING * (height - led[2])]), lambda pose=pose: pose)
    assert executor.state == state and executor.contact_pose is not None


def test_a_peg_that_met_nothing_on_its_way_down_is_in_a_hole_once_walls_hold_it() -> None:
    executor = Executor(search(), stop_at_hole=True)
    while executor.state == "moving":
        led = executor.commanded()
        held = np.array([min(float(led[0]), 0.0001), *led[1:]])
        force = np.array([SPRING * (held[0] - led[0]), 0.0, 0.0])
        executor.sample(force, lambda pose=held: pose)
    assert executor.state == "in hole" and 0.002 < executor.commanded()[0] < 0.003


def test_a_plan_that_begins_pressed_needs_a_tare_and_stops_at_its_force() -> None:
    pressed = descent(manners=("guarded", "guarded", "free"))
    with pytest.raises(InputError, match="begins with a motion that is guarded"):
        Executor(pressed)
    executor = Executor(pressed, tare=np.array([0.0, 0.0, 3.0]))
    executed(executor, wall=-1.0, bias=50.0)
    assert executor.stops[0] < 0.05


def test_a_load_that_comes_or_changes_during_the_tare_is_no_tare() -> None:
    def at(bias: float, hits: dict[int, float]) -> Executor:
        executor = Executor(descent(), limits=Limits(force=20.0))
        executed(executor, wall=-1.0, bias=bias, hits=hits)
        return executor

    assert at(3.0, {}).state == "finished" and at(-10.0, {}).state == "finished"
    sudden = at(3.0, dict.fromkeys(range(3, 400), 30.0))
    assert sudden.taken == 5 and "exceeded the limit of 20 N" in sudden.reason
    growing = at(3.0, {k: 2.0 * k for k in range(400)})
    assert growing.taken == 10 and "varied by 5.7 N while it was tared" in growing.reason
    loaded = at(200.0, {})
    assert loaded.state == "aborted" and "tared at 200 N, above 20 N" in loaded.reason


def test_the_tare_is_that_of_the_first_ten_samples_for_the_plan_that_follows() -> None:
    executor = Executor(descent())
    executed(executor, wall=-0.01, bias=3.0)
    np.testing.assert_allclose(executor.tare, [0.0, 0.0, 3.0])


def test_a_pressed_slide_is_no_faster_than_what_may_touch() -> None:
    slide = descent(manners=("free", "guarded", "held"))
    with pytest.raises(InputError, match="motion 2 of plan 'down' is held at 200 mm/s"):
        Executor(slide, limits=Limits(speed=0.1, free_speed=0.5))
    # Speeds are those of the plan, whatever the clock.
    Executor(replace(slide, times=slide.times + 1.7e9), limits=Limits(speed=0.2))


def test_a_surface_below_the_stroke_is_met_by_the_press_and_is_no_hole() -> None:
    executor = Executor(search(), stop_at_hole=True)
    executed(executor, wall=-0.0215)
    assert executor.state == "finished" and executor.contact_pose is not None
    assert executor.contact_pose[2] == pytest.approx(-0.0215)


@pytest.mark.parametrize("at", [3, 60])
def test_a_force_that_is_no_number_aborts(at: int) -> None:
    executor = Executor(descent(), limits=Limits())
    executed(executor, wall=-1.0, hits={at: np.nan})
    assert executor.state == "aborted" and "no number" in executor.reason and executor.taken == at + 1


def test_what_follows_a_stop_keeps_to_the_limits_too() -> None:
    """After a stroke of 100 mm that is stopped at 10, what was 5 mm in a tenth of a second is 95."""
    plan = descent(speed=0.1)
    knots = plan.world_from_peg.copy()
    knots[2:, 2] = -0.1, -0.105
    short = replace(plan, times=np.array([0.0, 0.2, 1.2, 1.3]), world_from_peg=knots)
    fastest = Executor(short)
    executed(fastest, wall=-0.01)
    speed = np.abs(np.diff(fastest.probe.command[:, 2])) / np.diff(fastest.probe.command_times)
    assert fastest.state == "finished" and speed.max() > 0.6
    executor = Executor(short, limits=Limits())
    executed(executor, wall=-0.01)
    assert executor.state == "aborted" and "over the limit of 500" in executor.reason
    assert executor.commanded()[2] == pytest.approx(-0.01)


@pytest.mark.parametrize("begins", [0.0, 1.7e9])
@pytest.mark.parametrize("longer", [0.0, 0.002, 0.003, 0.004])
def test_the_limits_after_a_stop_suit_a_plan_of_any_length_and_clock(longer: float, begins: float) -> None:
    plan = descent()
    times = begins + plan.times + [0.0, 0.0, 0.0, longer]
    executor = Executor(replace(plan, times=times), limits=Limits())
    executed(executor, wall=-0.01)
    assert executor.state == "finished" and executor.contact_pose is not None


def test_a_plan_that_turns_too_fast_is_refused() -> None:
    turned = descent().world_from_peg.copy()
    turned[3, 3:] = 0.0, 0.0, 0.0, 1.0
    with pytest.raises(InputError, match=r"motion 2 of plan 'down' turns the peg by 16 rad/s"):
        Executor(descent(world_from_peg=turned), limits=Limits())


@pytest.mark.parametrize("above", [0.0, 0.004, 0.02])
def test_a_push_that_begins_higher_takes_longer_and_is_no_faster(above: float) -> None:
    knots = np.tile([0.0, 0.0, 0.0, *UPRIGHT], (3, 1))
    knots[1:, 2] = -0.02
    times, manners = np.array([0.0, 1.0, 1.2]), ("guarded", "held")
    push = Plan("push", times, knots, manners, 20.0, np.ones(6), np.ones(6))
    insertion = InsertionPlan(search(), push, np.array([0.0, 0.0, 0.0, *UPRIGHT]), 0.021, 0.0)
    led = insertion.push_from(np.array([0.0, 0.0, above, *UPRIGHT]))
    speed = np.linalg.norm(np.diff(led.world_from_peg[:, :3], axis=0), axis=1) / np.diff(led.times)
    assert led.world_from_peg[-1, 2] == pytest.approx(-0.02) and speed.max() == pytest.approx(0.02)


def test_what_follows_a_stop_turns_no_faster_than_the_limit() -> None:
    """Of 0.8 rad in two seconds most is left where the stroke is stopped, for a free motion of 0.2 s."""
    knots = descent().world_from_peg.copy()
    for k, yaw in ((2, 0.8), (3, 0.9)):
        knots[k, 3:] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
    knots[3, 2] = -0.03
    plan = descent(world_from_peg=knots)
    executed(Executor(plan, limits=Limits(turning=0.6)), wall=-1.0)
    executor = Executor(plan, limits=Limits(turning=0.6))
    executed(executor, wall=-0.01)
    assert executor.state == "aborted" and "turn the peg by" in executor.reason


def test_after_its_end_an_execution_changes_no_more() -> None:
    executor = Executor(descent(), limits=Limits(force=20.0))
    executed(executor, wall=-1.0, hits={60: 50.0, 61: 50.0})
    held, reason = executor.commanded().copy(), executor.reason
    for height in np.linspace(-0.02, -0.5, 400):
        pose = np.array([0.0, 0.0, height, *UPRIGHT])
        assert not executor.sample(np.array([0.0, 0.0, 100.0]), lambda pose=pose: pose)
    assert executor.state == "aborted" and executor.reason == reason
    np.testing.assert_array_equal(executor.commanded(), held)


def test_what_is_no_force_is_refused() -> None:
    for tare, named in ((np.full(3, np.nan), "not finite"), (np.zeros(6), "has shape")):
        with pytest.raises(InputError, match=named):
            Executor(descent(), tare=tare)
    executor = Executor(descent())
    for force in (np.zeros(6), np.zeros((2, 3)), 5.0):
        with pytest.raises(InputError, match="the force alone"):
            executor.sample(np.asarray(force), executor.commanded)
    assert executor.taken == 0

"""Live beliefs: what arrives in any order, late, or too fast gives the belief of the batch run."""

from __future__ import annotations

import math
import random
import threading
import warnings
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import bcppl
from bcppl.errors import InferenceError, InputError
from bcppl.inference import guided_smc
from bcppl.inference.live import Filter, play
from bcppl.inference.live.waiting import Arrived, Waiting
from bcppl.inference.planning.motion_constraints import above_table
from bcppl.models import load_recording, point_probe
from bcppl.models.look_and_touch import model
from bcppl.robot.plan import Plan
from bcppl.sensors import Measurement, ProbeWindow, Recording, Touch, View

FEW = 20


@pytest.fixture(scope="module")
def touched() -> Recording:
    """A shipped recording without its images, cut into windows of half a cell."""
    recording = load_recording("peg_probe")
    windows = [m for m in recording.measurements if isinstance(m.action, ProbeWindow)][:4]
    return replace(recording, measurements=[half for each in windows for half in halves(each)])


def halves(measurement: Measurement) -> list[Measurement]:
    window, touch = measurement.action, measurement.observation
    middle = (window.first + window.last) // 2
    cuts = [(window.first, middle), (middle, window.last)]
    return [
        Measurement(
            ProbeWindow(window.probe, first, last),
            Touch(*(getattr(touch, f)[first - window.first : last - window.first] for f in FIELDS)),
        )
        for first, last in cuts
    ]


FIELDS = ("times", "wrench", "world_from_peg")


def test_touches_are_planned_within_the_constraints_of_the_filter(touched: Recording) -> None:
    known = replace(touched, measurements=[])
    high = above_table(touched.peg, 1.0)
    with (
        Filter(model, known, particles=FEW, constraints=[high]) as live,
        pytest.raises(InputError, match="lead into the table"),
    ):
        live.next_probe()


def test_windows_that_arrive_in_any_order_give_the_same_bits(touched: Recording) -> None:
    *_, batch = guided_smc.infer(model, touched, particles=FEW, seed=3)
    shuffled = list(touched.measurements)
    random.Random(1).shuffle(shuffled)
    with Filter(model, replace(touched, measurements=[]), particles=FEW, seed=3, deadline=1e3) as live:
        for each in shuffled:
            live.observe(each.action, each.observation)
        step = live.settle()
    assert [m.action.first for m in live.recording.measurements] == [
        m.action.first for m in touched.measurements
    ]
    assert torch.equal(step.belief.world_from_part, batch.belief.world_from_part)
    assert torch.equal(step.belief.log_weights, batch.belief.log_weights)
    assert {update.joined for update in live.updates} == {1}


def test_a_window_waits_for_those_before_it(touched: Recording) -> None:
    with Filter(model, replace(touched, measurements=[]), particles=FEW) as live:
        live.observe(touched.measurements[1].action, touched.measurements[1].observation)
        with pytest.warns(RuntimeWarning, match=r"1 measurements wait for earlier ones"):
            assert live.settle().taken == 0
        live.observe(touched.measurements[0].action, touched.measurements[0].observation)
        assert live.settle().taken == 2


def test_windows_that_arrive_twice_are_assimilated_once(touched: Recording) -> None:
    one, two, three, _ = touched.measurements[:4]
    joined = Measurement(ProbeWindow(one.action.probe, 0, 50), joined_touch(touched))
    waiting = Waiting()
    for each in (two, one, one, joined, two, three, three):
        waiting.add(each, 0.0)
    assert spans([waiting.take(join=False)]) == [(0, 25)]
    assert spans([waiting.take(join=True)]) == [(25, 75)]
    waiting.add(two, 0.0)
    assert waiting.take(join=True) is None and len(waiting) == 0


def spans(arrived: list[Arrived | None]) -> list[tuple[int, int]]:
    return [(each.measurement.action.first, each.measurement.action.last) for each in arrived if each]


def test_updates_that_are_late_join_windows_then_halve_particles_and_lose_nothing(touched: Recording) -> None:
    first = touched.measurements[0]
    with Filter(model, replace(touched, measurements=[]), particles=2 * FEW, deadline=1e-6) as live:
        held = threading.Event()
        live._thread.submit(held.wait)  # the filter is busy while all arrive
        for each in touched.measurements:
            live.observe(each.action, each.observation)
        held.set()
        live.settle()
    joined = [update.joined for update in live.updates]
    assert joined == [1, len(touched.measurements) - 1]
    stamps = np.concatenate([m.observation.times for m in live.recording.measurements])
    assert np.array_equal(stamps, first.action.probe.stamps[: len(stamps)])
    assert live.updates[-1].particles >= FEW


def faulty(model: Any, recording: Recording, **settings: Any) -> Iterator[Any]:
    """Inference that no particle survives where a measurement's first stamp is the third window's."""
    if any(m.action.first == 50 and m.action.probe.name == "bad" for m in recording.measurements):
        raise InferenceError("window 3: no particle has any weight")
    yield from guided_smc.infer(model, recording, **settings)


@pytest.mark.parametrize("policy", ["skip", "stop"])
def test_a_measurement_that_nothing_explains_is_left_out_or_ends_it(touched: Recording, policy: Any) -> None:
    third = touched.measurements[2]
    probe = replace(third.action.probe, name="bad")
    bad = Measurement(ProbeWindow(probe, 50, 75), third.observation)
    empty = replace(touched, measurements=[])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # Late windows would be joined, and the joined one begins with another stamp.
        with Filter(model, empty, particles=FEW, infer=faulty, on_fault=policy, deadline=1e3) as live:
            for each in touched.measurements[:2]:
                live.observe(each.action, each.observation)
            live.settle()
            before = live.belief
            live.observe(ProbeWindow(probe, 0, 50), joined_touch(touched))
            live.observe(bad.action, bad.observation)
            if policy == "stop":
                with pytest.raises(InferenceError, match="no particle"):
                    live.settle()
                return
            after = live.settle()
    assert after.taken == 3 and live.updates[-1].fault.startswith("window 3")
    assert before is not after.belief
    assert any("left out" in str(each.message) for each in caught)


def test_arrays_of_measurements_may_be_used_again(touched: Recording) -> None:
    with Filter(model, replace(touched, measurements=[]), particles=FEW, deadline=1e3) as live:
        held = threading.Event()
        live._thread.submit(held.wait)  # the filter is busy when they arrive
        for each in touched.measurements:
            observation = deepcopy(each.observation)
            live.observe(each.action, observation)
            observation.wrench[:], observation.world_from_peg[:] = 7.0, 7.0
        held.set()
        live.settle()
    for kept in (live.recording, live.arrived):
        for one, other in zip(kept.measurements, touched.measurements, strict=True):
            for name in FIELDS:
                assert np.array_equal(getattr(one.observation, name), getattr(other.observation, name))


def test_windows_after_one_that_is_left_out_or_overlaps_are_left_out(touched: Recording) -> None:
    def faulty_at_first(model: Any, recording: Recording, **settings: Any) -> Iterator[Any]:
        if recording.measurements and recording.measurements[-1].action.first == 0:
            raise InferenceError("no particle has any weight")
        yield from guided_smc.infer(model, recording, **settings)

    one, two, three, _ = touched.measurements[:4]
    joined = Measurement(ProbeWindow(one.action.probe, 0, 50), joined_touch(touched))
    empty = replace(touched, measurements=[])
    with Filter(model, empty, particles=FEW, infer=faulty_at_first, deadline=1e3) as live:
        for each in (one, two, three):
            live.observe(each.action, each.observation)
        with pytest.warns(RuntimeWarning, match="leaves out stamps 0 to .*begin another probe: it is left"):
            assert live.settle().taken == 0
    assert [bool(update.fault) for update in live.updates] == [True] * 3
    with Filter(model, empty, particles=FEW, deadline=1e3) as live:
        for each in (one, joined):
            live.observe(each.action, each.observation)
        with pytest.warns(RuntimeWarning, match="begins before an earlier window ended, at 25"):
            assert live.settle().taken == 1


def test_an_error_of_a_callback_ends_the_filter_and_is_seen(touched: Recording) -> None:
    def broken(step: Any, update: Any) -> None:
        raise KeyError("of the callback")

    first, second = touched.measurements[:2]
    with Filter(model, replace(touched, measurements=[]), particles=FEW, on_update=broken) as live:
        live.observe(first.action, first.observation)
        with pytest.raises(KeyError, match="of the callback"):
            live.settle()
        with pytest.raises(KeyError, match="of the callback"):
            live.observe(second.action, second.observation)
        for asked in (live.next_probe, live.insertion):
            with pytest.raises(KeyError, match="of the callback"):
                asked(timeout=5.0)
    with Filter(model, replace(touched, measurements=[]), particles=FEW) as live:
        pass
    with pytest.raises(InputError, match="the live filter is closed"):
        live.observe(first.action, first.observation)


def test_a_callback_may_ask_and_not_wait(touched: Recording) -> None:
    asked: list[Any] = []

    def asks(step: Any, update: Any) -> None:
        with pytest.raises(InputError, match="settle in another thread"):
            live.settle(timeout=0.1)
        asked.append(live._run(lambda: live.belief, 0.1))

    with Filter(model, replace(touched, measurements=[]), particles=FEW, on_update=asks) as live:
        live.observe(touched.measurements[0].action, touched.measurements[0].observation)
        assert asked == [live.settle().belief]


def test_requests_hold_up_no_measurement_and_are_dropped_when_nobody_waits(touched: Recording) -> None:
    done: list[str] = []
    listed = {"particles": FEW, "on_update": lambda *_: done.append("update")}
    with Filter(model, replace(touched, measurements=[]), **listed) as live:
        held = threading.Event()
        live._thread.submit(held.wait)
        with pytest.raises(TimeoutError):
            live._run(lambda: done.append("given up"), 0.01)
        asking = threading.Thread(target=lambda: live._run(lambda: done.append("request"), None))
        asking.start()
        asking.join(0.1)
        live.observe(touched.measurements[0].action, touched.measurements[0].observation)
        held.set()
        asking.join()
        live.settle()
    assert done == ["update", "request"]


def test_a_camera_of_the_name_of_another_is_refused(touched: Recording) -> None:
    views = [m for m in load_recording("peg_probe").measurements if isinstance(m.action, View)]
    namesake = View(replace(views[1].action.camera, name=views[0].action.camera.name))
    nameless = View(replace(views[1].action.camera, name=""))
    with Filter(model, replace(touched, measurements=[]), particles=FEW) as live:
        live.observe(views[0].action, views[0].observation)
        with pytest.raises(InputError, match=r"cameras .* differs from an earlier one; name it otherwise"):
            live.observe(namesake, views[1].observation)
        with pytest.raises(InputError, match="empty name"):
            live.observe(nameless, views[1].observation)
        assert live.settle().taken == 1


def joined_touch(recording: Recording) -> Touch:
    both = [m.observation for m in recording.measurements[:2]]
    return Touch(*(np.concatenate([getattr(t, f) for t in both]) for f in FIELDS))


def test_a_measurement_that_is_wrong_is_refused_where_it_is_given(touched: Recording) -> None:
    window, touch = touched.measurements[3].action, touched.measurements[3].observation
    with Filter(model, replace(touched, measurements=[]), particles=FEW) as live:
        with pytest.raises(InputError, match="wrench times, not"):
            live.observe(window, Touch(touch.times[1:], touch.wrench[1:], touch.world_from_peg[1:]))
        with pytest.raises(InputError, match="pairs a ProbeWindow with a Touch"):
            live.observe(window, window)
        assert live.behind == 0


def test_a_recording_is_played_at_the_pace_of_its_stamps(touched: Recording) -> None:
    now, slept = [100.0], list[float]()

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += seconds

    at = [now[0] for _ in play(touched, 2.0, lambda: now[0], sleep)]
    ends = [float(m.observation.times[-1]) for m in touched.measurements]
    begin = float(touched.measurements[0].observation.times[0])
    assert at == pytest.approx([100.0 + 0.5 * (end - begin) for end in ends])
    assert len(list(play(touched, math.inf, sleep=sleep))) == len(touched.measurements)


def test_an_image_that_arrives_twice_is_assimilated_once() -> None:
    recording = load_recording("peg_probe")
    view, *_ = recording.measurements
    stages: list[str] = []

    def updated(_: Any, update: Any) -> None:
        stages.append(update.fault)

    with Filter(model, replace(recording, measurements=[]), particles=FEW, on_update=updated) as live:
        for _ in range(2):
            live.observe(view.action, view.observation)
            live.settle()
        assert len(live.recording.measurements) == 1 and "before: it is left out" in stages[1]
        assert not stages[0]


def test_what_is_under_way_counts_as_not_assimilated_and_a_callback_cannot_close(touched: Recording) -> None:
    begun, go_on, refused = threading.Event(), threading.Event(), []

    def slow(model: Any, recording: Recording, **settings: Any) -> Iterator[Any]:
        begun.set()
        assert not recording.measurements or go_on.wait(20.0)
        yield from guided_smc.infer(model, recording, **settings)

    def closing(*_: Any) -> None:
        with pytest.raises(InputError, match="close it in another"):
            live.close()
        refused.append(True)

    with Filter(
        model, replace(touched, measurements=[]), particles=FEW, infer=slow, on_update=closing
    ) as live:
        begun.clear()
        live.observe(touched.measurements[0].action, touched.measurements[0].observation)
        assert begun.wait(20.0) and live.behind == 1
        go_on.set()
        live.settle()
        assert live.behind == 0 and refused


def test_a_name_that_has_arrived_is_not_given_again(touched: Recording) -> None:
    third = touched.measurements[2]
    plan = standing(third.action.probe.name)
    with Filter(model, replace(touched, measurements=[]), particles=FEW) as live:
        assert live.named_apart(plan).name == plan.name
        live.observe(third.action, third.observation)  # it waits for those before it
        assert live.named_apart(plan).name == f"{plan.name} (2)"
        assert live.named_apart(plan, [f"{plan.name} (2)"]).name == f"{plan.name} (3)"


def standing(name: str) -> Plan:
    knots = np.tile([0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0], (3, 1))
    times = np.array([0.0, 1.0, 2.0])
    return Plan(name, times, knots, ("free", "guarded"), 4.0, np.ones(6), np.ones(6))


def test_filters_and_a_run_in_other_threads_take_turns_to_the_same_bits() -> None:
    recording = load_recording("point_probe_10_pushes")
    pushes = replace(recording, measurements=recording.measurements[:2])
    settings: dict[str, Any] = {"particles": 20, "seed": 1}
    *_, alone = bcppl.infer(point_probe.model, pushes, **settings)
    known = replace(pushes, measurements=[])
    patient: dict[str, Any] = {**settings, "deadline": 1e3}
    with (
        Filter(point_probe.model, known, **patient) as one,
        Filter(point_probe.model, known, **patient) as two,
    ):
        for each in pushes.measurements:
            one.observe(each.action, each.observation)
            two.observe(each.action, each.observation)
        *_, here = bcppl.infer(point_probe.model, pushes, **settings)
        beliefs = [here.belief, one.settle().belief, two.settle().belief]
    for belief in beliefs:
        assert torch.equal(belief.world_from_part, alone.belief.world_from_part)
        assert torch.equal(belief.log_weights, alone.belief.log_weights)

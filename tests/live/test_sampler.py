"""From messages to windows: what a sampler makes of the streams of a wrist sensor and an arm."""

from __future__ import annotations

import random
import sys
import threading

import numpy as np
import pytest
import torch

from bcppl import poses
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.inference.live import Sampler
from bcppl.robot.motion import Probe
from bcppl.sensors import Measurement


def signal(times: Array) -> Array:
    """Six smooth columns."""
    return np.stack([np.sin(3.0 * times + k) for k in range(6)], axis=-1)


def pose_at(times: Array) -> Array:
    turn = np.array([0.0, 0.0, 0.3])
    twist = np.concatenate([0.01 * np.outer(times, [1.0, -1.0, 0.5]), np.outer(times, turn)], axis=1)
    start = poses.identity().expand(len(times), 7)
    return np.asarray(poses.retract(start, torch.from_numpy(twist)).numpy())


def probe(seconds: float = 1.0, rate: float = 100.0) -> Probe:
    stamps = 10.0 + np.arange(round(seconds * rate)) / rate
    return Probe("p", stamps[[0, -1]], pose_at(np.zeros(2)), np.ones(6), np.ones(6), stamps)


def messages(rates: tuple[float, float]) -> list[tuple[float, str, Array]]:
    """Messages of both streams from before the probe until after it, in the order of their stamps."""
    listed: list[tuple[float, str, Array]] = []
    for name, rate, values in zip(("wrench", "pose"), rates, (signal, pose_at), strict=True):
        times = np.arange(9.9, 11.2, 1.0 / rate)
        listed += [(float(t), name, row) for t, row in zip(times, values(times - 10.0), strict=True)]
    return sorted(listed, key=lambda each: each[0])


def windows_of(sampler: Sampler, given: list[tuple[float, str, Array]]) -> list[Measurement]:
    return [w for stamp, name, row in given for w in getattr(sampler, name)(stamp, row)]


@pytest.mark.parametrize("rates", [(500.0, 500.0), (1000.0, 125.0), (60.0, 2000.0)])
def test_windows_hold_what_the_streams_were_at_their_stamps(rates: tuple[float, float]) -> None:
    got = windows_of(Sampler(probe()), messages(rates))
    assert [(w.action.first, w.action.last) for w in got] == [(0, 25), (25, 50), (50, 75), (75, 100)]
    times = np.concatenate([w.observation.times for w in got])
    assert np.array_equal(times, probe().stamps)
    wrench = np.concatenate([w.observation.wrench for w in got])
    assert np.abs(wrench - signal(times - 10.0)).max() < 1.2 * 9.0 / 8.0 / min(rates[0], 100.0) ** 2
    pose = np.concatenate([w.observation.world_from_peg for w in got])
    away = poses.local(torch.from_numpy(pose_at(times - 10.0)), torch.from_numpy(pose))
    assert float(away.abs().max()) < 1e-6


def test_messages_out_of_order_and_twice_change_nothing_and_are_counted() -> None:
    given = messages((500.0, 250.0))
    straight = windows_of(Sampler(probe()), given)
    twice = [given[0], *given]
    order = np.argsort([t + random.Random(k).uniform(0.0, 0.04) for k, (t, _, _) in enumerate(twice)])
    sampler = Sampler(probe())
    shuffled = windows_of(sampler, [twice[k] for k in order])
    for one, other in zip(straight, shuffled, strict=True):
        assert np.array_equal(one.observation.wrench, other.observation.wrench)
        assert np.array_equal(one.observation.world_from_peg, other.observation.world_from_peg)
    counts = sampler.counts
    assert counts["wrench"].repeated + counts["pose"].repeated == 1
    assert counts["wrench"].unordered > 10 and counts["wrench"].late == 0


def test_messages_that_are_lost_are_bridged_and_counted_or_refused() -> None:
    given = messages((500.0, 500.0))
    short = [each for each in given if not (each[1] == "wrench" and 10.305 < each[0] < 10.335)]
    sampler = Sampler(probe())
    assert len(windows_of(sampler, short)) == 4 and sampler.counts["wrench"].bridged == 3
    long = [each for each in given if not (each[1] == "pose" and 10.301 < each[0] < 10.399)]
    with pytest.raises(InputError, match=r"the pose stream has no message from 10\.300 to 10\.400 s"):
        windows_of(Sampler(probe()), long)


def test_what_was_complete_before_messages_were_lost_is_a_window() -> None:
    """Both streams stop for .35 s after the first window's end, and go on."""
    given = [each for each in messages((100.0, 100.0)) if not 10.265 < each[0] < 10.605]
    sampler, got = Sampler(probe()), list[Measurement]()
    with pytest.raises(InputError, match="too long to interpolate"):
        for stamp, name, row in given:
            got += getattr(sampler, name)(stamp, row)
    assert [(w.action.first, w.action.last) for w in got] == [(0, 25)]
    assert sampler.missing == 75 and sampler.fault is not None


def test_a_window_of_one_stamp_is_averaged_as_the_others_are() -> None:
    noise = np.random.default_rng(0).normal(size=(1300, 6))
    times = np.arange(9.9, 11.2, 0.001)
    still = [float(x) for x in poses.identity()]
    sampler = Sampler(probe(0.76))
    got = list[Measurement]()
    for stamp, row in zip(times, noise, strict=True):
        for name, values in (("wrench", row), ("pose", still)):
            got += getattr(sampler, name)(float(stamp), values)
    alone = got[-1]
    assert alone.action.last - alone.action.first == 1
    mean = noise[(times > 10.7449) & (times < 10.7551)].mean(axis=0)
    np.testing.assert_allclose(alone.observation.wrench[0], mean, atol=0.2)


def test_arrays_of_messages_may_be_used_again() -> None:
    buffers, got = {"wrench": np.empty(6), "pose": np.empty(7)}, list[Measurement]()
    sampler = Sampler(probe())
    for stamp, name, row in messages((500.0, 250.0)):
        buffers[name][:] = row
        got += getattr(sampler, name)(stamp, buffers[name])
    expected = windows_of(Sampler(probe()), messages((500.0, 250.0)))
    for one, other in zip(got, expected, strict=True):
        assert np.array_equal(one.observation.wrench, other.observation.wrench)
        assert np.array_equal(one.observation.world_from_peg, other.observation.world_from_peg)


def test_streams_may_come_from_threads_of_their_own() -> None:
    sampler, windows, errors = Sampler(probe(20.0)), list[Measurement](), list[Exception]()
    turns = threading.Barrier(2)

    def send(name: str, width: int) -> None:
        try:
            for number in range(21_000):
                if number % 20 == 0:  # as far as one another, but for 20 ms
                    turns.wait(60.0)
                stamp = 9.9 + 0.001 * number
                row = np.array([stamp, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0][:width])
                windows.extend(getattr(sampler, name)(stamp, row))
        except Exception as error:
            errors.append(error)
            turns.abort()

    switching = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=send, args=each) for each in (("wrench", 6), ("pose", 7))]
        for each in threads:
            each.start()
        for each in threads:
            each.join()
    finally:
        sys.setswitchinterval(switching)
    assert not errors
    assert sorted(w.action.first for w in windows) == list(range(0, 2000, 25))

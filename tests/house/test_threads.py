"""Parallel loops: every particle once, in nested calls, after a fork, and where one fails."""

from __future__ import annotations

import multiprocessing
import threading

import numpy as np
import pytest

from bcppl.threads import parallel_sum


def counted(particles: int, chunk: int, threads: int) -> list[int]:
    seen = np.zeros(particles, np.int64)

    def work(first: int, last: int) -> int:
        seen[first:last] += 1
        return last - first

    assert parallel_sum(work, 0, particles, chunk, threads) == particles
    return sorted({int(times) for times in seen})


@pytest.mark.parametrize(
    ("particles", "chunk", "threads"), [(1, 8, 2), (75, 8, 2), (1000, 1, 4), (64, 64, 3)]
)
def test_every_particle_once(particles: int, chunk: int, threads: int) -> None:
    assert counted(particles, chunk, threads) == [1]


def test_a_loop_within_a_loop_ends() -> None:
    assert parallel_sum(lambda a, b: parallel_sum(lambda c, d: d - c, a, b, 1, 2), 0, 40, 4, 2) == 40


def test_several_threads_may_ask_at_once() -> None:
    sums: list[list[int]] = []
    asking = [threading.Thread(target=lambda: sums.append(counted(500, 1, 3))) for _ in range(8)]
    for each in asking:
        each.start()
    for each in asking:
        each.join(timeout=30.0)
    assert sums == [[1]] * 8


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="there is no fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_process_that_was_forked_has_threads_of_its_own() -> None:
    assert counted(100, 1, 2) == [1]
    child = multiprocessing.get_context("fork").Process(target=counted, args=(100, 1, 2))
    child.start()
    child.join(timeout=30.0)
    assert child.exitcode == 0


def test_an_error_is_raised() -> None:
    def fails(first: int, last: int) -> int:
        raise ValueError(f"at {first}")

    with pytest.raises(ValueError, match="at "):
        parallel_sum(fails, 0, 10, 1, 2)
    assert counted(10, 1, 2) == [1]

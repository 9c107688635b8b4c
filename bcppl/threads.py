"""Parallel loops over particles, in threads that release Python's lock while they work."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def thread_count() -> int:
    """The number of threads: one per core available to this process, at most OMP_NUM_THREADS."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, max(int(limit), 1)) if limit.isdecimal() else cores


def parallel_sum(work: Callable[[int, int], int], begin: int, end: int, chunk: int, threads: int) -> int:
    """The sum of `work(first, last)` over chunks of particles, computed by several threads.

    The threads end with the call: a persistent pool would not survive a fork of the process.

    Args:
        work: of the first particle of a chunk and the one after its last.
        begin: the first of all particles.
        end: the one after the last.
        chunk: particles of a chunk.
        threads: at most so many.
    """
    starts = range(begin, end, chunk)
    if min(threads, len(starts)) <= 1:
        return work(begin, end) if end > begin else 0
    with ThreadPoolExecutor(min(threads, len(starts))) as pool:
        return sum(pool.map(lambda first: work(first, min(first + chunk, end)), starts))

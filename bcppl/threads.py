"""Parallel loops over particles, in threads that release Python's lock while they work."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def thread_count() -> int:
    """The number of threads: one per core available to this process, at most OMP_NUM_THREADS."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, max(int(limit), 1)) if limit.isdecimal() else cores


@functools.cache
def _others(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_others.cache_clear)  # the threads stay behind


def parallel_sum(work: Callable[[int, int], int], begin: int, end: int, chunk: int, threads: int) -> int:
    """The sum of `work(first, last)` over chunks of particles, computed by this thread and others.

    Args:
        work: of the first particle of a chunk and the one after its last.
        begin: the first of all particles.
        end: the one after the last.
        chunk: particles of a chunk.
        threads: at most so many.
    """
    starts = range(begin, end, chunk)
    others = min(threads, len(starts)) - 1
    if others < 1:
        return work(begin, end) if end > begin else 0
    left = iter(starts)

    def share() -> int:
        return sum(work(first, min(first + chunk, end)) for first in left)

    pool = _others(threads - 1)
    shares = [pool.submit(share) for _ in range(others)]
    # One that has not begun by the end of this one's share has nothing left to do.
    return share() + sum(each.result() for each in shares if not each.cancel())

"""Work on many particles shared among threads that hold no lock of Python's while they work."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable


def thread_count() -> int:
    """One thread on each core that this process may use, or as many as OMP_NUM_THREADS says."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, max(int(asked), 1)) if asked.isdecimal() else cores


def shared(work: Callable[[int, int], int], begin: int, end: int, share: int, threads: int) -> int:
    """The sum of `work(first, last)` over runs of `share` particles, shared among threads.

    The threads end with the call: a pool that is kept would not survive a fork of the process.

    Args:
        work: of the first particle of a run and the one after its last.
        begin: the first of all particles.
        end: the one after the last.
        share: how many are one run.
        threads: at most so many.
    """
    threads = min(threads, -(-(end - begin) // share))
    if threads <= 1:
        return work(begin, end) if end > begin else 0
    runs, sums, errors = iter(range(begin, end, share)), [0] * threads, list[BaseException]()

    def take(thread: int) -> None:
        try:
            for first in runs:  # `next` of a range holds Python's lock, so each run is taken once
                sums[thread] += work(first, min(first + share, end))
        except BaseException as error:
            errors.append(error)

    others = [threading.Thread(target=take, args=(k,)) for k in range(1, threads)]
    for other in others:
        other.start()
    take(0)
    for other in others:
        other.join()
    if errors:
        raise errors[0]
    return sum(sums)

"""The same function at many arguments, in one process or in several of one thread each."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

import torch

Argument = TypeVar("Argument")
Result = TypeVar("Result")

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def each(function: Callable[[Argument], Result], arguments: Iterable[Argument], jobs: int) -> list[Result]:
    """The results in order; with one job everything stays in this process, with all its threads."""
    return list(in_order(function, arguments, jobs))


def in_order(
    function: Callable[[Argument], Result], arguments: Iterable[Argument], jobs: int
) -> Iterator[Result]:
    """The same, one after another, as soon as those before are there."""
    if jobs == 1:
        yield from map(function, arguments)
        return
    # Read by the libraries when a child loads them: new processes, not copies of this one.
    os.environ.update(dict.fromkeys(THREADS, "1"))
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, spawned, torch.set_num_threads, (1,)) as pool:
        yield from pool.map(function, arguments)

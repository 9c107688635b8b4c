"""The same function at many arguments, in one process or in several of one thread each."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

import torch

Argument = TypeVar("Argument")
Result = TypeVar("Result")

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def each(function: Callable[[Argument], Result], arguments: Iterable[Argument], jobs: int) -> list[Result]:
    """The results in order; with one job everything stays in this process, with all its threads."""
    if jobs == 1:
        return [function(argument) for argument in arguments]
    # Read by the libraries when a child loads them: new processes, not copies of this one.
    os.environ.update(dict.fromkeys(THREADS, "1"))
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, spawned, torch.set_num_threads, (1,)) as pool:
        return list(pool.map(function, arguments))

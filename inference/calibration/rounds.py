"""Independent rounds of a job, one for each seed: in several processes, and kept in a folder."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from bcppl.errors import InferenceError, InputError, reason_of
from bcppl.inference.progress import watched
from bcppl.recordings.hdf5 import replacing
from bcppl.sweeps import Failure, as_they_end

Result = TypeVar("Result")

Arrays = Mapping[str, npt.NDArray[Any]]


def gathered(
    job: Callable[[int], Result], seeds: Sequence[int], jobs: int = 1, progress: bool = True
) -> Iterator[tuple[int, Result]]:
    """The number of each seed and `job(seed)`, in the order in which they end.

    Args:
        job: of a seed.
        seeds: of the rounds.
        jobs: how many at a time: above 1 in other processes, of one thread each.
        progress: show a bar, on a terminal or in a notebook.

    Raises:
        InputError: the job cannot be sent to another process.
        InferenceError: a process has ended.
    """
    numbered = list(enumerate(seeds))
    ending = as_they_end(partial(_of_seed, job), numbered, jobs)
    for (number, seed), result in watched(
        ending, total=len(numbered), description="rounds", progress=progress
    ):
        if isinstance(result, Failure):
            raise InferenceError(f"the process of the round with seed {seed} has ended: {result.reason}")
        yield number, result


def _of_seed(job: Callable[[int], Result], numbered: tuple[int, int]) -> Result:
    return job(numbered[1])


def kept(path: Path) -> Arrays | None:
    """The arrays of a round in a file; None where there is none.

    Raises:
        InputError: the file is damaged.
    """
    if not path.is_file():
        return None
    try:
        with zipfile.ZipFile(path) as packed:
            if sum(each.file_size for each in packed.infolist()) > path.stat().st_size:
                raise ValueError("it is compressed")
            if damaged := packed.testzip():
                raise ValueError(f"the checksum of {damaged} is wrong")
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        if not all(isinstance(each, np.ndarray) for each in arrays.values()):
            raise ValueError("it holds something else than arrays")
        return arrays
    except Exception as error:  # zip files and numpy have errors of many types
        reason = reason_of(error)
        raise InputError(f"{path} is no round of a calibration ({reason}); remove it.") from error


def keep(path: Path, arrays: Arrays) -> None:
    """Write the arrays of a round, all or nothing.

    Raises:
        InputError: the file cannot be written.
    """
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]

"""Independent rounds of a job, one for each seed: in several processes, and kept in a folder."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from bcppl.errors import InputError
from bcppl.inference.progress import watched
from bcppl.recordings.file import replacing

Arrays = Mapping[str, npt.NDArray[Any]]


def gathered(
    job: Callable[[int], Any], seeds: Sequence[int], processes: int = 1, progress: bool = True
) -> Iterator[tuple[int, Any]]:
    """The number of each seed and `job(seed)`, in the order in which they end.

    Args:
        job: with several processes a function of a module, or an object that can be pickled.
        seeds: of the rounds.
        processes: above 1, fresh ones, of one thread each.
        progress: show a bar, on a terminal or in a notebook.

    Raises:
        InputError: the job cannot be sent to another process.
    """
    if processes == 1:
        for number, seed in enumerate(watched(seeds, description="rounds", progress=progress)):
            yield number, job(seed)
        return
    try:
        pickle.dumps(job)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InputError(
            f"rounds cannot be sent to another process ({error}); give functions of a module, or "
            "functools.partials of them."
        ) from error
    # MuJoCo's threads do not survive a fork.
    with ProcessPoolExecutor(
        processes, get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        numbers = {pool.submit(job, seed): number for number, seed in enumerate(seeds)}
        ending = as_completed(numbers)
        try:
            for done in watched(ending, total=len(seeds), description="rounds", progress=progress):
                yield numbers[done], done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def kept(path: Path) -> Arrays | None:
    """The arrays of a round in a file; None where there is none.

    Raises:
        InputError: the file is damaged.
    """
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is no round of a calibration ({error}); remove it.") from error


def keep(path: Path, arrays: Arrays) -> None:
    """Write the arrays of a round, all or nothing.

    Raises:
        InputError: the file cannot be written.
    """
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]

"""The same function at many cells, in this process, in many, or on a cluster; each result is kept once.

    from bcppl.sweeps import product, swept

    cells = product(recording=["a.h5", "b.h5"], particles=[75, 300], seed=range(20))
    for cell, result in swept(evaluate, cells, file=Path("results.jsonl"), jobs=4):
        ...

Jobs are processes of one thread each, as joblib begins them (loky). Within `joblib.parallel_config("ray")` or
`("dask")` they are workers of that cluster, and with `share` several calls, such as the tasks of a SLURM
array, divide the cells among themselves. A result is the same wherever its cell is evaluated.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from pickle import PicklingError
from typing import Any, NamedTuple, TypeVar

from bcppl.arguments import named
from bcppl.errors import InferenceError, InputError
from bcppl.untrusted import strict_json

Argument = TypeVar("Argument")
Result = TypeVar("Result")
_STATED = 5  # reasons of failures
_UNDER_WAY = 2  # times the number of jobs: what joblib sends out ahead
Cell = Any  # what JSON holds: a mapping of settings by name, or a sequence of them


class Failure(NamedTuple):
    """Why a cell has no result: the name of an exception and what it says, in one line."""

    reason: str


class CellsFailed(InferenceError):
    """Cells of a sweep have failed; the others have ended.

    Attributes:
        failures: each cell that failed, and why.
    """

    def __init__(self, failed: Sequence[tuple[Cell, Failure]], total: int) -> None:
        self.failures = [(cell, failure.reason) for cell, failure in failed]
        reasons: dict[str, list[Cell]] = {}
        for cell, reason in self.failures:
            reasons.setdefault(reason, []).append(cell)
        several = [
            f"{json.dumps(cells[0])}{f' and {len(cells) - 1} more' if len(cells) > 1 else ''} with {reason}"
            for reason, cells in list(reasons.items())[:_STATED]
        ]
        more = f"; and for {len(reasons) - _STATED} other reasons" if len(reasons) > _STATED else ""
        super().__init__(
            f"{len(failed)} of {total} cells failed, {'; '.join(several)}{more}; the same call tries these "
            "again, and no other."
        )


def product(**axes: Iterable[Any]) -> list[dict[str, Any]]:
    """The cells of all combinations of values, the last name's varying fastest."""
    return [
        dict(zip(axes, values, strict=True))
        for values in itertools.product(*[list(a) for a in axes.values()])
    ]


def swept(
    function: Callable[[Any], Any],
    cells: Iterable[Cell],
    *,
    file: Path | None = None,
    jobs: int = 1,
    share: tuple[int, int] = (1, 1),
) -> Iterator[tuple[Cell, Any]]:
    """Each cell and its result: first those that the file has, then the others as they end.

    A cell that fails is no reason to stop: its exception is raised after all others have ended, and a later
    call tries it again. So it is with a cell that ends its process.

    Args:
        function: of a cell; its result is what JSON holds. It comes back as JSON gives it: tuples as lists.
        cells: each once.
        file: where results are kept, a line of JSON for each, written as soon as it is there. Workers of a
            cluster write it themselves, so that they have to reach it.
        jobs: how many at a time; with one everything stays in this process. -1 is as many as there are cores.
        share: (k, n): only the k-th of n equal shares of the cells, k from 1.

    Raises:
        InputError: the file holds something else, or there is no such share or number of jobs.
        CellsFailed: (from the iterator) cells have failed.
    """
    number, shares = share
    if not 1 <= number <= shares:
        raise InputError(f"share {number} of {shares} does not exist; give one from 1 of {shares}.")
    _refuse_none(jobs)
    mine = {key_of(cell): cell for cell in list(cells)[number - 1 :: shares]}
    return _each(partial(_evaluated, function, file), mine, {} if file is None else kept(file), jobs)


def _each(
    work: Callable[[Any], Any], mine: Mapping[str, Cell], known: Mapping[str, Any], jobs: int
) -> Iterator[tuple[Cell, Any]]:
    missing = [cell for key, cell in mine.items() if key not in known]
    yield from ((cell, known[key]) for key, cell in mine.items() if key in known)
    failed: list[tuple[Cell, Failure]] = []
    for cell, result in as_they_end(work, missing, jobs):
        if isinstance(result, Failure):
            failed.append((cell, result))
        else:
            yield cell, result
    if failed:
        raise CellsFailed(failed, len(mine))


def in_order(
    function: Callable[[Argument], Result], arguments: Iterable[Argument], jobs: int = 1
) -> Iterator[Result]:
    """The results in the order of the arguments, each as soon as those before are there.

    With several jobs they are begun at once, whenever the first result is asked for.

    Args:
        function: of one argument.
        arguments: any.
        jobs: how many at a time; with one everything stays in this process, with all its threads.

    Raises:
        InputError: the function cannot be sent to another process, or there is no such number of jobs.
    """
    _refuse_none(jobs)
    return _parallel(function, arguments, jobs, "generator")


def as_they_end(
    function: Callable[[Argument], Result], arguments: Sequence[Argument], jobs: int = 1
) -> Iterator[tuple[Argument, Result | Failure]]:
    """Each argument and its result, as they end; a process that dies takes no other result with it."""
    from joblib import effective_n_jobs

    left, work = dict(enumerate(arguments)), partial(_numbered, function)
    while left:
        try:
            for number, result in _parallel(work, list(left.items()), jobs, "generator_unordered"):
                yield left.pop(number), result
        except BrokenProcessPool:
            # Which of those under way has ended its process is not known: each has one of its own.
            for number in list(left)[: _UNDER_WAY * effective_n_jobs(jobs)]:
                try:
                    ((_, ended),) = _parallel(work, [(number, left[number])], 2, "generator")
                except BrokenProcessPool as error:
                    yield left.pop(number), Failure(one_line(error))
                else:
                    yield left.pop(number), ended


def key_of(cell: Cell) -> str:
    """What tells a cell from others: its JSON, names in their alphabetical order.

    Raises:
        InputError: the cell holds what JSON does not.
    """
    try:
        return json.dumps(cell, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{named('a cell of a sweep is {}', cell)}, which JSON does not hold ({error}); give numbers, "
            "text, lists and maps: int(seed), str(path)."
        ) from error


def kept(file: Path) -> dict[str, Any]:
    """The results in a file by `key_of` their cells; a last line without its end does not count.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines(keepends=True) if file.exists() else []
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file} holds no results of a sweep ({error}); give another file.") from error
    found: dict[str, Any] = {}
    for number, line in enumerate(lines, 1):
        if not line.endswith("\n"):
            continue
        try:
            cell, result = strict_json.parsed(line, finite=False)
        except (ValueError, TypeError) as error:
            raise InputError(
                f"line {number} of {file} is no result of a sweep ({error}); remove it, or give another file."
            ) from error
        found.setdefault(key_of(cell), result)
    return found


def keep(file: Path, cell: Cell, result: Any) -> None:
    """Add a result to a file, in one piece whoever else writes it."""
    from filelock import FileLock

    with FileLock(f"{file}.lock"), file.open("a+b") as lines:
        # A process that was killed may have left a line without its end.
        end = lines.seek(0, os.SEEK_END)
        while end and (lines.seek(end - 1), lines.read(1))[1] != b"\n":
            end -= 1
        lines.truncate(end)
        lines.write(json.dumps([cell, result]).encode() + b"\n")


def one_line(error: BaseException) -> str:
    """The name and the message of an exception, in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]


def _evaluated(function: Callable[[Any], Any], file: Path | None, cell: Cell) -> Any:
    """The result of a cell as JSON gives it back, kept; or why there is none. Always by one thread."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        result = json.loads(json.dumps(function(cell)))
        if file is not None:
            keep(file, cell, result)
        return result
    except (Exception, SystemExit) as error:
        return Failure(one_line(error))
    finally:
        torch.set_num_threads(threads)


def _refuse_none(jobs: int) -> None:
    if jobs != -1 and not jobs >= 1:
        raise InputError(f"{jobs} jobs at a time were asked for; give 1 or more, or -1 for all cores.")


def _numbered(function: Callable[[Argument], Result], item: tuple[int, Argument]) -> tuple[int, Result]:
    return item[0], function(item[1])


def _parallel(
    function: Callable[[Argument], Result], arguments: Iterable[Argument], jobs: int, returned: str
) -> Iterator[Result]:
    """The results; other processes begin with them when this is called."""
    if jobs == 1:
        return map(function, arguments)
    from joblib import Parallel, delayed, parallel_config
    from joblib.parallel import get_active_backend

    settings: dict[str, Any] = {"n_jobs": jobs, "batch_size": 1}
    backend, _ = get_active_backend()
    if backend.supports_inner_max_num_threads:
        with parallel_config("loky", inner_max_num_threads=1):
            workers = Parallel(return_as=returned, **settings)
    elif backend.supports_return_generator:
        workers = Parallel(return_as=returned, **settings)
    else:  # Ray's gives everything at the end
        workers = Parallel(**settings)
    return _sent(workers(delayed(function)(argument) for argument in arguments))


def _sent(results: Iterable[Result]) -> Iterator[Result]:
    """The results of other processes, if what they are of could be sent there."""
    try:
        yield from results
    except PicklingError as error:
        raise InputError(
            f"the function cannot be sent to another process ({error.__cause__ or error}); leave out what "
            "only this process has, such as open files and generators, or let one process do it."
        ) from error

"""What a sweep costs: the overhead of a cell, and how well two workers divide runs, beside a bare loop.

The runs are of the shipped pushes, as many as `--runs`. Results have to be equal whoever computes them; that
of a backend which is not installed is left out. What the machine allows is measured as well: two processes of
which each computes half of the runs, with nothing between them.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from threading import Barrier
from typing import Any

import torch
from report import Row, finish, options, show

import bcppl
from bcppl.cli.commands.sweep import workers
from bcppl.models.point_probe import model
from bcppl.models.shipped import load_recording
from bcppl.sweeps import kept, key_of, product, swept

OVERHEAD, EFFICIENCY = 0.02, 0.85  # s a cell; of two workers
NEEDS = {"ray": "ray", "dask": "distributed"}
EMPTY = 500  # cells of which only the overhead is measured


def run(cell: dict[str, int]) -> dict[str, Any]:
    """The mean of the last belief of one run."""
    recording = load_recording("point_probe_10_pushes")
    *_, step = bcppl.infer(model, recording, particles=cell["particles"], seed=cell["seed"])
    return {"mean": step.belief.mean.tolist(), "log_evidence": step.info.log_evidence}


def nothing(cell: dict[str, int]) -> int:
    """A cell that does nothing."""
    return cell["seed"]


def computed(cells: list[dict[str, int]], begin: Barrier) -> None:
    """A process's share of the runs, from when all others have begun as well."""
    torch.set_num_threads(1)
    run(dict(cells[0], seed=10_000))
    begin.wait()
    for cell in cells:
        run(cell)


def apart(cells: list[dict[str, int]], processes: int) -> float:
    """Seconds of the runs in processes of their own."""
    context = multiprocessing.get_context("spawn")
    begin = context.Barrier(processes + 1)
    each = [context.Process(target=computed, args=(cells[k::processes], begin)) for k in range(processes)]
    for process in each:
        process.start()
    begin.wait()
    begun = time.perf_counter()
    for process in each:
        process.join()
    return time.perf_counter() - begun


def timed(function: Any, cells: list[dict[str, int]], jobs: int, file: Path) -> tuple[float, dict[str, Any]]:
    """Seconds of a sweep, its workers begun before, and what it has kept."""
    list(swept(function, [dict(cell, seed=10_000 + k) for k, cell in enumerate(cells[:jobs])], jobs=jobs))
    begun = time.perf_counter()
    list(swept(function, cells, file=file, jobs=jobs))
    return time.perf_counter() - begun, kept(file)


def main() -> None:
    parser = options(__doc__ or "")
    parser.add_argument("--runs", type=int, default=16)
    arguments = parser.parse_args()
    runs, empty = (2, 20) if arguments.quick else (arguments.runs, EMPTY)
    torch.set_num_threads(1)
    cells = product(particles=[20], seed=range(arguments.seed, arguments.seed + runs))
    seeds = product(seed=range(empty))
    run(cells[0])
    begun = time.perf_counter()
    loop = {key_of(cell): run(cell) for cell in cells}
    bare = time.perf_counter() - begun
    ways = [("loky", 1), ("loky", 2), *((name, 2) for name, package in NEEDS.items() if find_spec(package))]
    lines: list[list[Any]] = [["bare loop", bare, 1.0, "", "", ""]]
    bound = bare / (2.0 * (seconds := apart(cells, 2)))
    lines.append(["two processes", seconds, bare / seconds, bound, "", ""])
    rows = [Row("two processes with nothing between them: efficiency", bound, "")]
    for backend, jobs in ways:
        with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
            stack.enter_context(workers(backend))
            name = f"{backend}, {jobs} at a time"
            seconds, found = timed(run, cells, jobs, Path(folder) / "runs.jsonl")
            spent, _ = timed(nothing, seeds, jobs, Path(folder) / "empty.jsonl")
            efficiency, overhead = bare / (jobs * seconds), spent / empty
            equal = found == loop
            lines.append([name, seconds, bare / seconds, efficiency, 1e3 * overhead, str(equal)])
            rows.append(Row(f"{name}: results equal", float(equal), "", 1.0, "min"))
            rows.append(Row(f"{name}: overhead of a cell", overhead, "s", OVERHEAD))
            goal = EFFICIENCY if jobs == 2 else None
            rows.append(Row(f"{name}: efficiency", efficiency, "", goal, "min"))
    columns = ["", "s", "speed-up", "efficiency", "overhead ms", "equal"]
    show(f"{runs} runs of 20 particles, {empty} empty cells", columns, lines)
    finish(rows, arguments.json)


if __name__ == "__main__":
    main()

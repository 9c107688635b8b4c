"""Writes the tables of kernels from the cells that `benchmarks/exact.py` has kept."""

from __future__ import annotations

import json
import math
from pathlib import Path

CELLS = Path(__file__).resolve().parents[1] / "benchmarks/exact.jsonl"


def page() -> str:
    """Root mean squared errors of log Z, a table for each number of particles, in Markdown."""
    measured: dict[tuple[str, str, int], list[tuple[int, float, float]]] = {}
    for line in CELLS.read_text(encoding="utf-8").splitlines():
        (problem, kernel, particles, _), outcome = json.loads(line)
        runs, bias, deviation = outcome[:3]
        if runs:
            measured.setdefault((problem, kernel, particles), []).append((runs, bias, deviation))
    problems, kernels, counts = (list(dict.fromkeys(each)) for each in zip(*measured, strict=True))
    made = (
        "# Kernels on problems with exact answers\n\n"
        "Root mean squared error of log Z, in nats, of tempered SMC with each kernel, over up to thirty "
        "seeds; a dash where it was not measured. The cells are those of `benchmarks/exact.jsonl`, measured "
        "with the version that the file came with; `benchmarks/exact_problems.py` and `exact_kernels.py` "
        "define problems and kernels, and `python benchmarks/exact.py --recorded` shows bias, moments and "
        "seconds as well. [Which kernel when](../which_kernel.md) says how to read them.\n"
    )
    for count in sorted(counts):
        made += (
            f"\n## {count} particles\n\n| problem | {' | '.join(kernels)} |\n|---|{'---|' * len(kernels)}\n"
        )
        for problem in problems:
            cells = [_error(measured.get((problem, kernel, count))) for kernel in kernels]
            if any(cell != "–" for cell in cells):
                made += f"| {problem} | {' | '.join(cells)} |\n"
    return made


def _error(cells: list[tuple[int, float, float]] | None) -> str:
    """The error over all runs of a problem, a kernel and a number of particles."""
    if cells is None:
        return "–"
    total = sum(runs for runs, _, _ in cells)
    squared = sum(runs * bias**2 + max(runs - 1, 0) * deviation**2 for runs, bias, deviation in cells) / total
    error = math.sqrt(squared)
    return f"{error:.2f}" if error < 10.0 else f"{error:.0f}"

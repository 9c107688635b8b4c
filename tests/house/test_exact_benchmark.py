"""Figures of a cell that is run in pieces are those of all its runs."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import exact

CELL = exact.Cell("Gaussian, D = 2, isotropic", "drift", 30, tuple(range(7)))


@pytest.mark.long
def test_a_file_adds_the_runs_that_a_cell_lacks(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    file = tmp_path / "cells.jsonl"
    whole = exact.measured(CELL)[1]._asdict()
    assert exact.outcome_of(file, -1.0, math.inf, CELL) is None
    # No time for more than the fewest runs.
    assert (few := exact.outcome_of(file, math.inf, 0.0, CELL)) is not None and few.runs == exact.LEAST
    assert exact.outcome_of(file, math.inf, 0.0, CELL) == few
    together = exact.outcome_of(file, math.inf, math.inf, CELL)
    assert together is not None and len(file.read_text().splitlines()) == 2
    for name, value in together._asdict().items():
        if name not in ("largest", "seconds"):
            assert value == pytest.approx(whole[name], rel=1e-4), name
    assert exact.outcome_of(file, -1.0, math.inf, CELL) == together  # as recorded

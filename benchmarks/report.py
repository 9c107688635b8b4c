"""What a benchmark is asked and what it answers: options, tables, and rows with a goal that is met or not."""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rich.console import Console
from rich.table import Table

DATA = Path(__file__).parents[2] / "shared" / "data"


class Row(NamedTuple):
    """One measured number.

    Attributes:
        name, value, unit: what, how much, of what.
        goal: what it should be; None for a number that is only reported.
        direction: "max" where the goal is an upper bound, "min" where it is a lower one.
    """

    name: str
    value: float
    unit: str
    goal: float | None = None
    direction: Literal["max", "min"] = "max"

    @property
    def meets(self) -> bool | None:
        """Whether the goal is met; None where there is none."""
        if self.goal is None:
            return None
        return self.value <= self.goal if self.direction == "max" else self.value >= self.goal


def options(description: str) -> argparse.ArgumentParser:
    """A parser of what every benchmark takes: --quick, --seed and --json."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="a small run that shows that everything works")
    parser.add_argument("--seed", type=int, default=0, help="the first seed; the others follow it")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows to a file")
    return parser


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def show(title: str, columns: Sequence[str], lines: Sequence[Sequence[Any]]) -> None:
    """Print a table: strings as they are, integers whole, other numbers with three digits or two decimals."""
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for k, column in enumerate(columns):
        table.add_column(column, justify="right" if k else "left", no_wrap=True)
    for line in lines:
        table.add_row(*[cell if isinstance(cell, str) else number(cell) for cell in line])
    console = Console(highlight=False)
    console.width = max(console.width, 200)  # cut by nothing, also where the output is no terminal
    console.print(table)
    console.print()


def number(value: float) -> str:
    """A number as a table shows it."""
    if isinstance(value, int):
        return str(value)
    return "-" if math.isnan(value) else f"{value:.2f}" if abs(value) < 100 else f"{value:.0f}"


def finish(rows: Sequence[Row], file: Path | None) -> None:
    """Print the rows that have a goal, and write all of them to a JSON file if one is given."""
    rows = [*rows, Row("cores of the machine", cores(), "cores")]
    lines = [
        [
            r.name,
            r.value,
            r.unit,
            f"{'<=' if r.direction == 'max' else '>='} {r.goal:g}",
            "yes" if r.meets else "NO",
        ]
        for r in rows
        if r.goal is not None
    ]
    show(f"goals ({cores()} cores)", ["", "measured", "unit", "goal", "met"], lines)
    if file is not None:
        written = [
            {**r._asdict(), "value": None if math.isnan(r.value) else r.value, "meets": r.meets} for r in rows
        ]
        file.write_text(json.dumps(written, indent=1) + "\n")

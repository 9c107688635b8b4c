"""Cells of a sweep: each evaluated and kept once, with any number of workers, also after a kill."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from bcppl.errors import InferenceError, InputError
from bcppl.sweeps import CellsFailed, as_they_end, in_order, keep, kept, key_of, product, swept

CELLS = product(scale=[1.0, 2.0], seed=range(4))
SLOW = """
import sys, time
from pathlib import Path
from bcppl.sweeps import product, swept

def slow(cell):
    time.sleep(0.2)
    return cell["seed"] ** 2

list(swept(slow, product(seed=range(40)), file=Path(sys.argv[1]), jobs=2))
"""


def drawn(cell: dict[str, Any]) -> dict[str, Any]:
    """Numbers whose last bits depend on how many threads add them."""
    generator = torch.Generator().manual_seed(cell["seed"])
    values = torch.randn(200_000, generator=generator, dtype=torch.float32)
    return {"sum": cell["scale"] * float((values @ values).sum()), "threads": torch.get_num_threads()}


def refusing(folder: Path, cell: dict[str, Any]) -> int:
    if cell["seed"] == 2 and not (folder / "mended").exists():
        raise ValueError("seed 2 is bad")
    return int(cell["seed"])


def dying(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_any_number_of_workers_and_shares_give_the_same(tmp_path: Path) -> None:
    one = {key_of(cell): result for cell, result in swept(drawn, CELLS)}
    two = {key_of(cell): result for cell, result in swept(drawn, CELLS, jobs=2)}
    assert one == two and len(one) == 8 and {r["threads"] for r in one.values()} == {1}
    file = tmp_path / "shares.jsonl"
    parts = [dict.fromkeys(map(key_of, (c for c, _ in swept(drawn, CELLS, share=(k, 3))))) for k in (1, 2, 3)]
    assert sorted(key for part in parts for key in part) == sorted(one)
    for k in (1, 2, 3):
        list(swept(drawn, CELLS, file=file, share=(k, 3)))
    assert kept(file) == one


def test_what_is_kept_is_not_evaluated_again_and_what_failed_is(tmp_path: Path) -> None:
    file, work = tmp_path / "results.jsonl", partial(refusing, tmp_path)
    with pytest.raises(
        InferenceError, match=r'1 of 4 cells failed, \{"seed": 2\} with ValueError: seed 2 is'
    ):
        list(swept(work, product(seed=range(4)), file=file))
    before = file.read_text()
    assert len(kept(file)) == 3
    (tmp_path / "mended").touch()
    assert dict((c["seed"], r) for c, r in swept(work, product(seed=range(4)), file=file)) == {
        k: k for k in range(4)
    }
    assert file.read_text().startswith(before) and len(file.read_text().splitlines()) == 4


@pytest.mark.long
def test_a_process_that_dies_takes_no_other_result_with_it() -> None:
    found = dict(as_they_end(dying, range(12), 2))
    assert "SIGKILL" in found.pop(3).reason  # type: ignore[union-attr]
    assert found == {k: k for k in range(12) if k != 3}
    assert list(in_order(lambda k: k + 1, range(5), 2)) == [1, 2, 3, 4, 5]


@pytest.mark.long
def test_a_sweep_that_is_killed_goes_on(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    command = [sys.executable, "-c", SLOW, str(file)]
    with subprocess.Popen(command, start_new_session=True) as process:
        while len(kept(file)) < 5:
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGKILL)
    known = len(kept(file))
    assert 5 <= known < 40
    with file.open("a") as lines:
        lines.write('[{"seed": 39}, 15')  # as a machine leaves it that stops while it writes
    subprocess.run(command, check=True)
    assert kept(file) == {key_of({"seed": k}): k * k for k in range(40)}
    assert len(file.read_text().splitlines()) == 40


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    keep(file, {"seed": 0}, 1)
    assert kept(file) == {'{"seed": 0}': 1}
    file.write_text("not results\n" + file.read_text())
    with pytest.raises(InputError, match=r"line 1 of .*notes.txt is no result of a sweep"):
        list(swept(drawn, CELLS, file=file))
    with pytest.raises(InputError, match="share 4 of 3 does not exist"):
        list(swept(drawn, CELLS, share=(4, 3)))


def test_a_result_without_the_end_of_its_line_is_found_again(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    file.write_text('[{"seed": 0}, 1]\n[{"seed": 1}, 2]')
    results = {cell["seed"]: result for cell, result in swept(plus_one, product(seed=range(3)), file=file)}
    assert results == {0: 1, 1: 2, 2: 3}
    assert len(kept(file)) == 3


def plus_one(cell: dict[str, int]) -> int:
    return cell["seed"] + 1


def test_a_cell_that_json_does_not_hold_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"PosixPath.*which JSON does not hold.*str\(path\)"):
        list(swept(plus_one, product(seed=[tmp_path])))


def leaving(cell: dict[str, int]) -> int:
    if cell["seed"] % 2:
        raise SystemExit(3)
    return cell["seed"]


def test_reasons_of_failures_are_stated_once_each_and_none_ends_the_sweep() -> None:
    done = swept(leaving, product(seed=range(5)))
    assert [next(done)[1] for _ in range(3)] == [0, 2, 4]
    stated = r'2 of 5 cells failed, \{"seed": 1\} and 1 more with SystemExit: 3'
    with pytest.raises(CellsFailed, match=stated) as failed:
        next(done)
    assert [cell["seed"] for cell, _ in failed.value.failures] == [1, 3]

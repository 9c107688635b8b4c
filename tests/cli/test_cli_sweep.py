"""`bcppl sweep`: combinations run once, tables, and what is refused."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from bcppl.recordings import save
from bcppl.recordings.beliefs import load_belief
from tests.command_line import FEW_MOVES, Ran, short

WORDS = ("--inference", FEW_MOVES, "--particles", 8, "--out", "found")


@pytest.mark.long
def test_each_combination_is_run_once_and_reads_as_a_table(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "one.h5")
    save(short(2), tmp_path / "two.h5")
    ran = bcppl("sweep", "one.h5", "one.h5", "--seeds", "0:2", *WORDS)
    assert ran.code == 0 and "2 of 2 runs are in found" in ran.out, ran.err
    first = (tmp_path / "found/results.jsonl").read_text()
    ran = bcppl("sweep", "one.h5", "two.h5", "--seeds", "0:2", "--particles", 6, *WORDS)
    assert ran.code == 0 and "8 of 8 runs are in found" in ran.out
    every = (tmp_path / "found/results.jsonl").read_text()
    assert every.startswith(first) and len(every.splitlines()) == 8
    assert "particles=6" in ran.out and "particles=8" in ran.out and "recording" not in ran.out
    with (tmp_path / "found/results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(r["recording"], r["particles"], r["seed"]) for r in rows} == {
        (name, count, seed) for name in ("one.h5", "two.h5") for count in "68" for seed in "01"
    }
    for row in rows:
        belief = load_belief(tmp_path / "found" / row["belief"])
        assert len(belief.weights) == int(row["particles"])
        assert json.loads(row["mean"]) == belief.mean.tolist()


@pytest.mark.long
def test_a_run_is_the_same_as_of_the_command_run(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(2), tmp_path / "two.h5")
    assert bcppl("sweep", "two.h5", "--seeds", 3, "--jobs", 2, *WORDS).code == 0
    assert bcppl("run", "two.h5", "--seed", 3, *WORDS[:-1], "alone").code == 0
    (belief,) = (tmp_path / "found/beliefs").iterdir()
    swept, alone = load_belief(belief), load_belief(tmp_path / "alone/belief_002.h5")
    assert swept.world_from_part.equal(alone.world_from_part) and swept.log_weights.equal(alone.log_weights)


def test_a_changed_file_is_another_cell_and_a_failure_is_tried_again(
    bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    save(short(1), tmp_path / "log.h5")
    mine = FEW_MOVES.read_text() + (
        "\n\ndef broken(model, recording, **options):\n"
        "    from bcppl.errors import InferenceError\n"
        "    raise InferenceError('no particle is left.')\n"
    )
    (tmp_path / "mine.py").write_text(mine + "\ninfer = broken\n")
    words = ("--inference", "mine.py", *WORDS[2:])
    ran = bcppl("sweep", "log.h5", *words)
    assert ran.code == 1 and "1 of 1 cells failed" in ran.err and "no particle is left" in ran.err
    with (tmp_path / "found/results.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["recording"] == "log.h5" and row["error"].endswith("no particle is left.")
    (tmp_path / "mine.py").write_text(mine)
    assert bcppl("sweep", "log.h5", *words).code == 0
    assert len((tmp_path / "found/results.jsonl").read_text().splitlines()) == 1


def test_a_setting_that_is_a_file_is_read_again_where_it_has_changed(
    bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    save(short(1), tmp_path / "log.h5")
    (tmp_path / "mine.py").write_text(
        "from dataclasses import replace\nfrom pathlib import Path\n"
        "from bcppl.models.point_probe import model as own\n"
        "def prepare(recording, spread):\n"
        "    return own.prepare(recording, spread=float(Path(spread).read_text()))\n"
        "model = replace(own, prepare=prepare)\n"
    )
    words = ("--model", "mine.py", "--set", "spread=spread.txt", *WORDS)
    for spread in ("0.0004", "0.004", "0.004"):
        (tmp_path / "spread.txt").write_text(spread)
        ran = bcppl("sweep", "log.h5", *words)
        assert ran.code == 0, ran.err
    kept = [json.loads(line)[1] for line in (tmp_path / "found/results.jsonl").read_text().splitlines()]
    assert len(kept) == 2 and kept[0]["log_evidence"] != kept[1]["log_evidence"]
    with (tmp_path / "found/results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["set.spread"] for row in rows] == ["spread.txt"] * 2, "those of earlier calls are there"
    assert all(len(json.loads(row["spread"])) == 6 for row in rows), "the belief's is another"


def test_what_cannot_be_swept_is_refused_in_a_sentence(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    (tmp_path / "a.h5").touch()
    for words, said in (
        (("sweep",), "sweep is given no recording"),
        (("sweep", "missing.h5"), "missing.h5 is not a file"),
        (("sweep", "a.h5", "--scenes", "0:2"), "give one --model and no recordings"),
        (("sweep", "--scenes", "0:2", "--model", "part_in_view"), "simulates no recordings"),
        (("sweep", "a.h5", "--seeds", "2:1"), "is no range of seeds"),
        (("sweep", "a.h5", "--seeds", "x"), "give one number, or a range"),
        (("sweep", "a.h5", "--share", "3"), "give K/N"),
        (("sweep", "a.h5", "--share", "3/2"), "share 3 of 2 does not exist"),
        (("sweep", "a.h5", "--backend", "slurm"), "there is no backend 'slurm'"),
        (("sweep", "a.h5", "--model", "no_such_model"), "no_such_model"),
        (("sweep", "a.h5", "--model", "point_probe", "--inference", "no_such"), "no_such"),
    ):
        ran = bcppl(*words)
        assert ran.code == 2 and said in ran.err and not (tmp_path / "sweep").exists(), (words, ran.err)

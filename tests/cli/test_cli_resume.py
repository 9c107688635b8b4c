"""`bcppl run --resume`: a killed run goes on to the same bits; no run is written over another."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from bcppl.recordings import save
from tests.command_line import FEW_MOVES, Ran, short

# Like `few_moves`, but the process is killed after as many steps as the environment says.
DIES = """
import os, signal
from tests.few_moves import infer as whole

def infer(*args, **options):
    for count, step in enumerate(whole(*args, **options)):
        if str(count) == os.environ.get("DIES_AFTER"):
            os.kill(os.getpid(), signal.SIGKILL)
        yield step
"""
ROOT = Path(__file__).parents[2]


def content(path: Path) -> dict[str, np.ndarray]:
    with h5py.File(path) as file:
        arrays = {name: file[name][()] for name in ("world_from_part", "log_weights", "random_state")}
        return {**arrays, "log_evidence": np.array(file.attrs["log_evidence"])}


@pytest.mark.long
@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_run_that_is_killed_goes_on_to_the_same_bits(
    count: int, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    save(short(), tmp_path / "short.h5")
    (tmp_path / "dies.py").write_text(DIES)
    words = ("run", "short.h5", "--particles", 8, "--seed", 4, "--inference", "dies.py", "--out")
    whole = bcppl(*words, "whole")
    assert whole.code == 0, whole.err
    environment = {**os.environ, "DIES_AFTER": str(count), "PYTHONPATH": str(ROOT)}
    killed = subprocess.run(
        [sys.executable, "-m", "bcppl", *map(str, words), "killed"],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL
    assert len([*(tmp_path / "killed").glob("belief_*.h5")]) == count
    assert json.loads((tmp_path / "killed/run.json").read_text())["complete"] is False
    ran = bcppl("run", "--resume", "killed", "--inference", "dies.py")
    assert ran.code == 0, ran.err
    for k in range(4):
        first, second = (content(tmp_path / name / f"belief_{k:03d}.h5") for name in ("whole", "killed"))
        assert all(np.array_equal(first[name], second[name]) for name in first), k
    first, second = (json.loads((tmp_path / name / "run.json").read_text()) for name in ("whole", "killed"))
    for record in (first, second):
        assert record["complete"] is True
        for row in record["rows"]:
            del row["wall s"]
    assert first == second
    # The table of the whole run is shown, those rows too that the killed process had printed.
    table, shown = (
        [line[:60] for line in each.out.splitlines() if "push" in line[:5]] for each in (whole, ran)
    )
    assert len(table) == 3 and table == shown


@pytest.mark.long
def test_what_a_folder_holds_is_never_written_over(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    words = ("run", "short.h5", "--particles", 4, "--inference", FEW_MOVES)
    assert [bcppl(*words).code for _ in range(2)] == [0, 0]
    assert (tmp_path / "runs/short/run.json").exists() and (tmp_path / "runs/short_2/run.json").exists()
    ran = bcppl(*words, "--out", "runs/short")
    assert ran.code == 2 and "runs/short holds a run already" in ran.err
    assert "--resume runs/short" in ran.err


def test_beliefs_without_a_step_to_go_on_from_are_kept(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    assert bcppl("run", "short.h5", "--particles", 4, "--inference", FEW_MOVES, "--out", "out").code == 0
    (tmp_path / "out/step.h5").unlink()
    before = sorted((file.name, file.read_bytes()) for file in (tmp_path / "out").iterdir())
    ran = bcppl("run", "--resume", "out", "--inference", FEW_MOVES)
    assert ran.code == 2 and "has beliefs and no step.h5 to go on from" in ran.err
    assert sorted((file.name, file.read_bytes()) for file in (tmp_path / "out").iterdir()) == before


def test_a_run_s_own_files_and_recording_are_not_written_over(
    bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    save(short(1), tmp_path / "short.h5")
    assert bcppl("run", "short.h5", "--particles", 4, "--inference", FEW_MOVES, "--out", "out").code == 0
    before = {file: file.read_bytes() for file in (tmp_path / "short.h5", tmp_path / "out/run.json")}
    for words in (
        ("view", "out", "--save", "short.h5"),
        ("view", "out", "--save", "out/run.json"),
        ("probe", "out/belief_001.h5", "--candidates", "touch:2", "--output", "short.h5"),
        ("probe", "out/belief_001.h5", "--candidates", "touch:2", "--output", "out/run.json"),
        ("insert", "out/belief_001.h5", "--output", "out/run.json"),
    ):
        ran = bcppl(*words)
        assert ran.code == 2 and f"would overwrite {words[-1]}, which is read" in ran.err, ran.err
    assert before == {file: file.read_bytes() for file in before}


def test_what_cannot_be_resumed_is_refused(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    save(short(2), tmp_path / "other.h5")
    assert bcppl("run", "short.h5", "--particles", 4, "--inference", FEW_MOVES, "--out", "out").code == 0
    for words, sentence in {
        ("run",): "there is nothing to run",
        ("run", "short.h5", "--set", "a=1", "--set", "a=2"): "--set gives a twice; give it once",
        ("run", "--resume", "nowhere"): "there is no run in nowhere",
        ("run", "--resume", "out"): "data never runs code",
        ("run", "--resume", "out", "--inference", FEW_MOVES, "--seed", 3): "--seed is that of the run in out",
        (
            "run",
            "--resume",
            "out",
            "--inference",
            "guided_smc",
        ): "--inference is 'guided_smc', and the",
        ("run", "--resume", "out", "--model", "peg_in_hole"): "--model is 'peg_in_hole', and the run",
    }.items():
        ran = bcppl(*words)
        assert ran.code == 2 and sentence in ran.err, ran.err
    lesser = json.loads((tmp_path / "out/run.json").read_text())
    del lesser["particles"]
    (tmp_path / "out/run.json").write_text(json.dumps(lesser))
    ran = bcppl("run", "--resume", "out")
    assert ran.code == 2 and "has no particles as `bcppl run` writes it" in ran.err
    (tmp_path / "out/run.json").write_text("[" * 10_000)
    assert "run.json is no valid JSON" in bcppl("run", "--resume", "out").err


def test_a_run_whose_files_have_changed_does_not_go_on(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    (tmp_path / "mine.py").write_text(FEW_MOVES.read_text())
    words = ("--inference", "mine.py")
    assert bcppl("run", "short.h5", "--particles", 4, *words, "--out", "out").code == 0
    assert bcppl("run", "--resume", "out", *words).code == 0
    (tmp_path / "mine.py").write_text(FEW_MOVES.read_text() + "\n# other moves\n")
    ran = bcppl("run", "--resume", "out", *words)
    assert ran.code == 2 and "mine.py has changed since the run in out was begun" in ran.err


@pytest.mark.long
def test_an_inference_program_without_start_is_named(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    (tmp_path / "plain.py").write_text(
        "from tests.few_moves import infer as whole\n"
        "def infer(model, recording, *, particles, seed, scene):\n"
        "    yield from whole(model, recording, particles=particles, seed=seed, scene=scene)\n"
    )
    save(short(1), tmp_path / "short.h5")
    words = ("--particles", 4, "--inference", "plain.py")
    assert bcppl("run", "short.h5", *words, "--out", "out").code == 0
    for command in (("run", "--resume", "out"), ("live", "short.h5")):
        ran = bcppl(*command, "--inference", "plain.py")
        assert ran.code == 2 and "its `infer` takes no `start`" in ran.err

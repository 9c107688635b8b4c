"""What a live belief has assimilated is kept where its program is interrupted."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from bcppl.recordings import load
from bcppl.recordings.beliefs import load_belief

pytestmark = pytest.mark.long


def interrupted(words: list[str], begun: str, folder: Path, by: int = signal.SIGINT) -> str:
    """What `bcppl` prints, where it is interrupted once a line of it has begun so."""
    command = [sys.executable, "-u", "-m", "bcppl", *words]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        printed = []
        for line in process.stdout:
            printed.append(line)
            if line.startswith(begun):
                process.send_signal(by)
                break
        printed.append(process.stdout.read())
        assert process.wait(120) == 130
    return "".join(printed)


def test_a_recording_that_is_played_leaves_its_belief_and_its_page(tmp_path: Path) -> None:
    words = ["live", "peg_probe", "--speed", "0.2", "--particles", "8", "--out", "live.h5"]
    printed = interrupted([*words, "--save", "live.html"], "view 1", tmp_path)
    assert "interrupted; what has been measured is kept" in printed
    assert len(load_belief(tmp_path / "live.h5").world_from_part) == 8
    assert (tmp_path / "live.html").stat().st_size > 10_000


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_a_server_leaves_its_recording_and_belief(tmp_path: Path, by: int) -> None:
    pytest.importorskip("msgpack")
    words = ["serve", "arm_view", "--particles", "8", "--out", "kept"]
    interrupted(words, "listening at", tmp_path, by)
    assert len(load_belief(tmp_path / "kept/belief.h5").world_from_part) == 8
    assert load(tmp_path / "kept/recording.h5").measurements
    assert not (tmp_path / "kept/arrived.h5").exists(), "nothing was left out"


BREAKS = """
from bcppl.inference import guided_smc

def infer(model, recording, *, start=None, **settings):
    if start is not None and start.taken == 2:
        raise RuntimeError("of the program itself")
    yield from guided_smc.infer(model, recording, start=start, **settings)
"""


def test_what_was_assimilated_before_an_error_is_kept(tmp_path: Path) -> None:
    (tmp_path / "breaks.py").write_text(BREAKS)
    command = [sys.executable, "-m", "bcppl"]
    words = ["live", "peg_probe", "--speed", "1000", "--particles", "8", "--inference", "breaks.py"]
    ran = subprocess.run(
        [*command, *words, "--out", "last.h5"], cwd=tmp_path, capture_output=True, text=True, timeout=300
    )
    assert ran.returncode != 0 and "of the program itself" in ran.stderr
    assert len(load_belief(tmp_path / "last.h5").world_from_part) == 8
    assert "the belief is in last.h5" in ran.stdout

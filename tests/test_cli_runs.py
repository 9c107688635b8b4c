"""The command line: what it runs and what it writes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from bcppl.recordings import save
from tests.command_line import PROBE, SHIPPED, Ran, short


def test_a_users_own_files_are_taken_as_readily_as_names(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    mine = (
        PROBE.read_text().replace('f"onset_{k}"', 'f"begin_{k}"').replace("def point_probe(", "def my_probe(")
    )
    (tmp_path / "my_probe.py").write_text(mine.replace("program=point_probe", "program=my_probe"))
    (tmp_path / "my_smc.py").write_text(
        "from bcppl.inference.smc import smc, tempered\n"
        "def infer(model, recording, *, particles, seed, scene):\n"
        "    options = {'particles': particles, 'seed': seed, 'scene': scene}\n"
        "    yield from smc(model, recording, step=tempered(), **options)\n"
    )
    save(short(), tmp_path / "short.h5")
    words = ("--particles", 8, "--model", "my_probe.py", "--inference", tmp_path / "my_smc.py")
    ran = bcppl("run", "short.h5", *words)
    assert ran.code == 0, ran.err
    assert "push 3" in ran.out and "standard deviation" in ran.out
    found = sorted(p.name for p in (tmp_path / "runs/short").iterdir())
    assert found == [
        "add_over_time.png",
        *(f"belief_{k:03d}.h5" for k in range(4)),
        "belief_in_3d.png",
        "run.json",
    ]


def test_the_same_seed_writes_the_same_beliefs(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(2), tmp_path / "short.h5")
    for out, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert bcppl("run", "short.h5", "--particles", 8, "--seed", seed, "--out", out).code == 0
    read = {out: h5py.File(tmp_path / out / "belief_002.h5") for out in "abc"}
    poses = {out: np.array(file["world_from_part"]) for out, file in read.items()}
    assert np.array_equal(poses["a"], poses["b"]) and not np.array_equal(poses["a"], poses["c"])


STOPS = {
    "RuntimeError('boom')": (1, "boom"),
    "InferenceError('no particle is left; use more.')": (1, "no particle is left; use more."),
    "InputError('what was given is wrong.')": (2, "what was given is wrong."),
    "KeyboardInterrupt": (130, None),
}


@pytest.mark.parametrize("error", STOPS)
def test_what_was_computed_before_a_stop_is_kept(
    error: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    (tmp_path / "stops.py").write_text(
        "from bcppl.errors import InferenceError, InputError\n"
        "from bcppl.inference.tempered_smc import infer as whole\n"
        "def infer(*args, **options):\n"
        "    for count, step in enumerate(whole(*args, **options)):\n"
        "        if count == 3:\n"
        f"            raise {error}\n"
        "        yield step\n"
    )
    ran = bcppl("run", SHIPPED, "--particles", 8, "--inference", "stops.py", "--out", "kept")
    code, says = STOPS[error]
    assert ran.code == code and "Traceback" not in ran.err + ran.out
    if says is not None:
        assert says in ran.err and len(ran.err.strip().splitlines()) == 1
    found = sorted(p.name for p in (tmp_path / "kept").iterdir())
    assert found == [
        "add_over_time.png",
        *(f"belief_{k:03d}.h5" for k in range(3)),
        "belief_in_3d.png",
        "run.json",
    ]
    assert "push 2" in ran.out and "standard deviation" in ran.out


def test_an_earlier_runs_beliefs_do_not_lie_among_the_new(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(short(1), tmp_path / "short.h5")
    (tmp_path / "out").mkdir()
    for name in ("belief_007.h5", "old.png", "notes.txt"):
        (tmp_path / "out" / name).write_text("old")
    assert bcppl("run", "short.h5", "--particles", 4, "--out", "out").code == 0
    found = {p.name for p in (tmp_path / "out").iterdir()}
    assert "notes.txt" in found and "belief_007.h5" not in found

"""Data never runs code: a model that data names is looked up, a file is run only where an option gives it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bcppl.beliefs import Belief
from bcppl.recordings import Recording, save
from bcppl.recordings.beliefs import save_belief
from tests.command_line import Ran, short

MARK = "was_run"
HARM = f"""
from pathlib import Path
(Path(__file__).parent / {MARK!r}).touch()
raise RuntimeError("too late")
"""
OWN = f"""
from pathlib import Path
from bcppl.inference.filters.bayes_contact import infer
from bcppl.models.point_probe import model
(Path(__file__).parent / {MARK!r}).touch()
"""


def push(model: str = "point_probe") -> Recording:
    """One push, explained by a model of that name."""
    return replace(short(1), model=model)


def belief(path: Path) -> None:
    """Of the part after that push."""
    pose = torch.as_tensor(push().guess.world_from_part).expand(4, 7).clone()
    pose[:, 0] += 0.001 * torch.arange(4)
    save_belief(
        Belief(pose, torch.zeros(4, dtype=torch.float64)),
        path,
        label="push 1",
        log_evidence=0.0,
        random_state=torch.Generator().get_state(),
        latent={"part": pose},
    )


NAMES = ["harm.py", "./harm.py", "folder/harm.py", "{}/harm.py"]


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A file's name as data may give it; the file leaves a mark when it is run."""
    for folder in (tmp_path, tmp_path / "folder"):
        folder.mkdir(exist_ok=True)
        (folder / "harm.py").write_text(HARM)
    return str(request.param).format(tmp_path)


def assert_refused_unrun(ran: Ran, folder: Path, name: str) -> None:
    assert not list(folder.rglob(MARK)), f"{name} was run"
    assert ran.code == 2 and name in ran.err, (ran.code, ran.err)
    assert len(ran.err.strip().splitlines()) == 1


@pytest.mark.parametrize("command", ["run", "probe"])
def test_a_model_that_a_recording_names_is_no_file(
    command: str, name: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    save(push(name), tmp_path / "push.h5")
    ran = bcppl(command, "push.h5", "--particles", 4, *(["--candidates", "view:1"] * (command == "probe")))
    assert_refused_unrun(ran, tmp_path, name)


def test_a_model_that_a_run_record_names_is_no_file(
    name: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    save(push(), tmp_path / "push.h5")
    belief(tmp_path / "belief_001.h5")
    record = {"recording": "push.h5", "model": name, "inference": name}
    (tmp_path / "run.json").write_text(json.dumps(record))
    ran = bcppl("probe", "belief_001.h5", "--candidates", "view:1")
    assert_refused_unrun(ran, tmp_path, name)
    assert "run.json" in ran.err and "--model" in ran.err


@pytest.mark.parametrize("recorded", [True, False])
def test_a_model_that_a_belief_s_recording_names_is_no_file(
    recorded: bool, name: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    """The recording itself named by the run, or on the command line."""
    save(push(name), tmp_path / "push.h5")
    belief(tmp_path / "belief_001.h5")
    if recorded:
        (tmp_path / "run.json").write_text(json.dumps({"recording": "push.h5"}))
    of = [] if recorded else ["--of", "push.h5"]
    ran = bcppl("probe", "belief_001.h5", "--candidates", "view:1", *of)
    assert_refused_unrun(ran, tmp_path, name)


@pytest.mark.parametrize("named", ["harm.py", "folder/harm.py", "folder/harm"])
def test_check_reports_a_recording_that_names_a_file(
    named: str, bcppl: Callable[..., Ran], tmp_path: Path
) -> None:
    save(push(named), tmp_path / "push.h5")
    ran = bcppl("check", "push.h5")
    assert ran.code == 2 and "no problem" not in ran.out, ran.out
    (problem,) = [line for line in ran.out.splitlines() if line.startswith("wrong:")]
    assert "model" in problem and named in problem
    save(push(), tmp_path / "fine.h5")
    assert bcppl("check", "fine.h5").code == 0


@pytest.mark.long
def test_a_file_on_the_command_line_is_run(bcppl: Callable[..., Ran], tmp_path: Path) -> None:
    save(push(), tmp_path / "push.h5")
    (tmp_path / "mine.py").write_text(OWN)
    ran = bcppl("run", "push.h5", "--model", "mine.py", "--inference", "./mine.py", "--particles", 4)
    assert ran.code == 0, ran.err
    assert (tmp_path / MARK).exists() and (tmp_path / "runs/push/belief_001.h5").exists()
    # The run.json of that run names the file, which is run again only where it is given again.
    (tmp_path / MARK).unlink()
    again = ("probe", "runs/push/belief_001.h5", "--candidates", "view:1")
    assert_refused_unrun(bcppl(*again), tmp_path, "mine.py")
    bcppl(*again, "--model", "mine.py")
    assert (tmp_path / MARK).exists()

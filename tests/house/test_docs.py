"""The programs and commands of README.md and docs/*.md run as they stand; links lead somewhere.

A block that starts with three backticks and `python` runs in every test run, in order, one namespace for each
page. `python no-test` and `sh` blocks take long and run with the long tests alone. `python from FILE` quotes
that file.
"""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

import bcppl
from bcppl import poses
from bcppl.cli import app
from bcppl.contact.sensing.contact_detection import ContactDetector
from bcppl.models.look_and_touch import CAMERAS
from bcppl.recordings.beliefs import load_belief
from bcppl.rendering.ray_casting import RayCaster
from bcppl.sensors import protocol
from bcppl.sensors.likelihoods.contact_probe import TouchSettings

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
FENCED = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)
MOST_LINES = 150  # of the README


class Block(NamedTuple):
    """A fenced block: its language, what follows the language, and its lines."""

    language: str
    mark: str
    text: str


def blocks(page: Path) -> list[Block]:
    return [Block(a, b.strip(), c) for a, b, c in FENCED.findall(page.read_text(encoding="utf-8"))]


def run(page: Path, long: bool) -> dict[str, Any]:
    names: dict[str, Any] = {}
    for language, mark, text in blocks(page):
        if language == "sh" and long:
            for command in text.splitlines():
                word, *arguments = shlex.split(command, comments=True)
                assert word == "bcppl"
                done = CliRunner().invoke(app, arguments, catch_exceptions=False)
                assert done.exit_code == 0, f"{command}\n{done.output}"
        if language == "python" and (mark == "" or (mark == "no-test" and long)):
            if named := re.match(r"# (\w+\.py)\n", text):
                Path(named[1]).write_text(text, encoding="utf-8")
            exec(compile(text, f"{page.name}: {text.splitlines()[0]}", "exec"), names)
    return names


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An empty folder, and a registry of sensors of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(protocol, "_registered", dict(protocol._registered))
    monkeypatch.setattr(protocol, "_by_type", dict(protocol._by_type))
    yield
    sys.modules.pop("bcppl.sensors.laser", None)


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_programs_of_a_page_run(page: Path) -> None:
    run(page, long=False)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_quotations_are_those_of_the_file(page: Path) -> None:
    for language, mark, text in blocks(page):
        if mark.startswith("from "):
            assert language == "python"
            assert text in (ROOT / mark.removeprefix("from ")).read_text(encoding="utf-8")
        else:
            assert mark in ("", "no-test"), f"{page.name} has a block marked {mark!r}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    text = FENCED.sub("", page.read_text(encoding="utf-8"))
    for target in re.findall(r"\]\(([^)]+)\)", text):
        if target.startswith("https://"):
            continue
        place, _, anchor = target.partition("#")
        linked = page if not place else page.parent / place
        assert linked.is_file(), f"{page.name} links to {target}"
        if anchor:
            titles = re.findall(r"^#+ (.+)$", linked.read_text(encoding="utf-8"), flags=re.MULTILINE)
            slugs = [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles]
            assert anchor in slugs, f"{page.name} links to {target}"


def test_readme_is_short_and_links_every_page() -> None:
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MOST_LINES
    assert [page.name for page in PAGES[1:] if f"(docs/{page.name})" not in text] == []


def test_settings_of_the_default_model_are_listed_with_their_defaults() -> None:
    text = (ROOT / "docs/settings.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"^\| `(\w+)` \| ([^|]*) \|", text, flags=re.MULTILINE))
    own = {f.name: getattr(each, f.name) for each in (CAMERAS, TouchSettings()) for f in fields(each)}
    assert listed.keys() == own.keys()
    for name, default in own.items():
        stated = listed[name]
        if isinstance(default, bool) or default is None:
            assert stated == ("none" if default is None else str(default).lower())
        elif isinstance(default, ContactDetector):
            assert stated == ", ".join(f"{each:g}" for each in vars(default).values())
        else:
            shown: Any = f'"{default}"' if isinstance(default, str) else pytest.approx(default, rel=1e-3)
            assert (stated if isinstance(default, str) else float(stated)) == shown


def test_modules_of_inference_are_named_as_they_are_imported() -> None:
    text = (ROOT / "docs/inference.md").read_text(encoding="utf-8")
    _, _, table = text.partition("## Modules of `bcppl.inference`")
    cells = re.findall(r"^\| (`[^|]*) \|", table, flags=re.MULTILINE)
    names = re.findall(r"`([^`]+)`", " ".join(cells))
    assert len(names) > 20
    for name in names:
        import_module(f"bcppl.inference.{name}")


def test_a_controllers_log_becomes_the_recording_that_it_is_of() -> None:
    names = run(ROOT / "docs/own_recording.md", long=False)
    recording, windows = bcppl.recordings.load("own.h5"), names["windows"]
    assert bcppl.recordings.problems(recording) == []
    touched = [m for m in recording.measurements if m.kind == "window"]
    assert [(m.action.first, m.action.last) for m in touched] == [
        (m.action.first, m.action.last) for m in windows
    ]
    for mine, theirs in zip(touched, windows, strict=True):
        np.testing.assert_allclose(mine.observation.times, theirs.observation.times, atol=1e-9)
        np.testing.assert_allclose(mine.observation.wrench, theirs.observation.wrench, atol=1e-4)
        there = torch.from_numpy(theirs.observation.world_from_peg)
        apart = poses.local(torch.from_numpy(mine.observation.world_from_peg), there)
        assert float(apart.abs().max()) < 5e-6  # a log of micrometres and microradians
    assert recording.part.extent == pytest.approx(names["simulated"].part.extent, abs=1e-8)
    for view in recording.measurements[:2]:
        at_truth = RayCaster(recording.part).images(
            view.action.camera, torch.from_numpy(names["simulated"].truth)[None]
        )[0]
        off = np.abs(at_truth - view.observation.depth)[np.isfinite(at_truth)]
        assert np.nanmedian(off) < 0.003  # the hand-eye calibration is off by millimetres


def test_a_benchs_log_becomes_the_recording_that_it_is_of() -> None:
    names = run(ROOT / "docs/import_bench.md", long=False)
    touched = [m.observation for m in names["imported"].recording.measurements]
    times, wrench, peg = (
        np.concatenate([getattr(o, name) for o in touched]) for name in ("times", "wrench", "world_from_peg")
    )
    # The wrench is the mean of straight lines over the 10 ms about each stamp.
    mean = names["wrench"].copy()
    mean[1:-1] = 0.75 * mean[1:-1] + 0.125 * (mean[:-2] + mean[2:])
    for mine, theirs in ((wrench, mean), (peg[:, :3], names["peg"][:, :3])):
        there = np.stack([np.interp(times, names["times"], column) for column in theirs.T], axis=1)
        np.testing.assert_allclose(mine[1:-1], there[1:-1], atol=2e-3 * np.abs(there).max())


@pytest.mark.long
def test_an_own_recording_localises_the_part() -> None:
    names = run(ROOT / "docs/own_recording.md", long=True)
    belief = load_belief("runs/own/belief_014.h5")
    assert 1000.0 * belief.weighted_add(names["part"].surface_points(), names["simulated"].truth) < 1.0


@pytest.mark.long
def test_readme_ends_at_a_tenth_of_a_millimetre(capsys: pytest.CaptureFixture[str]) -> None:
    run(README, long=True)
    printed = re.findall(r"^(\S+(?: \d+)?) +ADD +([\d.]+) mm$", capsys.readouterr().out, flags=re.MULTILINE)
    (stated,) = (text for language, _, text in blocks(README) if language == "text")
    shown = re.findall(r"^(\S+(?: \d+)?) +ADD +([\d.]+) mm$", stated, flags=re.MULTILINE)
    assert [label for label, _ in printed] == [label for label, _ in shown]
    adds = [float(add) for _, add in printed]
    assert adds == pytest.approx([float(add) for _, add in shown], abs=0.5)
    assert adds[-1] < 0.2 < adds[2]


@pytest.mark.long
def test_getting_started_localises_the_part(capsys: pytest.CaptureFixture[str]) -> None:
    run(ROOT / "docs/getting_started.md", long=True)
    adds = [float(add) for add in re.findall(r"particles, ADD +([\d.]+) mm", capsys.readouterr().out)]
    assert len(adds) == 11
    assert adds[-1] < 2.0 < adds[0]
    assert Path("belief.png").stat().st_size > 10_000


@pytest.mark.long
def test_own_model_localises_the_part() -> None:
    names = run(ROOT / "docs/own_model.md", long=True)
    belief, recording = names["last"].belief, names["recording"]
    assert 1000.0 * belief.weighted_add(recording.part.surface_points(), recording.truth) < 3.0


@pytest.mark.long
def test_commands_leave_figures() -> None:
    run(ROOT / "docs/command_line.md", long=True)
    for figure in ("add_over_time.png", "belief_in_3d.png"):
        assert Path(f"runs/more/{figure}").stat().st_size > 10_000


@pytest.mark.long
@pytest.mark.parametrize("page", ["inference", "insertion", "next_probe"])
def test_long_programs_of_a_page_run(page: str) -> None:
    run(ROOT / f"docs/{page}.md", long=True)

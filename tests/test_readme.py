"""The README's programs and commands run as they stand, one after the other, and find the part."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from bcppl.cli import app

README = Path(__file__).resolve().parents[1] / "README.md"


def test_programs_and_commands_of_the_readme(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```(python|sh)\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)
    names: dict[str, Any] = {}
    for language, block in blocks:
        if language == "sh":
            for command in block.splitlines():
                word, *arguments = shlex.split(command, comments=True)
                assert word == "bcppl"
                done = CliRunner().invoke(app, arguments, catch_exceptions=False)
                assert done.exit_code == 0, f"{command}\n{done.output}"
            continue
        if named := re.match(r"# (\w+\.py)\n", block):
            Path(named[1]).write_text(block, encoding="utf-8")
        exec(compile(block, str(README), "exec"), names)
    adds = [float(add) for add in re.findall(r"particles, ADD +([\d.]+) mm", capsys.readouterr().out)]
    assert len(adds) == 11
    assert adds[-1] < 2.0 < adds[0]
    assert (tmp_path / "belief.png").stat().st_size > 10_000
    assert (tmp_path / "runs/point_probe_10_pushes/add_over_time.png").stat().st_size > 10_000
    found, recording = names["last"].belief, names["recording"]
    assert 1000.0 * found.weighted_add(names["points"], recording.truth) < 3.0

"""The README's programs run as they stand, one after the other, and find the part."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

README = Path(__file__).resolve().parents[1] / "README.md"


def test_programs_of_the_readme(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    programs = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)
    names: dict[str, Any] = {}
    for program in programs:
        exec(compile(program, str(README), "exec"), names)
    adds = [float(add) for add in re.findall(r"ADD +([\d.]+) mm", capsys.readouterr().out)]
    assert len(adds) == 11
    assert adds[-1] < 2.0 < adds[0]
    assert (tmp_path / "belief.png").stat().st_size > 10_000
    found, recording = names["last"].belief, names["recording"]
    assert 1000.0 * found.weighted_add(names["points"], recording.truth) < 3.0

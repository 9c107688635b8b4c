"""Fixtures that several test files use."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from bcppl.cli import main
from bcppl.sensors import protocol
from tests.command_line import Ran


@pytest.fixture
def own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kinds of sensor that a test registers are forgotten after it."""
    monkeypatch.setattr(protocol, "_registered", dict(protocol._registered))
    monkeypatch.setattr(protocol, "_by_type", dict(protocol._by_type))
    monkeypatch.setattr(protocol, "_searched", False)


@pytest.fixture
def bcppl(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., Ran]:
    """Runs a command in an empty folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.delenv("BCPPL_TRACEBACK", raising=False)

    def run(*words: object) -> Ran:
        monkeypatch.setattr(sys, "argv", ["bcppl", *map(str, words)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as caught:
            main()
        captured = capsys.readouterr()
        code = caught.value.code
        return Ran(code if isinstance(code, int) else 0 if code is None else 1, captured.out, captured.err)

    return run

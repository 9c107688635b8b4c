"""The help of a public module opens with an example that runs, and fits a screen."""

from __future__ import annotations

import ast
import inspect
import os
import re
import subprocess
import sys
import textwrap
from importlib import import_module
from importlib.resources import files
from itertools import takewhile
from pathlib import Path

import pytest

SCREEN = 60  # lines


def modules(package: str) -> list[str]:
    """A package, and the modules that it exports."""
    stub = ast.parse((files(package) / "__init__.pyi").read_text(encoding="utf-8"))
    names = [package]
    for node in stub.body:
        for alias in node.names if isinstance(node, ast.ImportFrom) else ():
            path = files(package).joinpath(*str(node.module).split(".")[2:], alias.name)
            if (node.module and Path(str(path)).is_dir()) or Path(f"{path}.py").is_file():
                names.append(f"{node.module}.{alias.name}")
    return names


PUBLIC = [
    "bcppl.traces",
    "bcppl.distributions",
    "bcppl.inference.importance",
    "bcppl.inference.repetitions",
    *modules("bcppl.inference"),
]


def example(text: str) -> str:
    """The indented paragraphs after the first."""
    _, *later = re.split(r"\n\s*?\n", text)
    block = list(takewhile(lambda paragraph: paragraph.startswith("    "), later))
    return textwrap.dedent("\n\n".join(block))


@pytest.mark.long
@pytest.mark.parametrize("name", PUBLIC)
def test_help_opens_with_an_example_that_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = inspect.getdoc(import_module(name)) or ""
    assert len(text.splitlines()) <= SCREEN
    code = example(text)
    assert "import" in code, f"{name} has no example behind its first sentence"
    monkeypatch.chdir(tmp_path)
    exec(compile(code, name, "exec"), {"__name__": "example"})


def test_the_example_is_the_first_block() -> None:
    assert example("One.\n\n    a = 1\n\n    b = 2\n\nMore.\n\n    c = 3") == "a = 1\n\nb = 2"
    assert example("One.\n\nTwo, without.\n\n    a = 1") == ""
    assert "bcppl.inference.saved" in PUBLIC and "bcppl.inference.tempered_smc" not in PUBLIC
    assert "bcppl.inference.filters.tempered_smc" in PUBLIC and len(PUBLIC) > 14


def test_help_of_kernels_lists_none_of_the_language_behind_them() -> None:
    # `scattered` is for who writes a kernel: notebooks/own_kernel.ipynb.
    assert not {"takes", "refuse_no_kernel"}.intersection(import_module("bcppl.inference.kernels").__all__)


def test_the_shell_completes_commands() -> None:
    words = {"_BCPPL_COMPLETE": "complete_bash", "COMP_WORDS": "bcppl in", "COMP_CWORD": "1"}
    command = Path(sys.executable).with_name("bcppl")
    ran = subprocess.run([command], env={**os.environ, **words}, capture_output=True, text=True)
    assert ran.stdout.split() == ["insert"], ran.stderr

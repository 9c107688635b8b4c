"""The documentation as a site: pages have a place in it, what is public is in its API, nothing is fetched.

The site itself is built by `make docs`, which takes minutes and ends with the check that is tested here.
"""

from __future__ import annotations

import re
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "build/docs"


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Imports one of the modules beside the pages."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    before = set(sys.modules)
    yield import_module
    for name in set(sys.modules) - before:
        if name in ("api", "all_messages", "check_site", "kernel_tables"):
            del sys.modules[name]


def test_built_site_is_whole_and_stands_alone(module: Any) -> None:
    if find_spec("sphinx") is None:
        pytest.skip("sphinx is not installed: make docs installs it")
    if not (SITE / "index.html").is_file():
        pytest.skip("the site is not built: make docs builds it")
    assert list(module("check_site").problems(SITE)) == []


def test_every_page_and_notebook_is_listed_once() -> None:
    index = (ROOT / "docs/index.md").read_text(encoding="utf-8")
    lists = re.findall(r"^:::\{toctree\}\n(.*?)^:::$", index, flags=re.DOTALL | re.MULTILINE)
    listed = [line for text in lists for line in text.splitlines() if line and not line.startswith(":")]
    pages = [page.stem for page in (ROOT / "docs").glob("*.md") if page.stem != "index"]
    notebooks = [f"generated/notebooks/{each.stem}" for each in (ROOT / "notebooks").glob("*.ipynb")]
    made = ["messages", "kernels", "benchmarks", "changelog", "api/index"]
    assert sorted(listed) == sorted([*pages, *notebooks, *(f"generated/{name}" for name in made)])


def test_api_has_what_the_door_exports_once_and_nothing_private(module: Any) -> None:
    api = module("api")
    text = "\n".join(api.pages().values())
    documented = re.findall(r"^\.\. auto(?:class|function):: (\S+)$", text, flags=re.MULTILINE)
    assert len(documented) == len(set(documented)) > 300
    assert [name for name in documented if any(part.startswith("_") for part in name.split("."))] == []
    for name in api.exported("bcppl"):
        assert re.search(rf"\bbcppl\.{name}\b", text), name
    for name in ("bcppl.inference.smc", "bcppl.inference.kernels.hmc", "bcppl.contact.sensing.OnsetDetector"):
        assert name in documented


def test_docstrings_are_reread_as_restructuredtext(module: Any) -> None:
    api = module("api")
    lines = ["One.", "", "    x = a * b", "", "Of `f`s, |x| and *x, as `a`(N).", "", "Args:", "    x_: a."]
    assert api.reread(lines) == [
        "One.",
        "",
        "::",
        "",
        "    x = a * b",
        "",
        r"Of `f`\ s, \|x\| and \*x, as `a`\ (N).",
        "",
        "Args:",
        r"    x\_: a.",
    ]


def test_messages_are_listed_with_what_they_fill_in_left_out(module: Any) -> None:
    text = module("all_messages").page()
    assert "- a program's arguments are of type …; give a tuple of them, `(x,)` for one." in text
    assert text.count("\n- ") > 500


def test_kernels_have_a_table_for_each_number_of_particles(module: Any) -> None:
    text = module("kernel_tables").page()
    assert re.findall(r"^## (\d+) particles$", text, flags=re.MULTILINE) == ["75", "1000", "10000"]
    assert "| hmc |" in text


GOOD = '<a href="two.html#here">x</a><a href="https://example.org">y</a><script src="s.js"></script>'


@pytest.mark.parametrize(
    ("more", "wrong"),
    [
        ("", None),
        ('<script src="https://cdn.example.org/x.js"></script>', "another host"),
        ('<link rel="stylesheet" href="//fonts.example.org/css">', "another host"),
        ('<img src="http://example.org/x.png">', "another host"),
        ('<img srcset="s.js, https://example.org/x.png 2x">', "another host"),
        ('<p style="background: url(https://example.org/x.png)">', "another host"),
        ('<a href="three.html">', "not there"),
        ('<a href="two.html#there">', "no such place"),
        ('<img src="missing.png">', "not there"),
    ],
)
def test_check_sees_what_is_foreign_or_missing(
    more: str, wrong: str | None, tmp_path: Path, module: Any
) -> None:
    (tmp_path / "index.html").write_text(GOOD + more)
    (tmp_path / "two.html").write_text('<p id="here">')
    (tmp_path / "s.js").write_text("const x = 1;")
    (tmp_path / "searchindex.js").write_text("Search.setIndex({})")
    problems = list(module("check_site").problems(tmp_path))
    assert problems == [] if wrong is None else (len(problems) == 1 and wrong in problems[0])


@pytest.mark.parametrize(
    ("name", "text", "wrong"),
    [
        ("x.css", "@import 'https://example.org/x.css';", "another host"),
        ("x.css", "p {src: url(//example.org/x.woff)}", "another host"),
        ("x.js", "import('https://example.org/x.js')", "another host"),
        ("searchindex.js", "{}", "search"),
        ("searchindex.js", None, "search"),
    ],
)
def test_check_reads_styles_scripts_and_the_index(
    name: str, text: str | None, wrong: str, tmp_path: Path, module: Any
) -> None:
    (tmp_path / "index.html").write_text("<p>")
    (tmp_path / "searchindex.js").write_text("Search.setIndex({})")
    if text is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(text)
    (problem,) = module("check_site").problems(tmp_path)
    assert wrong in problem

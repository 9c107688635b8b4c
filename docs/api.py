"""Writes the pages of the API: what is public, by room, each object once.

Public is what a door exports (an `__init__.pyi`, or an `__init__.py` with imports of its own), from `bcppl`
inwards; of a module that a door exports, what has no underscore; and of rooms without a door, what the pages,
the notebooks or the models that ship import from them. Nothing is imported here: the sources are read.

    python docs/api.py FOLDER
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FENCED = re.compile(r"^```(\w+)[^\n]*\n(.*?)^```$", flags=re.DOTALL | re.MULTILINE)
DOOR = "bcppl"
# Commands and what runs them are described in `command_line.md`.
CLOSED = ("bcppl.cli", "bcppl.arguments", "bcppl.arrays", "bcppl.exports", "bcppl.effort")

Name = tuple[str, str]  # module and name in it


@cache
def path_of(module: str) -> Path | None:
    """The file of a module: of a package its door, which is its stub where it has one."""
    place = ROOT.joinpath(*module.split("."))
    for file in (place / "__init__.pyi", place / "__init__.py", place.with_suffix(".py")):
        if file.is_file():
            return file
    return None


@cache
def body(module: str) -> list[ast.stmt]:
    """The statements of a module's file."""
    file = path_of(module)
    return [] if file is None else ast.parse(file.read_text(encoding="utf-8")).body


@cache
def imported(module: str) -> dict[str, Name]:
    """What a module imports from bcppl, by the name that it has there."""
    return {
        alias.asname or alias.name: (node.module, alias.name)
        for node in body(module)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(DOOR)
        for alias in node.names
        if node.module
    }


@cache
def defined(module: str) -> dict[str, str]:
    """The kinds ("class", "function" or "data") of what a module defines, by name, in order."""
    kinds: dict[str, str] = {}
    for node in body(module):
        if isinstance(node, ast.ClassDef):
            kinds[node.name] = "class"
        elif isinstance(node, ast.FunctionDef):
            kinds[node.name] = "function"
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            kinds |= {target.id: "data" for target in targets if isinstance(target, ast.Name)}
    return kinds


def home(module: str, name: str) -> Name | str | None:
    """Where a name that a module has is defined; a module's own name where it is one; None where unknown."""
    while name not in defined(module):
        further = imported(module).get(name, (module, name))
        if further == (module, name):
            return f"{module}.{name}" if path_of(f"{module}.{name}") else None
        module, name = further
    return module, name


@cache
def exported(module: str) -> list[str]:
    """The names that a module exports."""
    file = path_of(module)
    assert file is not None, module
    listed = [
        [str(word.value) for word in node.value.elts if isinstance(word, ast.Constant)]
        for node in body(module)
        if isinstance(node, ast.Assign)
        and isinstance(node.value, ast.List)
        and any(isinstance(target, ast.Name) and target.id == "__all__" for target in node.targets)
    ]
    if listed:
        return listed[0]
    if file.suffix == ".pyi" or (file.stem == "__init__" and not defined(module)):
        return sorted(imported(module), key=str.lower)
    shown = [name for name, kind in defined(module).items() if not name.startswith("_") and kind != "data"]
    return [*shown, "model"] if defined(module).get("model") == "data" else shown


def programs() -> Iterator[str]:
    """Python that readers see: of pages and notebooks, and the models that ship."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for language, text in FENCED.findall(page.read_text(encoding="utf-8")):
            if language == "python":
                yield text
            elif language == "pycon":
                yield "\n".join(line[4:] for line in text.splitlines() if line[:4] in (">>> ", "... "))
    for notebook in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                yield "".join(cell["source"])
    for model in sorted((ROOT / "models").glob("*.py")):
        yield model.read_text(encoding="utf-8")


def taught() -> set[Name]:
    """Definitions that readers see imported."""
    names = set[Name]()
    for text in programs():
        try:
            nodes = list(ast.walk(ast.parse(text)))
        except SyntaxError:  # a quotation of a part of a file
            continue
        for node in nodes:
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(f"{DOOR}."):
                homes = [home(node.module, alias.name) for alias in node.names]
                names |= {each for each in homes if isinstance(each, tuple)}
    return {
        (module, name)
        for module, name in names
        if not any(module == closed or module.startswith(f"{closed}.") for closed in CLOSED)
        and not name.startswith("_")
    }


@dataclass
class Room:
    """A module that is public: definitions and modules that it shows, with the names that they have in it."""

    module: str
    entries: dict[Name, str] = field(default_factory=dict)
    modules: dict[str, str] = field(default_factory=dict)


def rooms() -> dict[str, Room]:
    """All rooms, by module; every definition is in one of them."""
    known: dict[str, Room] = {}
    stubs = {file.parent.relative_to(ROOT) for file in (ROOT / DOOR).rglob("__init__.pyi")}
    for link in ("models", "inference"):
        stubs |= {DOOR / file.parent.relative_to(ROOT) for file in (ROOT / link).rglob("__init__.pyi")}
    ahead = [DOOR, *sorted(".".join(stub.parts) for stub in stubs)]
    while ahead:
        module = ahead.pop(0)
        if module in known:
            continue
        room = known[module] = Room(module)
        for name in exported(module):
            where = home(module, name)
            assert where is not None, f"{module} exports {name}, and nothing defines it"
            if isinstance(where, str):
                room.modules[where] = f"{module}.{name}"
                ahead.append(where)
            else:
                room.entries[where] = f"{module}.{name}"
    shown = {where for room in known.values() for where in room.entries}
    for module, name in sorted(taught() - shown):
        owner = max((each for each in known if f"{module}.".startswith(f"{each}.")), key=len)
        known[owner].entries[module, name] = f"{module}.{name}"
    return known


def owners(known: dict[str, Room]) -> dict[Name, tuple[str, str]]:
    """Room and full name of each definition.

    The room is the innermost one that exports it and that it lies in, else another one that exports it, and
    last, for what the outermost door alone exports, the innermost one that it lies in.
    """
    chosen: dict[Name, tuple[str, str]] = {}
    for where in {where for room in known.values() for where in room.entries}:
        inside = f"{where[0]}."
        exporting = [each for each, room in known.items() if where in room.entries and each != DOOR]
        within = [each for each in exporting if inside.startswith(f"{each}.")]
        if exporting:
            inner = max(within or exporting, key=lambda each: (len(each), each))
            chosen[where] = (inner, known[inner].entries[where])
        else:
            inner = max((each for each in known if inside.startswith(f"{each}.")), key=len)
            chosen[where] = (inner, known[DOOR].entries[where] if inner == DOOR else ".".join(where))
    return chosen


def aliases() -> dict[str, str]:
    """The full names of public types that have a name of their own, such as `Kernel`, by that name."""
    named = [
        (where, full) for where, (_, full) in owners(rooms()).items() if defined(where[0])[where[1]] == "data"
    ]
    return {name: full for (_, name), full in named if name[0].isupper() and not name.isupper()}


def summary(module: str, name: str = "") -> str:
    """The first line of a docstring."""
    nodes: list[ast.stmt] | ast.stmt = (
        body(module) if not name else [node for node in body(module) if getattr(node, "name", None) == name]
    )
    if name and not nodes:
        return ""
    if not name:
        file = path_of(module)
        assert file is not None
        text = ast.get_docstring(ast.parse(file.with_suffix(".py").read_text(encoding="utf-8")))
    else:
        text = ast.get_docstring(nodes[0])  # type: ignore[arg-type]
    return plain((text or "").split("\n\n")[0].replace("\n", " "))


def comment(module: str, name: str) -> str:
    """What the comment says that stands above a definition, or else the definition's own source."""
    file = path_of(module)
    assert file is not None
    lines = file.read_text(encoding="utf-8").splitlines()
    (node,) = (
        each
        for each in body(module)
        if isinstance(each, ast.Assign | ast.AnnAssign)
        and name in [getattr(t, "id", "") for t in getattr(each, "targets", [getattr(each, "target", None)])]
    )
    first = node.lineno - 1
    while lines[first - 1].startswith("#"):
        first -= 1
    above = " ".join(line.removeprefix("#").strip() for line in lines[first : node.lineno - 1])
    source = " ".join(line.strip() for line in lines[node.lineno - 1 : node.end_lineno])
    return plain(above) if above else f"``{source}``"


def plain(text: str) -> str:
    """Text in which code stands between backticks, as reStructuredText: nothing else is markup."""

    def outside(words: str) -> str:
        words = re.sub(r"([\\*|])", r"\\\1", words)
        return re.sub(r"(?<=\w)_(?!\w)", r"\\_", words)

    pieces = re.split(r"(``[^`]+``|`[^`]+`)", text)
    for k in range(1, len(pieces), 2):
        if pieces[k - 1] and not re.search(r"[\s\-:/'\"<(\[{]$", pieces[k - 1]):
            pieces[k] = "\\ " + pieces[k]
        if pieces[k + 1] and not re.match(r"[\s\-.,:;!?/'\")\]}>]", pieces[k + 1]):
            pieces[k] += "\\ "
    pieces[::2] = map(outside, pieces[::2])
    return "".join(pieces)


def reread(lines: list[str]) -> list[str]:
    """A docstring as it is written in bcppl, in reStructuredText.

    Code stands between single backticks, or, after an empty line, in a block that is indented further.
    """
    made: list[str] = []
    text: list[str] = []
    base, code, empty = 0, False, True

    def flush() -> None:
        made.extend(plain("\n".join(text)).split("\n") if text else [])
        text.clear()

    for line in lines:
        indent = len(line) - len(line.lstrip())
        if not line.strip():
            (made if code else text).append(line)
            empty = True
            continue
        if code and indent <= base:
            code = False
        if not code and empty and indent > base and (text or made):
            flush()
            made.extend([" " * base + "::", ""])
            code = True
        if code:
            made.append(line)
        else:
            base = indent
            text.append(line)
        empty = False
    flush()
    return made


def underlined(title: str, line: str) -> str:
    """A title."""
    return f"{title}\n{line * len(title)}\n\n"


def entry(module: str, name: str, full: str) -> str:
    """The directive that documents a definition."""
    kind = defined(module)[name]
    if kind == "class":
        return f".. autoclass:: {full}\n   :members:\n\n"
    if kind == "function":
        return f".. autofunction:: {full}\n\n"
    shown, _, own = full.rpartition(".")
    return f".. py:data:: {own}\n   :module: {shown}\n\n   {comment(module, name)}\n\n"


def page_of(module: str) -> str:
    """The page on which a room is: its own, or, for a single file inside a package, the package's."""
    parent = module.rpartition(".")[0]
    single = not (ROOT.joinpath(*module.split("."))).is_dir()
    return page_of(parent) if single and parent.count(".") >= 1 else module


def pages() -> dict[str, str]:
    """The pages in reStructuredText, by file name; `index.rst` lists the others."""
    known = rooms()
    chosen = owners(known)
    by_page: dict[str, list[Room]] = {}
    for room in known.values():
        by_page.setdefault(page_of(room.module), []).append(room)
    made: dict[str, str] = {}
    for page, its in by_page.items():
        text = ".. highlight:: default\n\n"  # Python where it is
        for room in sorted(its, key=lambda each: (each.module != page, each.module)):
            text += underlined(room.module, "=" if room.module == page else "-")
            text += f".. automodule:: {room.module}\n\n"
            elsewhere = [
                f"- :py:obj:`{full} <{chosen[where][1]}>`: {summary(*where)}\n"
                for where, full in room.entries.items()
                if chosen[where][1] != full
            ]
            elsewhere += [
                f"- :doc:`{full} <{page_of(each)}>`: {summary(each)}\n"
                for each, full in sorted(room.modules.items(), key=lambda item: item[1])
                if page_of(each) != page
            ]
            text += "".join(elsewhere) + "\n" if elsewhere else ""
            own = [(where, full) for where, (inner, full) in chosen.items() if inner == room.module]
            for (module, name), full in sorted(own, key=lambda each: each[1].lower()):
                text += entry(module, name, full)
        made[f"{page}.rst"] = text
    listed = "".join(f"   {page}\n" for page in sorted(by_page, key=lambda each: (each != DOOR, each)))
    made["index.rst"] = (
        underlined("The programming interface", "=")
        + "What is public, by room. A name that two rooms export is described once, in the inner one.\n\n"
        + f".. toctree::\n   :maxdepth: 1\n\n{listed}"
    )
    return made


def write(folder: Path) -> None:
    """Write the pages into a folder; those that are as they should be are left, and others removed."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = pages()
    for file in folder.glob("*.rst"):
        if file.name not in wanted:
            file.unlink()
    for name, text in wanted.items():
        file = folder / name
        if not file.is_file() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))

"""The house holds together: links, import arrows, and a wheel that runs far from the checkout."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import networkx as nx
import pytest

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ("point_probe_10_pushes", "peg_probe", "arm_view")

CHECKOUT = (ROOT / "models").is_dir() and (ROOT / "inference").is_dir()
pytestmark = pytest.mark.skipif(
    not CHECKOUT, reason="models/ and inference/ stand at the top of a checkout only"
)


def quiet(command: list[str], cwd: Path, **variables: str) -> str:
    """Run a command outside this process and give what it printed; its own words where it fails."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONSAFEPATH")}
    done = subprocess.run(command, cwd=cwd, env={**environment, **variables}, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The sdist, and the wheel that is built from it (so what the sdist lacks, the wheel lacks)."""
    folder = tmp_path_factory.mktemp("dist")
    quiet([sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(ROOT)], cwd=folder)
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel


def wanted() -> Iterator[str]:
    """Every file of the package, code and data, the ones under the links included, as a path from the top."""
    for folder, _, names in os.walk(ROOT / "bcppl", followlinks=True):
        if "__pycache__" not in folder:
            yield from (str((Path(folder) / n).relative_to(ROOT)) for n in names if not n.endswith(".pyc"))


def test_links_are_links() -> None:
    for name in ("models", "inference"):
        link = ROOT / "bcppl" / name
        assert link.is_symlink(), f"bcppl/{name} is not a symbolic link: run `make check-links`"
        assert os.readlink(link) == f"../{name}"


@pytest.mark.long
def test_sdist_and_wheel_hold_every_file_of_the_package_as_a_real_file(built: tuple[Path, Path]) -> None:
    sdist, wheel = built
    with tarfile.open(sdist) as archive:
        in_sdist = {m.name.split("/", 1)[1]: m for m in archive.getmembers() if "/" in m.name}
    with zipfile.ZipFile(wheel) as archive:
        in_wheel = set(archive.namelist())
    names = sorted(wanted())
    assert [n for n in names if n not in in_sdist] == []
    assert [n for n in names if not in_sdist[n].isfile()] == []
    assert [n for n in names if n not in in_wheel] == []
    # Nothing is there twice, and nothing that belongs to the checkout only.
    assert {n.split("/")[0] for n in in_wheel} == {"bcppl", "bcppl-0.2.0.dist-info"}
    assert not any(n.startswith(("models/", "inference/", "tests/")) for n in in_sdist)
    for recording in SHIPPED:
        assert f"bcppl/models/recordings/{recording}.h5" in in_wheel


@pytest.fixture(scope="module")
def installed(built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which the wheel alone was installed."""
    target = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    quiet([*pip, "--target", str(target), str(built[1])], cwd=target)
    return target


@pytest.mark.long
def test_installed_wheel_finds_a_part_from_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    where = quiet(
        [sys.executable, "-c", "import bcppl; print(bcppl.__file__)"], tmp_path, PYTHONPATH=str(installed)
    )
    assert Path(where.strip()).is_relative_to(installed)
    printed = quiet(
        [sys.executable, "-m", "bcppl", "run", SHIPPED[0], "--particles", "4"],
        tmp_path,
        PYTHONPATH=str(installed),
        OMP_NUM_THREADS="1",
        COLUMNS="120",
    )
    assert "mm" in printed
    assert list(tmp_path.rglob("*.png")), "a run leaves pictures in the folder where it was started"


@pytest.mark.long
def test_no_module_is_imported_twice(tmp_path: Path) -> None:
    code = """
import importlib, pkgutil, sys
import bcppl
for found in pkgutil.walk_packages(bcppl.__path__, "bcppl."):
    if not found.name.endswith("__main__"):
        try:
            importlib.import_module(found.name)
        except ModuleNotFoundError as error:
            assert error.name == "warp", error  # of an optional group
twice = [n for n in sys.modules if n.split(".")[0] in ("models", "inference")]
assert not twice, twice
files = {}
for name, module in list(sys.modules.items()):
    if name.split(".")[0] == "bcppl" and getattr(module, "__file__", None):
        import os
        files.setdefault(os.path.realpath(module.__file__), []).append(name)
twice = [names for names in files.values() if len(names) > 1]
assert not twice, twice
assert "bcppl.models" in sys.modules and "bcppl.inference" in sys.modules
"""
    # From the top of the checkout, where `import models` would work and must not be used.
    quiet([sys.executable, "-c", code], cwd=ROOT)


def within(name: str, packages: tuple[str, ...]) -> bool:
    """Whether a module is one of some packages or lies in one."""
    return any(name == package or name.startswith(package + ".") for package in packages)


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Line and absolute name of everything that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: import absolutely, from `bcppl.`"
            yield node.lineno, node.module or ""
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


def room(path: Path) -> str:
    """models, inference, cli, distributions or language."""
    parts = path.relative_to(ROOT).parts
    if parts[0] in ("models", "inference"):
        return parts[0]
    return {"distributions": "distributions", "cli": "cli", "cli.py": "cli", "__main__.py": "cli"}.get(
        parts[1], "language"
    )


FORBIDDEN = {
    "models": ("bcppl.inference", "bcppl.cli"),
    "inference": ("bcppl.models", "bcppl.cli"),
    "language": ("bcppl.models", "bcppl.inference", "bcppl.cli"),
    "distributions": ("bcppl.models", "bcppl.inference", "bcppl.cli", "bcppl.rendering", "bcppl.contact"),
    "cli": (),
}


# A camera is data, which measurements hold too; nothing is simulated there.
DATA = "bcppl.geometry.camera"


def wrong_way(path: Path) -> list[str]:
    """Every import of a file that runs against the arrows."""
    forbidden = (*FORBIDDEN[room(path)], "models", "inference")
    return [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for line, name in imports(path)
        if within(name, forbidden) and not within(name, (DATA,))
    ]


def sources() -> list[Path]:
    """Every file of the package, once."""
    found = [*(ROOT / "models").rglob("*.py"), *(ROOT / "inference").rglob("*.py")]
    return found + [
        p for p in (ROOT / "bcppl").rglob("*.py") if p.resolve().is_relative_to((ROOT / "bcppl").resolve())
    ]


def test_imports_follow_the_arrows() -> None:
    assert len(sources()) > 20
    assert [wrong for path in sources() for wrong in wrong_way(path)] == []


def package_of(parts: tuple[str, ...]) -> str | None:
    """The folder that a module lies in: `geometry`, `models`, `inference.kernels`; None where in none."""
    if parts[0] == "inference":
        inner = len(parts) > 1 and (ROOT / "inference" / parts[1]).is_dir()
        return f"inference.{parts[1]}" if inner else None
    return parts[0] if (ROOT / "bcppl" / parts[0]).is_dir() else None


def packages() -> nx.DiGraph:
    """Folders of modules, with an arrow from each to those that it imports."""
    graph = nx.DiGraph()
    for path in sources():
        parts = path.relative_to(ROOT).with_suffix("").parts
        own = package_of(parts[1:] if parts[0] == "bcppl" else parts)
        for _, name in imports(path):
            other = package_of(tuple(name.split(".")[1:])) if name.startswith("bcppl.") else None
            if own is not None and other is not None and other != own:
                graph.add_edge(own, other)
    return graph


def test_no_packages_import_one_another_in_a_circle() -> None:
    graph = packages()
    assert {"geometry", "sensors", "models", "inference.filters"} <= set(graph)
    assert list(nx.simple_cycles(graph)) == []


def test_a_circle_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    for place, line in (("geometry", "import bcppl.robot.arm"), ("robot", "import bcppl.geometry.parts")):
        folder = tmp_path / "bcppl" / place
        folder.mkdir(parents=True)
        (folder / "a.py").write_text(line)
    assert list(nx.simple_cycles(packages())) != []


KIND = re.compile(r"isinstance\([^()]*\b(View|DepthImage|ProbeWindow|Touch|Push|Plan|Beam|Distance)\b")


def test_nobody_outside_sensors_asks_which_kind_a_measurement_is() -> None:
    asking = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in sources()
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if KIND.search(line) and "sensors" not in path.parts
    ]
    assert asking == []


@pytest.mark.parametrize(
    ("place", "line"),
    [
        ("bcppl/poses/se3.py", "from bcppl import models"),
        ("bcppl/distributions/depth.py", "    from bcppl.rendering.ray_casting import RayCaster"),
        ("models/peg.py", "import bcppl.inference.filters.smc"),
        ("inference/filters/smc.py", "from models import peg"),
    ],
)
def test_an_import_against_the_arrows_is_seen(
    place: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    path = tmp_path / place
    path.parent.mkdir(parents=True)
    path.write_text(f"if True:\n    {line.strip()}\n")
    assert len(wrong_way(path)) >= 1

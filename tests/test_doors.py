"""What a package exports, and what importing it costs."""

from __future__ import annotations

import pkgutil
import subprocess
import sys
from importlib import import_module
from types import ModuleType

import pytest

import bcppl
from bcppl.exports import exported

HEAVY = ("torch", "pyro", "scipy", "matplotlib", "mujoco", "numpy", "trimesh", "numba", "h5py")
DOORS = ("bcppl", "bcppl.inference", "bcppl.inference.design", "bcppl.inference.planning")
DOORS += ("bcppl.inference.annealing", "bcppl.inference.series")
DOORS += ("bcppl.models", "bcppl.models.worlds", "bcppl.contact.sensing")


def imported(code: str) -> set[str]:
    """The modules in a process of its own after some code."""
    code += "\nimport sys; print('modules:', *sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(ran.stdout.rpartition("modules:")[2].split())


HELP = "import sys\nfrom bcppl.cli import app\nassert app(['--help'], standalone_mode=False) in (0, None)"


@pytest.mark.parametrize("code", ["import bcppl", "import bcppl.cli", HELP, "import bcppl.models.worlds"])
def test_asking_for_help_imports_nothing_that_computes(code: str) -> None:
    assert imported(code).isdisjoint(HEAVY)


def test_checking_a_recording_imports_no_simulator_and_no_tensor_library() -> None:
    modules = imported("from bcppl.cli import app\napp(['check', 'peg_probe'], standalone_mode=False)")
    assert "h5py" in modules
    assert modules.isdisjoint({"torch", "pyro", "scipy", "trimesh", "matplotlib", "mujoco", "numba"})


def test_no_export_imports_the_compiler_of_torch() -> None:
    code = "import bcppl\nfor name in bcppl.__all__: getattr(bcppl, name)\n"
    code += "for name in bcppl.inference.__all__: getattr(bcppl.inference, name)"
    modules = imported(code)
    assert "bcppl.inference.filters.smc" in modules
    assert modules.isdisjoint({"torch._dynamo", "roma", "sympy"})


@pytest.mark.parametrize("door", DOORS)
def test_every_export_is_there_whatever_was_imported_before(door: str) -> None:
    """A function of a module's own name would be hidden by the module, once that is imported."""
    package = import_module(door)
    modules = {info.name for info in pkgutil.iter_modules(package.__path__)}
    assert set(package.__all__) <= set(dir(package))
    for name in package.__all__:
        value = getattr(package, name)
        assert isinstance(value, ModuleType) == (name in modules or value.__class__ is ModuleType), name
        assert name not in modules or value.__name__ == f"{door}.{name}"
    with pytest.raises(AttributeError, match=f"module '{door}' has no attribute 'nothing'"):
        _ = package.nothing


def test_exports_are_what_their_homes_define() -> None:
    from bcppl.inference.filters import smc, tempered_smc
    from bcppl.models import look_and_touch, point_probe

    assert bcppl.smc is smc.smc and bcppl.inference.smc is smc.smc
    assert bcppl.inference.tempered_smc is tempered_smc
    assert bcppl.models.look_and_touch is look_and_touch and isinstance(look_and_touch, ModuleType)
    assert isinstance(point_probe.model, bcppl.Model)


def test_every_model_is_exported() -> None:
    names = {info.name for info in pkgutil.iter_modules(bcppl.models.__path__)} - {"shipped"}
    assert names <= set(bcppl.models.__all__)


def test_a_package_without_a_stub_exports_nothing() -> None:
    with pytest.raises(FileNotFoundError):
        exported("bcppl.geometry")

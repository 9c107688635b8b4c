"""What a package exports, and what importing it costs."""

from __future__ import annotations

import pkgutil
import random
import subprocess
import sys
from importlib import import_module
from types import ModuleType

import pytest

import bcppl
from bcppl.exports import exported

HEAVY = ("torch", "pyro", "scipy", "matplotlib", "mujoco", "numpy", "trimesh", "numba", "h5py")
DOORS = ("bcppl", "bcppl.inference", "bcppl.inference.design", "bcppl.inference.planning")
DOORS += ("bcppl.inference.annealing", "bcppl.inference.live", "bcppl.inference.series")
DOORS += ("bcppl.models", "bcppl.models.worlds", "bcppl.contact.sensing")


def imported(code: str) -> set[str]:
    """The modules in a process of its own after some code."""
    code += "\nimport sys; print('modules:', *sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ran.returncode == 0, f"{code}\n{ran.stderr}"
    return set(ran.stdout.rpartition("modules:")[2].split())


HELP = "import sys\nfrom bcppl.cli import app\nassert app(['--help'], standalone_mode=False) in (0, None)"


@pytest.mark.parametrize("code", ["import bcppl", "import bcppl.cli", HELP, "import bcppl.models.worlds"])
def test_asking_for_help_imports_nothing_that_computes(code: str) -> None:
    assert imported(code).isdisjoint(HEAVY)


def test_describing_a_recording_imports_no_simulator_and_no_tensor_library() -> None:
    code = "from bcppl.models.shipped import load_recording\n"
    code += "from bcppl.recordings import describe, notes, problems"
    code += "\nfor each in (describe, notes, problems): each(load_recording('peg_probe'))"
    modules = imported(code)
    assert "h5py" in modules
    assert modules.isdisjoint({"torch", "pyro", "scipy", "trimesh", "matplotlib", "mujoco", "numba"})


@pytest.mark.parametrize("name", ["contact.quasi_static", "poses.kernels", "geometry.gap.peg_gap"])
def test_no_module_is_executed_twice(name: str) -> None:
    """A package that is executed when first used imports what its importer is about to."""
    code = "from importlib.machinery import SourceFileLoader as Loader\n"
    code += "executed, plain = [], Loader.exec_module\n"
    code += "Loader.exec_module = lambda self, m: (executed.append(m.__name__), plain(self, m))[1]\n"
    code += f"import bcppl.{name}\nfrom bcppl import poses\nassert poses.se3.kernels is poses.kernels\n"
    code += "own = [each for each in executed if each.startswith('bcppl.')]\n"
    code += "assert len(own) == len(set(own)), own\n"
    code += "import bcppl.poses.kernels as kernels\n"
    code += "assert type(kernels.__spec__.loader) is Loader and kernels is poses.kernels"
    assert "bcppl.poses.kernels" in imported(code)


@pytest.mark.long
def test_checking_a_recording_imports_what_renders_and_measures_gaps_and_no_physics() -> None:
    modules = imported("from bcppl.cli import app\napp(['check', 'peg_probe'], standalone_mode=False)")
    assert modules.isdisjoint({"mujoco", "matplotlib", "bcppl.inference"})


@pytest.mark.long
def test_a_package_can_be_sent_to_another_process_before_it_was_used() -> None:
    """As a function of a script is, which names what the script imported."""
    code = "import cloudpickle, pickle\nfrom bcppl.inference.filters import guided_smc\n"
    code += "from bcppl.models import worlds\nassert type(worlds).__name__ == '_WhenUsed'\n"
    code += "for each in (guided_smc, worlds): assert pickle.loads(cloudpickle.dumps(each)) is each"
    assert "bcppl.models.worlds" in imported(code)


@pytest.mark.long
def test_no_export_imports_the_compiler_of_torch() -> None:
    code = "import bcppl\nfor name in bcppl.__all__: getattr(bcppl, name)\n"
    code += "for name in bcppl.inference.__all__: getattr(bcppl.inference, name)"
    modules = imported(code)
    assert "bcppl.inference.filters.smc" in modules
    assert modules.isdisjoint({"torch._dynamo", "roma", "sympy"})


def in_any_order(seed: int) -> str:
    """Imports of modules behind the doors, torch and Pyro in random order, then a use of each module."""
    chosen = random.Random(seed)
    behind = [
        (door, info.name)
        for door in ("bcppl", "bcppl.inference", "bcppl.models")
        for info in pkgutil.iter_modules(import_module(door).__path__)
        if info.name in import_module(door).__all__
    ]
    found = chosen.sample(behind, 6)
    lines = [f"from {door} import {name}" for door, name in found] + ["import torch", "import pyro"]
    chosen.shuffle(lines)
    return "\n".join([*lines, *(f"dir({name})" for _, name in found)])


@pytest.mark.long
@pytest.mark.parametrize(
    "code",
    [
        "from bcppl.inference import saved; import torch; saved.save",
        "import bcppl; from bcppl.inference import saved; bcppl.models.look_and_touch.model; saved.save",
        "from bcppl.inference import kernels; import pyro; kernels.metropolis_hastings",
        "from bcppl.inference import saved, tempered_smc; from bcppl.models.point_probe import model",
        *map(in_any_order, range(4)),
    ],
)
def test_modules_are_imported_in_any_order(code: str) -> None:
    assert {"torch", "pyro"} <= imported(code)


@pytest.mark.long
def test_what_is_set_in_a_module_before_its_use_stays() -> None:
    imported("from bcppl import poses\nposes.compose = 3\nassert poses.compose == 3 and poses.inverse")


@pytest.mark.long
def test_a_submodule_is_imported_after_its_package() -> None:
    assert "bcppl.traces.model" in imported("from bcppl import traces; import bcppl.traces.faults")


@pytest.mark.parametrize("door", DOORS)
def test_every_export_is_there_whatever_was_imported_before(door: str) -> None:
    """A function of a module's own name would be hidden by the module, once that is imported."""
    package = import_module(door)
    modules = {info.name for info in pkgutil.iter_modules(package.__path__)}
    assert set(package.__all__) <= set(dir(package))
    for name in package.__all__:
        value = getattr(package, name)
        assert isinstance(value, ModuleType) or name not in modules, name
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

"""From a name or a file on the command line to a recording, a model, an inference program."""

from __future__ import annotations

import importlib
import importlib.resources
import importlib.util
import pkgutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import bcppl.inference.filters
import bcppl.models
from bcppl.errors import InputError
from bcppl.recordings import Recording, load, validate
from bcppl.traces import Model

# Where a program that the command line cannot run is run from Python.
EXAMPLES = {
    f"bcppl.models.{name}": ", and benchmarks/arm.py runs it on recordings"
    for name in ("arm_calibration", "arm_in_view")
}


def recording(name: str) -> Recording:
    """The recording in a file, or a shipped one by name, checked.

    Raises:
        InputError: there is none, it cannot be read, or it has a problem.
    """
    found = unchecked_recording(name)
    validate(found)
    return found


def unchecked_recording(name: str) -> Recording:
    """The recording in a file, or a shipped one by name, whatever is wrong with it.

    Raises:
        InputError: there is none, or it cannot be read.
    """
    path = Path(name)
    if not path.exists() and not path.suffix:
        shipped = importlib.resources.files(bcppl.models) / "recordings"
        names = sorted(p.name.removesuffix(".h5") for p in shipped.iterdir() if p.name.endswith(".h5"))
        if name not in names:
            raise InputError(
                f"there is no recording {name!r}: give a file, or one that ships: {', '.join(names)}."
            )
        with importlib.resources.as_file(shipped / f"{name}.h5") as file:
            return load(file)
    return load(path)


def model(name: str) -> Model:
    """The model of a shipped file by name, or of a user's file: what it defines as `model`.

    Raises:
        InputError: there is no such model, or the file cannot be run.
    """
    return _defined(name, bcppl.models, "model", Model)


def inference(name: str) -> Any:
    """The inference program of a shipped file by name, or of a user's file: the function `infer`.

    Raises:
        InputError: there is no such program, or the file cannot be run.
    """
    return _defined(name, bcppl.inference.filters, "infer", None)


def refuse_seed(seed: int) -> None:
    """Refuse a seed that a generator does not take.

    Raises:
        InputError: it is negative, or does not fit into 63 bits.
    """
    if not 0 <= seed < 2**63:
        raise InputError(f"--seed is {seed}; give a number from 0 to {2**63 - 1}.")


def offered(package: ModuleType, attribute: str) -> list[str]:
    """The names of a package's files that define `attribute`."""
    return [
        n for n in _files(package) if hasattr(importlib.import_module(f"{package.__name__}.{n}"), attribute)
    ]


def _files(package: ModuleType) -> list[str]:
    return [info.name for info in pkgutil.iter_modules(package.__path__) if not info.ispkg]


def simulating() -> list[str]:
    """The names of the shipped models that make recordings up."""
    return [n for n in offered(bcppl.models, "model") if model(n).simulate_recording is not None]


def _defined(name: str, package: ModuleType, attribute: str, kind: type | None) -> Any:
    word = "model" if attribute == "model" else "inference program"
    if name.endswith(".py") or "/" in name:
        module = _from_file(Path(name), package, word)
    elif name in _files(package):
        module = importlib.import_module(f"{package.__name__}.{name}")
    else:
        raise InputError(
            f"there is no {word} {name!r}: give one of {', '.join(offered(package, attribute))}, "
            "or a file ending in .py."
        )
    found = getattr(module, attribute, None)
    if found is None or (kind is not None and not isinstance(found, kind)) or not (kind or callable(found)):
        if module.__name__.startswith(f"{package.__name__}."):
            place = module.__name__
            raise InputError(
                f"{place.rpartition('.')[2]} is used from Python, the command line cannot run it as its "
                f"{word}: `import {place}` and `help({place})` say how"
                f"{EXAMPLES.get(place, '')}; the command line has {', '.join(offered(package, attribute))}."
            )
        what = "a bcppl.traces.Model named `model`" if attribute == "model" else "a function named `infer`"
        raise InputError(f"{name} defines no {word}: it needs {what}.")
    return found


def _from_file(path: Path, package: ModuleType, word: str) -> ModuleType:
    if not path.is_file():
        raise InputError(
            f"there is no {word} file {path}; give an existing file ending in .py, or a shipped name."
        )
    # A shipped file given by its path is the shipped module: loaded twice, its classes would exist twice.
    for home in package.__path__:
        if path.resolve().parent == Path(home).resolve():
            return importlib.import_module(f"{package.__name__}.{path.stem}")
    name = f"bcppl_user_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path} is no Python file; give one ending in .py.")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up while it is being run.
    sys.modules[name] = module
    # A user's file may import what lies beside it, as `python FILE` would.
    sys.path.append(str(path.resolve().parent))
    try:
        spec.loader.exec_module(module)
    except InputError:
        raise
    except SyntaxError as error:
        raise InputError(
            f"the {word} file {path} is no valid Python: {error.msg}, line {error.lineno}."
        ) from error
    except (Exception, SystemExit) as error:
        raise InputError(
            f"the {word} file {path} stopped with {type(error).__name__}: {error}; "
            f"run `python {path}` to see where."
        ) from error
    return module

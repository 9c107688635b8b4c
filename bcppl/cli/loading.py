"""Recordings, models and inference programs by name, or from a file that the command line gives.

Data never runs code: what a recording or a run.json names is looked up among installed models, and a file is
run only where a person gives it with --model or --inference.
"""

from __future__ import annotations

import importlib.util
import inspect
import json
import pkgutil
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import bcppl.inference.filters
import bcppl.models
from bcppl.errors import InputError
from bcppl.inference.filters.default import Infer, default_inference
from bcppl.models.shipped import load_recording
from bcppl.recordings import Recording, once_each, validate
from bcppl.traces import Model

MODEL, INFERENCE = "model", "inference program"
# By word: where installed ones are, the name under which a file defines one, and what that has to be.
HOMES: dict[str, tuple[ModuleType, str, str]] = {
    MODEL: (bcppl.models, "model", "a bcppl.Model named `model`"),
    INFERENCE: (bcppl.inference.filters, "infer", "a function named `infer`"),
}


def recording(name: str, model_given: str | None = None, begun: bool = True) -> Recording:
    """The recording in a file, or a shipped one by name, checked, every measurement once.

    Without `begun` it may hold none: part, guess and peg are what a first touch is planned for.
    Its sensors may be those that a model's file, which the command line gives, imports.
    """
    if model_given is not None and _is_file(model_given):
        model(model_given)
    loaded = load_recording(name)
    validate(loaded, begun)
    return once_each(loaded)


def model(given: str | None, named: str = "", by: str = "the recording") -> Model:
    """The model that the command line gives (a name, or a file), else the installed one that data names."""
    return _defined(_trusted(given, named, by, MODEL, "--model"), MODEL)


def _trusted(given: str | None, named: str, by: str, word: str, option: str) -> str:
    if given is None and _is_file(named):
        raise InputError(
            f"{by} names the file {named!r} as its {word}, and data never runs code; "
            f"if you trust the file, give it with {option}."
        )
    return named if given is None else given


def settings(given: Sequence[str]) -> dict[str, Any]:
    """The settings that --set gives, `name=value`: values as in JSON, numbers and `null`, or else words."""
    read: dict[str, Any] = {}
    for each in given:
        name, equals, value = each.partition("=")
        if not (equals and name.isidentifier()):
            raise InputError(f"--set is given {each!r}; give a setting's name and value, --set profile=ur5e.")
        if name in read:
            raise InputError(
                f"--set gives {name} twice; give it once (`bcppl sweep` runs each value that it is given)."
            )
        try:
            read[name] = json.loads(value)
        except (ValueError, RecursionError):
            read[name] = value
    return read


def with_settings(model: Model, settings: Mapping[str, Any], name: str) -> Model:
    """A model with settings; InputError where it takes none."""
    if not settings:
        return model
    try:
        inspect.signature(model.prepare).bind(None, **settings)
    except TypeError as error:
        known = [
            n for n, p in inspect.signature(model.prepare).parameters.items() if p.default is not p.empty
        ]
        wrong = next((each for each in settings if each not in known), next(iter(settings)))
        offered = (
            f"it has {', '.join(known)}."
            if known
            else "its `prepare` is called with the recording alone; leave --set out, or let it take settings."
        )
        raise InputError(f"model {name} takes no setting {wrong!r}: {offered}") from error
    return model.with_settings(**settings)


def inference(given: str | None, chosen: Model, named: str = "", by: str = "the run") -> tuple[str, Infer]:
    """The name and the `infer` of an inference program; of the model's own with the model's settings.

    The command line gives a name or a file; else it is an installed one that data names, or the model's.
    """
    name, own = default_inference(chosen)
    given = _trusted(given, named, by, INFERENCE, "--inference")
    if given in ("", name):
        return name, own
    infer = _defined(given, INFERENCE)
    try:
        inspect.signature(infer).bind(chosen, None, particles=2, seed=0, scene=None)
    except TypeError as error:
        raise InputError(
            f"`infer` of {given} cannot be called ({error}); "
            "define it as infer(model, recording, *, particles=75, seed=0, scene=None)."
        ) from error
    return given, infer


def check_takes(infer: Infer, option: str, refusal: str, cure: str) -> None:
    """InputError, which says what is refused and the cure, where an inference program lacks an option."""
    try:
        inspect.signature(infer).bind(None, None, particles=2, seed=0, scene=None, **{option: None})
    except TypeError as error:
        raise InputError(f"{refusal}, its `infer` takes no `{option}`; {cure}.") from error


def simulating() -> list[str]:
    """The names of the installed models that simulate recordings."""
    return [name for name in _offered(MODEL) if model(name).simulate_recording is not None]


def _offered(word: str) -> list[str]:
    package, attribute, _ = HOMES[word]
    return [n for n in _files(package) if hasattr(import_module(f"{package.__name__}.{n}"), attribute)]


def _files(package: ModuleType) -> list[str]:
    return [info.name for info in pkgutil.iter_modules(package.__path__) if not info.ispkg]


def _is_file(name: str) -> bool:
    return name.endswith(".py") or "/" in name


def _defined(name: str, word: str) -> Any:
    package, attribute, needed = HOMES[word]
    if _is_file(name):
        module = _from_file(Path(name), package, word)
    elif name in _files(package):
        module = import_module(f"{package.__name__}.{name}")
    else:
        offered = ", ".join(_offered(word))
        raise InputError(f"there is no {word} {name!r}: give one of {offered}, or a file ending in .py.")
    defined = getattr(module, attribute, None)
    if isinstance(defined, Model) if word == MODEL else callable(defined):
        return defined
    if module.__name__.startswith(f"{package.__name__}."):
        raise InputError(
            f"{module.__name__} is used from Python, the command line cannot run it as its {word}: see "
            f"`help({module.__name__})`; the command line has {', '.join(_offered(word))}."
        )
    raise InputError(f"{name} defines no {word}: it needs {needed}.")


def _from_file(path: Path, package: ModuleType, word: str) -> ModuleType:
    if not path.is_file():
        raise InputError(f"there is no {word} file {path}; give a file ending in .py, or a name.")
    # An installed file given by its path is the installed module: otherwise its classes would exist twice.
    for home in package.__path__:
        if path.resolve().parent == Path(home).resolve():
            return import_module(f"{package.__name__}.{path.stem}")
    name = f"bcppl_user_{path.stem}"
    state = (path.resolve(), path.stat().st_mtime_ns, path.stat().st_size)
    if name in sys.modules and getattr(sys.modules[name], "__bcppl_read__", None) == state:
        return sys.modules[name]  # once: a second pass would register its sensors again
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
        what = f"the {word} file {path} is no valid Python"
        raise InputError(f"{what}: {error.msg}, line {error.lineno}.") from error
    except (Exception, SystemExit) as error:
        what = f"the {word} file {path} stopped with {type(error).__name__}: {error}"
        raise InputError(f"{what}; run `python {path}` to see where.") from error
    vars(module)["__bcppl_read__"] = state
    return module

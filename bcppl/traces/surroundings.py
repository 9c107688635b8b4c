"""What a lazy distribution reads beside its own attributes: global variables and attributes of its class.

A log-probability is evaluated after the program has run, when such a variable may hold another value. So
their values are kept with the run: a site is evaluated again where they differ, and is refused where they
have changed before it was evaluated. The names are those that the code of the class's methods loads, and of
the functions that the distribution holds or that these call, outside of bcppl and of installed packages.
Objects that are reached otherwise (a context variable, what a cached function returns, a variable that a
function of C reads) are not seen; `check_program` detects them.
"""

from __future__ import annotations

import dis
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache, lru_cache, partial
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.traces.dependence import comparison

Names = tuple[tuple[str, str | None], ...]
# Of a container or an array that is copied; a larger one is compared as the same object.
FEW, SMALL = 100, 10_000
_MISSING = object()
_NO_DATA = (FunctionType, ModuleType, type, property, classmethod, staticmethod, type(len))


def surroundings(distributions: Mapping[str, Any]) -> dict[str, Any]:
    """The values that lazy distributions read from outside, by address; only where there are any."""
    kept = {}
    for address, distribution in distributions.items():
        if isinstance(distribution, LazyDistribution) and (value := surroundings_of(distribution)):
            kept[address] = value
    return kept


def surroundings_of(distribution: LazyDistribution) -> dict[Any, Any]:
    """The values that one distribution reads from outside, by name; containers and small arrays copied."""
    classes = _own_classes(type(distribution))
    if not classes:
        return {}
    found: dict[Any, Any] = {}
    read: set[Any] = set()
    for own in classes:
        for name, value in vars(own).items():
            if type(value) is FunctionType:
                _read(value, found, read)
            elif not name.startswith("_abc_") and not name.startswith("__") and _is_data(value):
                found[own, name] = value
    for value in vars(distribution).values():
        for function in _functions(value):
            _read(function, found, read)
    return {key: _kept(value) for key, value in found.items()}


def changed(then: Mapping[Any, Any], now: Mapping[Any, Any]) -> str | None:
    """The name of a variable that is another now; None if none is.

    Entries that were added to a container are no change: a table of what was computed before grows, as a log
    does. Nor are variables that a log-probability itself has written to.
    """
    for key, value in then.items():
        if key not in _WRITTEN and not (key in now and _still(value, now[key])):
            return str(key[1])
    return None


def evaluated(distribution: LazyDistribution, evaluate: Callable[[], Tensor]) -> Tensor:
    """The result of `evaluate`; the variables that it writes to are taken to be caches, logs and counts."""
    before = surroundings_of(distribution)
    value = evaluate()
    now = surroundings_of(distribution)
    same = comparison()
    _WRITTEN.update(key for key, each in before.items() if not same(each, now.get(key)))
    return value


_WRITTEN: set[Any] = set()


def _still(then: Any, now: Any) -> bool:
    if type(then) is dict and type(now) is dict:
        return all(key in now and _still(value, now[key]) for key, value in then.items())
    if type(then) is list and type(now) is list:
        return len(now) >= len(then) and all(map(_still, then, now))
    return comparison()(then, now)


def _read(function: FunctionType, found: dict[Any, Any], read: set[Any]) -> None:
    """Add the values of the variables that a function loads, and those of its user's functions."""
    names, key = function.__globals__, (function.__code__, id(function.__globals__))
    if key in read or _is_installed(names.get("__name__", "")):
        return
    read.add(key)
    for name, attribute in loaded(function.__code__):
        value = names.get(name, _MISSING)
        if type(value) is FunctionType:
            _read(value, found, read)
        elif attribute is None or isinstance(value, Tensor | np.ndarray):
            if _is_data(value):
                found[id(names), name] = value
        elif not (isinstance(value, ModuleType) and _is_installed(value.__name__)):
            if _is_data(value):
                found[id(names), name] = value
            held = getattr(value, "__dict__", {}).get(attribute, _MISSING)
            if type(held) is FunctionType:
                _read(held, found, read)
            elif _is_data(held):
                found[id(value), f"{name}.{attribute}"] = held


def _is_data(value: Any) -> bool:
    return value is not _MISSING and not isinstance(value, _NO_DATA)


@lru_cache(maxsize=4096)
def loaded(code: CodeType) -> Names:
    """The global names that code loads, each with the attribute that is taken from it at once, if any."""
    found: dict[tuple[str, str | None], None] = {}
    name = None
    for each in dis.get_instructions(code):
        if name is not None:
            found[name, each.argval if each.opname in ("LOAD_ATTR", "LOAD_METHOD") else None] = None
        name = each.argval if each.opname in ("LOAD_GLOBAL", "LOAD_NAME") else None
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            found.update(dict.fromkeys(loaded(constant)))
    return tuple(found)


def _functions(value: Any) -> Iterator[FunctionType]:
    """The functions that a value is, is bound to, or closes over."""
    if type(value) is FunctionType:
        yield value
        for cell in value.__closure__ or ():
            try:
                held = cell.cell_contents
            except ValueError:
                continue
            if held is not value and type(held) in (FunctionType, MethodType, partial):
                yield from _functions(held)
    elif type(value) is MethodType:
        yield from _functions(value.__func__)
    elif type(value) is partial:
        yield from _functions(value.func)


@cache
def _own_classes(kind: type) -> tuple[type, ...]:
    """The classes of a user among a class and its bases."""
    return tuple(each for each in kind.__mro__ if not _is_installed(each.__module__))


@cache
def _is_installed(module: str) -> bool:
    """Whether a module is bcppl's, Python's own, or installed: these write to no variables of their own."""
    root = module.partition(".")[0]
    if root in ("bcppl", "builtins") or (root in sys.stdlib_module_names and root != "__main__"):
        return True
    where = getattr(sys.modules.get(module), "__file__", None) or ""
    return "site-packages" in where or "dist-packages" in where


def _kept(value: Any, depth: int = 3) -> Any:
    """A value as it is now: a container of few entries and a small array are copied."""
    if isinstance(value, Tensor):
        return (value, value._version) if not value.is_inference() else value
    if isinstance(value, np.ndarray):
        return value.copy() if value.size <= SMALL else value
    if depth and type(value) in (list, tuple) and len(value) <= FEW:
        return type(value)(_kept(each, depth - 1) for each in value)
    if type(value) is set and len(value) <= FEW:
        return frozenset(value)
    if depth and type(value) is dict and len(value) <= FEW:
        return {key: _kept(each, depth - 1) for key, each in value.items()}
    return value

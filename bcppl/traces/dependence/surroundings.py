"""What a lazy distribution reads beside its own attributes: global variables and attributes of its class.

A log-probability is evaluated after the program has run, when such a variable may hold another value. So
their values are kept with the run: a site is evaluated again where they differ, and is refused where they
have changed before it was evaluated. The names are those that the code of the class's methods loads, and of
the functions that the distribution holds or that these call, outside of bcppl and of installed packages.
Objects that are reached otherwise (a context variable, what a cached function returns, a variable that a
function of C reads) are not seen; `check_program` detects them.
"""

from __future__ import annotations

import builtins
import dis
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache, lru_cache, partial
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.traces.dependence.equality import comparison

Names = tuple[tuple[str, str | None], ...]
# The variables of a module, the name of one of them, and of an attribute that is taken from it.
Variable = tuple[dict[str, Any], str, str | None]
# Of a container or an array that is copied; a larger one is compared as the same object.
FEW, SMALL = 100, 10_000
_MISSING = object()
_Builtin = type(len)
_NO_DATA = frozenset({FunctionType, ModuleType, type, property, classmethod, staticmethod, _Builtin})
# What a class of distributions declares.
_DECLARED = frozenset({"_abc_impl", "arg_constraints", "support", "cost", "broadcasts", "has_rsample"})


def surroundings(distributions: Mapping[str, Any]) -> dict[str, Any]:
    """The values that lazy distributions read from outside, by address; only where there are any."""
    kept = {}
    for address, distribution in distributions.items():
        if isinstance(distribution, LazyDistribution) and (value := surroundings_of(distribution)):
            kept[address] = value
    return kept


def surroundings_of(distribution: LazyDistribution) -> dict[Any, Any]:
    """The values that one distribution reads from outside, by name; containers and small arrays copied."""
    kind = type(distribution)
    classes = _own_classes(kind)
    if not classes:
        return {}
    kept: dict[Any, Any] = {}
    for own in classes:
        for name, value in vars(own).items():
            if type(value) not in _NO_DATA and name not in _DECLARED and name[:2] != "__":
                kept[own, name] = _kept(value)
    variables = _of_methods(kind)
    for value in vars(distribution).values():
        if type(value) in (FunctionType, MethodType, partial):
            for function in _functions(value):
                variables += _variables(function)
    for names, name, attribute in variables:
        value = names.get(name, _MISSING)
        if attribute is not None and not isinstance(value, Tensor | np.ndarray):
            held = getattr(value, "__dict__", {}).get(attribute, _MISSING)
            if held is not _MISSING and type(held) not in _NO_DATA:
                kept[id(value), f"{name}.{attribute}"] = _kept(held)
        if value is not _MISSING and type(value) not in _NO_DATA and not isinstance(value, type):
            kept[id(names), name] = _kept(value)
    return kept


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


@cache
def _of_methods(kind: type) -> tuple[Variable, ...]:
    """The variables that the methods of a class read."""
    methods = (each for own in _own_classes(kind) for each in vars(own).values())
    names = (_variables(each) for method in methods for each in _functions(getattr(method, "fget", method)))
    return tuple(each for some in names for each in some)


def _variables(function: FunctionType) -> tuple[Variable, ...]:
    """The variables that a function reads, and those that the functions of its user read that it calls."""
    key = function.__code__, id(function.__globals__)
    if key not in _KNOWN:
        # Kept from here on, so that a function that calls itself ends.
        _KNOWN[key] = ()
        _KNOWN[key] = tuple(_read(function))
    return _KNOWN[key]


def _read(function: FunctionType) -> Iterator[Variable]:
    names = function.__globals__
    if _is_installed(names.get("__name__", "")):
        return
    for name, attribute in loaded(function.__code__):
        value = names.get(name, _MISSING)
        if isinstance(value, ModuleType) and attribute is not None and not _is_installed(value.__name__):
            called = vars(value).get(attribute)
            yield from _variables(called) if type(called) is FunctionType else [(names, name, attribute)]
        elif type(value) is FunctionType:
            yield from _variables(value)
            if attribute is not None:
                yield names, name, attribute
        elif not isinstance(value, ModuleType) and not _is_of_python(value) and name not in vars(builtins):
            yield names, name, attribute


_KNOWN: dict[Any, tuple[Variable, ...]] = {}


def _is_of_python(value: Any) -> bool:
    """Whether a value is a class or a function of Python, bcppl or an installed package."""
    module = getattr(value, "__module__", None) if isinstance(value, type | _Builtin) else None
    return isinstance(module, str) and _is_installed(module)


@lru_cache(maxsize=4096)
def loaded(code: CodeType) -> Names:
    """The global names that code loads, each with the attribute that is taken from it at once, if any."""
    names: dict[tuple[str, str | None], None] = {}
    name = None
    for each in dis.get_instructions(code):
        if name is not None:
            names[name, each.argval if each.opname in ("LOAD_ATTR", "LOAD_METHOD") else None] = None
        name = each.argval if each.opname in ("LOAD_GLOBAL", "LOAD_NAME") else None
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names.update(dict.fromkeys(loaded(constant)))
    return tuple(names)


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
    if root == "__main__":
        # A notebook's too, which the file of its launcher would make an installed one.
        return False
    if root in ("bcppl", "builtins") or root in sys.stdlib_module_names:
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

"""What a scene holds, as text and bytes: by two listings it is seen whether anything was written into it."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator, Mapping
from types import FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from torch.distributions.utils import lazy_property
from trimesh.caching import Cache

from bcppl.traces.dependence.equality import _layout

PLAIN = (bool, int, float, str, bytes, type(None), type, ModuleType)
# Whatever they hold is determined by what they are asked.
CACHES = (functools._lru_cache_wrapper, Cache)


def contents(value: Any) -> dict[str, Any]:
    """All that a value holds by its path, `.observe[0]`: numbers to the bit, objects by their attributes.

    Left out is what may be filled: caches, attributes that a class names in `__caches__` (the cost of a
    simulator, for one), and values of `functools.cached_property`. An object that is not understood is
    listed by its identity.
    """
    return dict(_listed(value, "", {}))


def _listed(value: Any, path: str, met: dict[int, Any]) -> Iterator[tuple[str, Any]]:
    kind = type(value)
    if isinstance(value, PLAIN):
        yield path, (kind, repr(value))
    elif id(value) in met:
        yield path, ("the same as", met[id(value)][1])
    elif not isinstance(value, CACHES):
        met[id(value)] = value, path  # kept, so that nothing else gets its place in memory
        own, parts = _taken_apart(value)
        yield path, (kind, own)
        for name, part in parts.items():
            yield from _listed(part, f"{path}{name}", met)


def _taken_apart(value: Any) -> tuple[Any, Mapping[str, Any]]:
    """What a value is of itself, and its parts by name."""
    if isinstance(value, torch.Tensor):
        return _array(value.detach().numpy()), {}
    if isinstance(value, np.ndarray | np.generic):
        return _array(np.asarray(value)), {}
    if isinstance(value, Mapping):
        keys = [key if isinstance(key, str) else id(key) for key in value]
        return keys, {f"[{key!r}]": each for key, each in zip(keys, value.values(), strict=True)}
    if isinstance(value, set | frozenset):
        return sorted(map(repr, value)), {}
    if isinstance(value, FunctionType):
        return value.__code__, {
            ".closure": inspect.getclosurevars(value).nonlocals,
            ".defaults": value.__defaults__,
        }
    if isinstance(value, MethodType):
        return value.__func__, {".self": value.__self__}
    if isinstance(value, functools.partial):
        return id(value.func), {".func": value.func, ".args": value.args, ".keywords": value.keywords}
    attributes = _attributes(value)
    if isinstance(value, list | tuple):
        return len(value), {**attributes, **{f"[{k}]": each for k, each in enumerate(value)}}
    return (sorted(attributes) if attributes else id(value)), attributes


def _array(values: Any) -> Any:
    return values.dtype, values.shape, values.tobytes()


def _attributes(value: Any) -> Mapping[str, Any]:
    kind = type(value)
    lazy = {name for base in kind.__mro__ for name, each in vars(base).items() if type(each) is lazy_property}
    return {
        f".{name}": each
        for name, each in _layout(kind).attributes(value).items()
        if name not in lazy | _layout(kind).cached
    }

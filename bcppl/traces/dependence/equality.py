"""Whether two values are the same part by part: so it is known which sites depend on new values.

A program is run again at other values and makes its distributions again. A log-probability is kept where the
distribution is the same as before, and a simulator's state where the function that began it is: whatever
they depend on, and however it reached them, is a part of them. What is not understood counts as changed, so
that an error costs an evaluation and never gives a wrong density.

Two values are the same if they are one object; tensors or arrays that are equal to the bit; containers,
objects, partial applications, or functions with equal code, whose parts are the same. Parts that cache what
the others determine do not count: the attributes that a class names in `__caches__`, and the values of
a `cached_property` where not both have one or it is no number and no array.
What is stored neither in a value nor in its parts is not seen: a write into an object that both runs share.
Global variables that a lazy site reads are compared besides (`bcppl.traces.dependence.surroundings`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from struct import calcsize
from types import (
    BuiltinMethodType,
    CellType,
    FunctionType,
    MappingProxyType,
    MemberDescriptorType,
    MethodType,
    NoneType,
)
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.distributions.transforms import Transform, _InverseTransform
from torch.distributions.utils import lazy_property

from bcppl.cached import cached_property

Array = Tensor | npt.NDArray[Any]

_ARRAYS = frozenset({Tensor, torch.nn.Parameter, np.ndarray})
_PLAIN = frozenset({int, float, bool, str, bytes, range, NoneType, torch.Size, torch.dtype, torch.device})
_BITS = {1: torch.int8, 2: torch.int16, 4: torch.int32, 8: torch.int64}
_EMPTY = object()


def alike(first: Any, second: Any, arrays: Callable[[Any, Any], bool], *, shared: bool = False) -> bool:
    """Whether two values are the same, given which tensors and arrays are.

    Args:
        first: any value.
        second: any value.
        arrays: whether two tensors or arrays in the same place are the same; called until one pair is not.
        shared: call it for those that are one object too, except within an object that both share.
    """
    stack, met = [(first, second)], {}
    try:
        while stack:
            a, b = stack.pop()
            if type(a) is _Then:
                a, b = a.beside(b)
            kind = type(a)
            if a is b:
                if shared and kind in _ARRAYS and not arrays(a, b):
                    return False
            elif kind is not type(b):
                return False
            elif kind in _ARRAYS:
                if not arrays(a, b):
                    return False
            elif kind in _PLAIN:
                if not _equal_plain(a, b):
                    return False
            elif (id(a), id(b)) not in met:
                # Both are kept, so that nothing else gets their place in memory.
                met[id(a), id(b)] = a, b
                stack += _parts(kind, a, b, shared)
    except _UnlikeError:
        return False
    return True


class _UnlikeError(Exception):
    """Two values differ, or one of them is not understood."""


def _equal_plain(first: Any, second: Any) -> bool:
    """Whether two values of one plain type are equal; NaN is equal to itself, 0.0 is not to -0.0."""
    if first != second:
        return first != first and second != second
    return type(first) is not float or first != 0.0 or first.hex() == second.hex()


def equal(first: Any, second: Any) -> bool:
    """Whether two tensors or two arrays are equal to the bit: NaN is equal to itself, 0 is not to -0."""
    if first is second:
        return True
    if first.shape != second.shape or first.dtype != second.dtype:
        return False
    if isinstance(first, Tensor):
        return _equal_tensors(first, second)
    return not first.dtype.hasobject and first.tobytes() == second.tobytes()


def _equal_tensors(first: Tensor, second: Any) -> bool:
    if first.device != second.device or first.layout != torch.strided or second.layout != torch.strided:
        return False
    if first.is_conj() or second.is_conj() or first.is_neg() or second.is_neg():
        first, second = (each.resolve_conj().resolve_neg() for each in (first, second))
    if first.data_ptr() == second.data_ptr() and first.stride() == second.stride():
        return True
    if first.is_complex():
        first, second = torch.view_as_real(first), torch.view_as_real(second)
    if first.is_floating_point():
        bits = _BITS[first.element_size()]
        first, second = first.detach().view(bits), second.detach().view(bits)
    return torch.equal(first, second)


def comparison() -> Callable[[Any, Any], bool]:
    """A comparison of values of the same two runs; tensors that several share are compared once."""
    known: dict[tuple[int, int], tuple[bool, Any, Any]] = {}

    def are_equal(a: Array, b: Array) -> bool:
        key = id(a), id(b)
        if key not in known:
            known[key] = equal(a, b), a, b
        return known[key][0]

    return lambda first, second: alike(first, second, are_equal)


def snapshot(value: Any) -> Any:
    """A function as it is now, to compare others with: its variables may be assigned to later.

    Functions, partial applications, lists, tuples and dictionaries are copied, with what they hold; other
    objects are not.
    """
    return _copied(value, {})


def _copied(value: Any, copies: dict[int, Any]) -> Any:
    if id(value) in copies:
        return copies[id(value)]
    kind = type(value)
    if kind is FunctionType and (value.__closure__ or value.__defaults__ or value.__kwdefaults__):
        cells = tuple(CellType() for _ in value.__closure__ or ())
        copy = FunctionType(value.__code__, value.__globals__, value.__name__, None, cells)
        copies[id(value)] = copy
        copy.__defaults__ = _copied(value.__defaults__, copies)
        copy.__kwdefaults__ = {k: _copied(v, copies) for k, v in (value.__kwdefaults__ or {}).items()} or None
        copy.__dict__.update({name: _copied(each, copies) for name, each in value.__dict__.items()})
        for cell, original in zip(cells, value.__closure__ or (), strict=True):
            if (content := _content(original)) is not _EMPTY:
                cell.cell_contents = _copied(content, copies)
        return copy
    if kind is partial:
        keywords = {name: _copied(each, copies) for name, each in value.keywords.items()}
        return partial(_copied(value.func, copies), *_copied(value.args, copies), **keywords)
    if kind is list:
        copies[id(value)] = then = _Then(value, [])
        then.copy.extend(_copied(each, copies) for each in value)
        return then
    if kind is dict:
        copies[id(value)] = then = _Then(value, {})
        then.copy.update((key, _copied(each, copies)) for key, each in value.items())
        return then
    return tuple(_copied(each, copies) for each in value) if kind is tuple else value


@dataclass(frozen=True, eq=False)
class _Then:
    """A list or a dictionary as it was, and itself: two runs may share it, and one may write into it."""

    original: Any
    copy: Any

    def beside(self, other: Any) -> tuple[Any, Any]:
        """The two that are to be compared."""
        now, copy = (other.original, other.copy) if type(other) is _Then else (other, other)
        return (now, now) if self.original is now else (self.copy, copy)


def _content(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:
        return _EMPTY


def _parts(kind: type, a: Any, b: Any, shared: bool) -> list[tuple[Any, Any]]:
    """Pairs of the parts of two values of one type that are still to be compared."""
    layout = _layout(kind)
    if layout.root is not None:
        parts = _attributes(layout, a, b, shared)
        if layout.root is dict:
            parts += _paired(a.keys(), b.keys()) + _paired(a.values(), b.values())
        elif layout.root is not object:
            parts += _paired(a, b)
        return parts
    if kind is FunctionType:
        return _parts_of_functions(a, b)
    if kind is MethodType:
        return [(a.__func__, b.__func__), (a.__self__, b.__self__)]
    if kind is BuiltinMethodType:
        return [(a.__name__, b.__name__), (a.__self__, b.__self__)]
    if kind is partial:
        return [(a.func, b.func), (a.args, b.args), (a.keywords, b.keywords)]
    if kind is MappingProxyType:
        return [(dict(a), dict(b))]
    if issubclass(kind, np.generic) and a.dtype == b.dtype and a.tobytes() == b.tobytes():
        return []
    if kind in (set, frozenset) and a == b and all(type(each) in _PLAIN for each in (*a, *b)):
        return []
    raise _UnlikeError


def _parts_of_functions(a: Any, b: Any) -> list[tuple[Any, Any]]:
    if a.__code__ != b.__code__ or a.__globals__ is not b.__globals__:
        raise _UnlikeError
    cells = ([_content(cell) for cell in each.__closure__ or ()] for each in (a, b))
    parts = [(a.__defaults__, b.__defaults__), (a.__kwdefaults__, b.__kwdefaults__), *_paired(*cells)]
    return [*parts, (a.__dict__, b.__dict__)] if a.__dict__ or b.__dict__ else parts


def _paired(first: Any, second: Any) -> list[tuple[Any, Any]]:
    if len(first) != len(second):
        raise _UnlikeError
    return list(zip(first, second, strict=True))


class _Layout(NamedTuple):
    """Where the instances of a class keep their parts."""

    root: type | None  # list, tuple, dict, or object for none of them; None: more than Python can see
    slots: Mapping[str, Any]  # descriptors of `__slots__`
    computed: frozenset[str]  # attributes that torch computes from the others, or the others from them
    cached: frozenset[str]  # cached properties
    caches: frozenset[str]  # attributes that do not count

    def attributes(self, value: Any) -> Mapping[str, Any]:
        """The attributes of an instance that count, by name."""
        held: dict[str, Any] = getattr(value, "__dict__", {})
        if not self.slots and not self.caches and not self.cached:
            return held
        held = {name: each for name, each in held.items() if name not in self.caches}
        for name in self.slots.keys() - self.caches:
            try:
                held[name] = self.slots[name].__get__(value)
            except AttributeError:
                continue
        return held


@lru_cache(maxsize=4096)
def _layout(kind: type) -> _Layout:
    slots, computed, cached = {}, set(), set()
    for base in kind.__mro__:
        for name, each in vars(base).items():
            if isinstance(each, (cached_property, functools.cached_property)):
                cached.add(name)
            elif isinstance(each, lazy_property):
                computed.add(name)
            # What a class of C calls a member is not all that it keeps.
            elif isinstance(each, MemberDescriptorType) and "__slots__" in vars(base):
                slots[name] = each
    root = next((each for each in (list, tuple, dict) if issubclass(kind, each)), object)
    # By the same count pickle knows what it cannot copy.
    dictionary = kind.__dictoffset__ > 0 or (kind.__dictoffset__ < 0 and kind.__itemsize__ > 0)
    pointers = dictionary + (kind.__weakrefoffset__ > 0) + len(slots)
    whole = kind.__basicsize__ == root.__basicsize__ + pointers * calcsize("P")
    whole = whole and kind.__itemsize__ == root.__itemsize__ and kind is not object
    return _Layout(root if whole else None, slots, frozenset(computed), frozenset(cached), _caches(kind))


def _caches(kind: type) -> frozenset[str]:
    if not issubclass(kind, Transform):
        return frozenset(getattr(kind, "__caches__", ()))
    # Torch keeps the last value that was transformed, and in all but an inverse what undoes it.
    return frozenset({"_cached_x_y"} | ({"_inv"} if kind is not _InverseTransform else set()))


def _attributes(layout: _Layout, a: Any, b: Any, shared: bool) -> list[tuple[Any, Any]]:
    """Pairs of attributes that are still to be compared."""
    mine, others = layout.attributes(a), layout.attributes(b)
    for name in layout.cached:
        # The others determine it, unless something was assigned: it counts where both have numbers.
        x, y = mine.get(name), others.get(name)
        if x is None or y is None or type(x) not in _PLAIN | _ARRAYS:
            mine, others = ({n: v for n, v in each.items() if n != name} for each in (mine, others))
    if mine.keys() != others.keys():
        mine, others = _common(layout, mine, others)
    pairs = []
    for name, x in mine.items():
        y = others[name]
        if x is y and not shared:
            continue
        kind = type(x)
        if kind not in _PLAIN:
            pairs.append((x, y))
        elif kind is not type(y) or not ((x == y and x) or _equal_plain(x, y)):
            raise _UnlikeError
    return pairs


def _common(layout: _Layout, a: Mapping[str, Any], b: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Attributes without those that were computed for one alone."""
    alone = a.keys() ^ b.keys()
    # A parameter may have the name of what is computed where another one is given: probs and logits.
    if alone - layout.computed or not (a.keys() <= b.keys() or a.keys() >= b.keys()):
        raise _UnlikeError
    return [{name: each[name] for name in each.keys() - alone} for each in (a, b)]

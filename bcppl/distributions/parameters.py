"""Ranges of the parameters of a distribution or of settings: declared with the fields, checked in one place.

scale: float = field(metadata=POSITIVE)
outlier: float = field(default=0.1, metadata=PROBABILITY)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, lru_cache
from types import NoneType
from typing import Any

import numpy as np
from torch import Tensor

from bcppl.arguments import named, number_within, whole_number
from bcppl.errors import InputError

_PLAIN = frozenset({float, int, NoneType})


@dataclass(frozen=True)
class Range:
    """Finite numbers between bounds, of which `above` and `below` are excluded.

    Attributes:
        whole: whether the numbers are whole ones; only `least` bounds these.
        optional: whether None may be given.
        count: how many such numbers are to be given, in a sequence; 0 for one by itself.
        latent: whether a tensor (N,), a value for each particle, may be given. It is not checked: a proposed
            value may leave the range, and then has probability zero.
    """

    above: float = -math.inf
    least: float = -math.inf
    below: float = math.inf
    most: float = math.inf
    whole: bool = False
    optional: bool = False
    count: int = 0
    latent: bool = False

    def checked(self, what: str, value: Any) -> Any:
        """The value as a float or an int; `what` begins the sentence that refuses it, {} for the value."""
        each = self.latent and isinstance(value, Tensor) and value.ndim > 0
        if each or (self.optional and value is None):
            return value
        if self.count:
            if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != self.count:
                raise InputError(f"{named(what, value)}; give {self.count} numbers.")
            one = replace(self, count=0)
            return tuple(one.checked(what, each) for each in value)
        if self.whole:
            return whole_number(what, value, least=int(self.least))
        return number_within(
            what, value, above=self.above, least=self.least, below=self.below, most=self.most
        )


def within(**bounds: Any) -> Mapping[str, Range]:
    """The metadata of a field with this `Range`."""
    return {"range": Range(**bounds)}


POSITIVE = within(above=0.0)
NONNEGATIVE = within(least=0.0)
PROBABILITY = within(above=0.0, below=1.0)
RARE = within(least=0.0, below=1.0)
COUNT = within(least=1, whole=True)
IF_GIVEN = within(above=0.0, optional=True)


@cache
def ranges(kind: type) -> dict[str, Range]:
    """The ranges that a class declares with its fields, by name."""
    declared = fields(kind) if is_dataclass(kind) else ()
    return {each.name: each.metadata["range"] for each in declared if "range" in each.metadata}


def check_parameters(owner: Any) -> None:
    """Check the fields that declare a range, and make them floats and ints."""
    kind: type = type(owner)
    values = tuple(getattr(owner, name) for name in ranges(kind))
    types = tuple(map(type, values))
    # Programs make the same distributions again and again.
    checked = _checked_before if _PLAIN.issuperset(types) else _checked
    for name, value, given in zip(ranges(kind), checked(kind, types, values), values, strict=True):
        if value is not given:
            object.__setattr__(owner, name, value)


def _checked(kind: type, types: tuple[type, ...], values: tuple[Any, ...]) -> list[Any]:
    """The values of a class's fields as they are kept; equal ones of other types are others."""
    each = zip(ranges(kind).items(), values, strict=True)
    return [allowed.checked(f"{kind.__name__} has {name} = {{}}", value) for (name, allowed), value in each]


_checked_before = lru_cache(maxsize=1024)(_checked)


def check_shape(where: str, name: str, value: Any, *shapes: tuple[int, ...]) -> None:
    """Check that an array, where one is given, has one of some shapes."""
    if isinstance(value, Tensor | np.ndarray) and tuple(value.shape) not in shapes:
        fitting = " or ".join(str(tuple(shape)) for shape in shapes)
        raise InputError(f"{where} has {name} of shape {tuple(value.shape)}; give {fitting}.")

"""Types of numpy arrays, and dataclasses of arrays that share their first axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from bcppl.errors import InputError

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Numbers = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]
Rows = Indices | Mask | slice


@dataclass(frozen=True, eq=False)
class ArrayRecord:
    """Arrays indexed, merged and joined as one; a field is an array, a mapping of them, a record or None."""

    def __getitem__(self, rows: Rows) -> Self:
        """Some rows of every field."""
        return self._mapped(lambda value: value[rows])

    def put(self, rows: Rows, other: Self) -> Self:
        """A copy in which some rows are another record's."""
        return self._mapped(lambda mine, theirs: _put(mine, rows, theirs), other)

    @classmethod
    def joined(cls, records: Sequence[Self]) -> Self:
        """The rows of several records, in their order."""
        return records[0]._mapped(lambda *each: np.concatenate(each), *records[1:])

    def named(self) -> dict[str, npt.NDArray[Any]]:
        """Every array by its name, that of a record within by both names, `state.tail`."""
        named: dict[str, npt.NDArray[Any]] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, ArrayRecord):
                value = value.named()
            if isinstance(value, Mapping):
                named |= {f"{field.name}.{key}": each for key, each in value.items()}
            elif value is not None:
                named[field.name] = value
        return named

    def renamed(self, named: Mapping[str, npt.NDArray[Any]]) -> Self:
        """A copy with other arrays of the same names, types and shapes.

        A second axis without entries, that of stamps before the first, may have some.

        Raises:
            InputError: an array is missing, or has another type or shape.
        """
        values: dict[str, Any] = {}
        for field in fields(self):
            value, begin = getattr(self, field.name), f"{field.name}."
            within = {name.removeprefix(begin): v for name, v in named.items() if name.startswith(begin)}
            if isinstance(value, ArrayRecord):
                value = value.renamed(within)
            elif isinstance(value, Mapping):
                value = {key: _alike(key, each, within) for key, each in value.items()}
            elif value is not None:
                value = _alike(field.name, value, named)
            values[field.name] = value
        return type(self)(**values)

    def _mapped(self, function: Any, *others: Self) -> Self:
        values: dict[str, Any] = {}
        for name in (field.name for field in fields(self)):
            each = [getattr(record, name) for record in (self, *others)]
            if isinstance(each[0], Mapping):
                values[name] = {key: function(*(value[key] for value in each)) for key in each[0]}
            else:
                values[name] = None if each[0] is None else function(*each)
        return type(self)(**values)


def as_array(values: Any) -> Any:
    """Numbers in lists as an array; anything else as it is, for a check to name."""
    try:
        return np.asarray(values, dtype=np.float64) if isinstance(values, (list, tuple)) else values
    except (TypeError, ValueError):
        return values


def _alike(name: str, mine: Any, named: Mapping[str, npt.NDArray[Any]]) -> Any:
    theirs = named.get(name)
    axes = [axis for axis in range(mine.ndim) if axis != 1 or mine.shape[1]]
    if (
        not isinstance(theirs, np.ndarray)
        or theirs.dtype != mine.dtype
        or theirs.ndim != mine.ndim
        or any(theirs.shape[axis] != mine.shape[axis] for axis in axes)
    ):
        raise InputError(f"a simulator's state has no array {name!r} of its type and shape.")
    return theirs


def _put(mine: Any, rows: Rows, theirs: Any) -> Any:
    if isinstance(mine, ArrayRecord):
        return mine.put(rows, theirs)
    copy = mine.copy()
    copy[rows] = theirs
    return copy


def spanned(times: Array) -> str:
    """How many times there are, and from when to when: `50 stamps, 0.000 to 0.490 s`."""
    return f"{len(times)} stamps" + (f", {times[0]:.3f} to {times[-1]:.3f} s" if len(times) else "")

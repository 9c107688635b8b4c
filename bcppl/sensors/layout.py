"""Layouts: how an object lies in a file, field by field, each with its units.

A layout writes a data class into a group of an HDF5 file and reads it again, does the same for JSON, and
lists the values as a file holds them, for fingerprints. A kind of measurement declares its fields once:

    PUSH = Layout(Push, {"times": numbers("s"), "world_from_tip": numbers(POSE_UNITS)})
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar
from urllib.parse import quote

import h5py
import numpy as np
import numpy.typing as npt

from bcppl.errors import InputError

POSE_UNITS = "m m m 1 1 1 1"  # [x y z qw qx qy qz]
WRENCH_UNITS = "N N N N m N m N m"
KIND = "kind"  # an attribute beside the fields that says which layout they are of
SMALLEST_COMPRESSED = 256  # entries: below it gzip's chunk index outweighs what it saves

T = TypeVar("T")


@dataclass(frozen=True)
class Field:
    """How one field of an object is kept.

    Attributes:
        stored: the value as a file holds it: an array (a dataset), a list of strings (a dataset, for an
            attribute holds 64 KiB at most), or a string or a whole number (an attribute).
        parsed: the value of what a file holds, HDF5 or JSON.
        units: of an array, SI, in the dataset's attribute `units`.
        group: where measurements share the object: its place at the file's root. It is written there once,
            and the attribute holds its name.
        layout: of the shared object, all fields but its `name`.
    """

    stored: Callable[[Any], Any]
    parsed: Callable[[Any], Any]
    units: str = ""
    group: str = ""
    layout: Layout[Any] | None = None

    def write(self, group: h5py.Group, key: str, value: Any) -> None:
        """Write a dataset, compressed where that is worth it, or an attribute."""
        stored = self.stored(value)
        if isinstance(stored, list):
            group.create_dataset(key, data=stored, dtype=h5py.string_dtype())
        elif isinstance(stored, np.ndarray):
            compressed = stored.size >= SMALLEST_COMPRESSED
            options: dict[str, Any] = {"compression": "gzip", "shuffle": True} if compressed else {}
            group.create_dataset(key, data=stored, **options).attrs["units"] = self.units
        else:
            group.attrs[key] = stored

    def read(self, group: h5py.Group, key: str) -> Any:
        """The value in a group.

        Raises:
            KeyError: it is missing.
            ValueError: it is of another form, or in other units, or in none.
        """
        if key in group.attrs and not self.units:
            return _named(key, self.parsed, group.attrs[key])
        kept = group[key]
        held = kept.attrs.get("units") if isinstance(kept, h5py.Dataset) else "a group"
        if (held is not None or self.units) and not (isinstance(held, str) and held == self.units):
            stated = "states no units" if held is None else f"is in {str(held)[:40]!r}"
            raise ValueError(f"{key} {stated}; give a dataset in {self.units!r}, and state it as its units")
        return _named(key, self.parsed, kept[()] if self.units else kept.asstr()[()])


def _named(key: str, parsed: Callable[[Any], Any], kept: Any) -> Any:
    """A value parsed; a refusal begins with its key."""
    try:
        return parsed(kept)
    except InputError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{key} {error}") from error


def numbers(units: str, dtype: npt.DTypeLike = np.float64) -> Field:
    """An array of numbers; one that a file holds as float32 is read as float64."""
    read_as = np.dtype(np.float64 if np.dtype(dtype).kind == "f" else dtype)

    def parsed(kept: Any) -> Any:
        held = np.asarray(kept)
        if held.dtype.kind not in ("iuf" if read_as.kind == "f" or not held.size else "iu"):
            raise TypeError(f"holds {held.dtype.name}, not numbers of type {read_as.name}")
        made = np.asarray(held, read_as)
        if read_as.kind != "f" and not np.array_equal(made, held):
            raise ValueError(f"holds a number that {read_as.name} does not")
        return made

    return Field(lambda value: np.asarray(value, dtype), parsed, units)


def number(units: str, dtype: npt.DTypeLike = np.float64) -> Field:
    """One number. JSON's stays as it is, so that its owner refuses a string by the field's name."""

    def parsed(kept: Any) -> Any:
        if not isinstance(kept, np.ndarray | np.generic):
            return kept
        if kept.shape or kept.dtype.kind not in ("iuf" if np.dtype(dtype).kind == "f" else "iu"):
            raise TypeError(f"holds {kept.dtype.name} of shape {kept.shape}, not one {np.dtype(dtype).name}")
        return kept.item()

    return Field(lambda value: np.asarray(value, dtype), parsed, units)


def shared(group: str, layout: Layout[Any]) -> Field:
    """An object that several measurements share, kept once as `/GROUP/NAME`."""

    def refuse(kept: Any) -> Any:
        raise TypeError(f"refers to {kept!r}, an object that is not here")

    return Field(lambda thing: {"name": thing.name, **layout.stored(thing)}, refuse, "", group, layout)


def text(kept: Any) -> str:
    """Text of a file.

    Raises:
        TypeError: it is something else.
        ValueError: it is no Unicode.
    """
    if isinstance(kept, bytes):
        return kept.decode()
    if not isinstance(kept, str):
        raise TypeError(f"is of type {type(kept).__name__}, not text")
    kept.encode()  # JSON can spell half of a character
    return str(kept)


def _words(kept: Any) -> tuple[str, ...]:
    if not isinstance(kept, list | tuple | np.ndarray) or np.ndim(kept) != 1:
        raise TypeError("is no list of words")
    return tuple(map(text, kept))


def _count(kept: Any) -> int:
    if isinstance(kept, bool | np.bool_):
        raise TypeError("is true or false, not a whole number")
    return operator.index(kept)


TEXT, COUNT, WORDS = Field(str, text), Field(int, _count), Field(list, _words)


class SharedObjects:
    """The shared objects of one file, each written or read once."""

    def __init__(self, file: h5py.File) -> None:
        self._file = file
        self._known: dict[tuple[str, str], Any] = {}

    def write(self, kept: Field, thing: Any) -> str:
        """The name of an object, which is written if it is new.

        Raises:
            InputError: another object has the same name, or the name is empty.
        """
        if not same(self._known.setdefault((kept.group, thing.name), thing), thing):
            raise InputError(f"two different {kept.group} are called {thing.name!r}; give each its own name.")
        place = self._file.require_group(kept.group)
        if link(thing.name) not in place and kept.layout is not None:
            kept.layout.write(place.create_group(link(thing.name)), thing)
        return str(thing.name)

    def read(self, kept: Field, name: str) -> Any:
        """The object of a name, the same one each time.

        Raises:
            KeyError: there is none.
        """
        if (kept.group, name) not in self._known and kept.layout is not None:
            place = self._file[kept.group][link(name)]
            self._known[kept.group, name] = kept.layout.read(place, name=name)
        return self._known[kept.group, name]


def link(name: str) -> str:
    """A name as one HDF5 link: no slash, and neither '.' nor '..', which HDF5 reads as paths.

    Raises:
        InputError: it is empty.
    """
    if not name:
        raise InputError("a camera, probe or other shared object has an empty name; name each.")
    return quote(name, safe=" ").replace(".", "%2E")


def same(first: Any, second: Any) -> bool:
    """Whether two objects of data classes agree in every field to the last bit."""
    if first is second:
        return True
    ours, theirs = vars(first), vars(second)
    return type(first) is type(second) and all(np.array_equal(ours[name], theirs[name]) for name in ours)


@dataclass(frozen=True)
class Layout(Generic[T]):
    """How objects of a type lie in a group of a file.

    Attributes:
        type: of the objects.
        fields: by the names of the type's own fields.
        optional: fields that may be missing in a file, and are left out where they are None or empty, each
            with the lowest schema version that knows it.
        keys: names in the file, of fields that are called otherwise there.
        make: the object of its fields; None for the type itself.
        within: the field of the type in which an object has the fields; "" for the type itself.
        about: the numbers in words, for files that people read and write.
    """

    type: type[T]
    fields: Mapping[str, Field]
    optional: Mapping[str, int] = field(default_factory=dict)
    keys: Mapping[str, str] = field(default_factory=dict)
    make: Callable[..., T] | None = None
    within: str = ""
    about: str = ""

    def write(self, group: h5py.Group, thing: T, objects: SharedObjects | None = None) -> None:
        """Write an object into an empty group; `objects` are needed where it refers to shared ones."""
        for key, kept, value in self._present(thing):
            if kept.layout is not None and objects is not None:
                group.attrs[key] = objects.write(kept, value)
            else:
                kept.write(group, key, value)

    def read(self, group: h5py.Group, objects: SharedObjects | None = None, **given: Any) -> T:
        """The object in a group; `given` are fields that are known already.

        Raises:
            KeyError: a field is missing.
            ValueError, TypeError: a field is of another form, in other units, or refused by the type.
        """

        def value(key: str, kept: Field) -> Any:
            if kept.layout is not None and objects is not None:
                return objects.read(kept, _named(key, text, group.attrs[key]))
            return kept.read(group, key)

        present = {*group, *group.attrs}
        if unknown := present - {self.key(name) for name in self.fields} - set(given) - {KIND}:
            raise ValueError(
                f"a {self.type.__name__} has no field {min(unknown)!r}; remove it, or correct its name"
            )
        return self._made(value, present, given)

    def tree(self, thing: T) -> dict[str, Any]:
        """The object as JSON has it."""
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in self.stored(thing).items()}

    def parsed(self, tree: Mapping[str, Any]) -> T:
        """The object of JSON; raises as `read` does."""
        return self._made(lambda key, kept: _named(key, kept.parsed, tree[key]), set(tree), {})

    def stored(self, thing: T) -> dict[str, Any]:
        """The values as a file holds them, by key: they are the same before and after an object was saved."""
        return {key: kept.stored(value) for key, kept, value in self._present(thing)}

    def version(self, thing: T) -> int:
        """The lowest schema version that holds an object."""
        stored = self.stored(thing)
        own = (since for name, since in self.optional.items() if self.key(name) in stored)
        referred = (k.layout.version(value) for _, k, value in self._present(thing) if k.layout is not None)
        return max([1, *own, *referred])

    @property
    def units(self) -> dict[str, str]:
        """Units by key."""
        return {self.key(name): kept.units for name, kept in self.fields.items() if kept.units}

    def key(self, name: str) -> str:
        """The name of a field in a file."""
        return self.keys.get(name, name)

    def _present(self, thing: T) -> Iterator[tuple[str, Field, Any]]:
        holder = getattr(thing, self.within) if self.within else thing
        for name, kept in self.fields.items():
            value = getattr(holder, name)
            empty = value is None or (isinstance(value, str | tuple) and not value)
            if not (empty and name in self.optional):
                yield self.key(name), kept, value

    def _made(self, value: Callable[[str, Field], Any], present: set[str], given: dict[str, Any]) -> T:
        for name, kept in self.fields.items():
            key = self.key(name)
            if key in present:
                given[name] = value(key, kept)
            elif name not in self.optional:
                raise KeyError(key)
        return (self.make or self.type)(**given)

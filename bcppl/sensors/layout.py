"""Layouts: how an object lies in a file, field by field, each with its units.

A layout writes a data class into a group of an HDF5 file and reads it again, does the same for JSON, and
lists the numbers as a file holds them, for fingerprints. A kind of measurement declares its fields once:

    PUSH = Layout(Push, {"times": Numbers("s"), "world_from_tip": Numbers(POSE_UNITS)})
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Generic, Protocol, TypeVar
from urllib.parse import quote

import h5py
import numpy as np
import numpy.typing as npt

from bcppl.errors import InputError

POSE_UNITS = "m m m 1 1 1 1"  # [x y z qw qx qy qz]
WRENCH_UNITS = "N N N N m N m N m"
STIFFNESS_UNITS = "N/m N/m N/m N m/rad N m/rad N m/rad"
DAMPING_UNITS = "N s/m N s/m N s/m N m s/rad N m s/rad N m s/rad"
SMALLEST_COMPRESSED = 256  # entries: below it gzip's chunk index outweighs what it saves

Array = npt.NDArray[np.float64]
T = TypeVar("T")


class SharedObjects:
    """Objects that a file holds once, as `/GROUP/NAME`, and that measurements refer to by name."""

    def __init__(self, file: h5py.File) -> None:
        self.file = file
        self._known: dict[tuple[str, str], Any] = {}

    def write(self, group: str, layout: Layout[Any], thing: Any) -> None:
        """Write an object, unless it is written already.

        Raises:
            InputError: another object of the same name is written already, or the name is empty.
        """
        known = self._known.setdefault((group, thing.name), thing)
        if not same(known, thing):
            raise InputError(f"two different {group} are both called {thing.name!r}; give each its own name.")
        place = self.file.require_group(group)
        if link(thing.name) not in place:
            layout.write(place.create_group(link(thing.name)), thing)

    def read(self, group: str, layout: Layout[Any], name: str) -> Any:
        """The object of a name, the same one each time.

        Raises:
            KeyError: there is none.
        """
        if (group, name) not in self._known:
            self._known[group, name] = layout.read(self.file[group][link(name)], name=name)
        return self._known[group, name]


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


class Field(Protocol):
    """How one field of an object is kept."""

    def write(self, group: h5py.Group, key: str, value: Any, shared: SharedObjects | None) -> None:
        """Write the value into a group."""

    def read(self, group: h5py.Group, key: str, shared: SharedObjects | None) -> Any:
        """The value in a group.

        Raises:
            KeyError: it is missing.
            ValueError, TypeError: it is of another form, or in other units.
        """

    def stored(self, value: Any) -> Any:
        """The value as the file holds it: an array, a string, a number, a list or a mapping of these."""

    def parsed(self, value: Any) -> Any:
        """The value of what JSON holds."""


@dataclass(frozen=True)
class Numbers:
    """An array of numbers, or with `scalar` one number: a dataset, its SI units in the attribute `units`."""

    units: str
    dtype: npt.DTypeLike = np.float64
    scalar: bool = False

    def write(self, group: h5py.Group, key: str, value: Any, shared: SharedObjects | None = None) -> None:
        """Write a dataset, compressed where that is worth it."""
        array = self.stored(value)
        compressed = array.size >= SMALLEST_COMPRESSED
        options: dict[str, Any] = {"compression": "gzip", "shuffle": True} if compressed else {}
        group.create_dataset(key, data=array, **options).attrs["units"] = self.units

    def read(self, group: h5py.Group, key: str, shared: SharedObjects | None = None) -> Any:
        """An array, every float as float64, or a number of Python's."""
        dataset = group[key]
        units = dataset.attrs.get("units", self.units) if isinstance(dataset, h5py.Dataset) else "a group"
        if units != self.units:
            raise ValueError(f"{key} is in {units!r}; give a dataset in {self.units!r}")
        array = self._array(dataset[()])
        return array.item() if self.scalar else array

    def stored(self, value: Any) -> npt.NDArray[Any]:
        """An array of the file's type."""
        return np.asarray(value, dtype=self.dtype)

    def parsed(self, value: Any) -> Any:
        """An array of lists. One number stays as it is, so that its owner refuses a wrong one by name."""
        return value if self.scalar else self._array(value)

    def _array(self, value: Any) -> npt.NDArray[Any]:
        return np.asarray(value, dtype=np.float64 if np.dtype(self.dtype).kind == "f" else self.dtype)


def number(units: str, dtype: npt.DTypeLike = np.float64) -> Numbers:
    """The field of one number."""
    return Numbers(units, dtype, scalar=True)


@dataclass(frozen=True)
class Attribute:
    """A string or a whole number: an attribute of the group."""

    type: Callable[[Any], Any] = str

    def write(self, group: h5py.Group, key: str, value: Any, shared: SharedObjects | None = None) -> None:
        """Write an attribute."""
        group.attrs[key] = value

    def read(self, group: h5py.Group, key: str, shared: SharedObjects | None = None) -> Any:
        """The attribute in a type of Python's."""
        return self.type(group.attrs[key])

    def stored(self, value: Any) -> Any:
        """The value itself."""
        return self.type(value)

    parsed = stored


@dataclass(frozen=True)
class Words:
    """A tuple of strings: a dataset, for an attribute holds 64 KiB at most."""

    def write(self, group: h5py.Group, key: str, value: Any, shared: SharedObjects | None = None) -> None:
        """Write a dataset of strings."""
        group.create_dataset(key, data=list(value), dtype=h5py.string_dtype())

    def read(self, group: h5py.Group, key: str, shared: SharedObjects | None = None) -> tuple[str, ...]:
        """The strings."""
        return tuple(str(word) for word in group[key].asstr()[()])

    def stored(self, value: Any) -> list[str]:
        """A list."""
        return list(value)

    def parsed(self, value: Any) -> tuple[Any, ...]:
        """A tuple."""
        return tuple(value)


@dataclass(frozen=True)
class Reference:
    """An object that measurements share: an attribute with its name, and the object once as `/GROUP/NAME`.

    Attributes:
        group: at the file's root.
        layout: of the object, all fields but its `name`.
    """

    group: str
    layout: Layout[Any]

    def write(self, group: h5py.Group, key: str, value: Any, shared: SharedObjects | None) -> None:
        """Write the name, and the object if it is not yet written."""
        assert shared is not None
        shared.write(self.group, self.layout, value)
        group.attrs[key] = value.name

    def read(self, group: h5py.Group, key: str, shared: SharedObjects | None) -> Any:
        """The object."""
        assert shared is not None
        return shared.read(self.group, self.layout, str(group.attrs[key]))

    def stored(self, value: Any) -> dict[str, Any]:
        """The object's name and fields."""
        return {"name": value.name, **self.layout.stored(value)}

    def parsed(self, value: Any) -> Any:
        """Refuses: JSON shares no objects."""
        raise TypeError(f"{value!r} refers to an object elsewhere")


@dataclass(frozen=True)
class Layout(Generic[T]):
    """How objects of a type lie in a group of a file.

    Attributes:
        type: of the objects.
        fields: by the names of the type's own fields.
        optional: fields that may be missing when they are read, and are left out where they are None or
            empty, each with the lowest schema version that knows it.
        keys: names in the file, of fields that are called otherwise there.
        holder: (a type, a field of `type`): the fields are those of an object of that type in that field.
        check: refuses what was read with an InputError.
        about: the numbers in words, for files that people read and write.
    """

    type: type[T]
    fields: Mapping[str, Field]
    optional: Mapping[str, int] = field(default_factory=dict)
    keys: Mapping[str, str] = field(default_factory=dict)
    holder: tuple[Callable[..., Any], str] | None = None
    check: Callable[[T], object] = lambda thing: None
    about: str = ""

    def write(self, group: h5py.Group, thing: T, shared: SharedObjects | None = None) -> None:
        """Write an object into an empty group."""
        for key, kept, value in self._present(thing):
            kept.write(group, key, value, shared)

    def read(self, group: h5py.Group, shared: SharedObjects | None = None, **given: Any) -> T:
        """The object in a group.

        Args:
            group: of the file.
            shared: of the same file; None where nothing is shared.
            given: fields that are known already.

        Raises:
            KeyError: a field is missing.
            ValueError, TypeError: a field is of another form, in other units, or refused by the type.
        """
        return self._made(
            given,
            lambda key: key in group or key in group.attrs,
            lambda key, kept: kept.read(group, key, shared),
        )

    def tree(self, thing: T) -> dict[str, Any]:
        """The object as JSON has it."""
        values = {key: kept.stored(value) for key, kept, value in self._present(thing)}
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}

    def parsed(self, tree: Mapping[str, Any]) -> T:
        """The object of JSON.

        Raises:
            KeyError: a field is missing.
            ValueError, TypeError: a field holds no numbers, or is refused by the type.
        """
        return self._made({}, tree.__contains__, lambda key, kept: kept.parsed(tree[key]))

    def stored(self, thing: T) -> dict[str, Any]:
        """The values as a file holds them, by key: what is written and read again has equal ones."""
        return {key: kept.stored(value) for key, kept, value in self._present(thing)}

    def version(self, thing: T) -> int:
        """The lowest schema version that holds an object."""
        present = {key for key, *_ in self._present(thing)}
        own = (since for name, since in self.optional.items() if self.key(name) in present)
        referred = (
            kept.layout.version(value)
            for _, kept, value in self._present(thing)
            if isinstance(kept, Reference)
        )
        return max([1, *own, *referred])

    @property
    def units(self) -> dict[str, str]:
        """Units by key, where there are any."""
        return {self.key(name): f.units for name, f in self.fields.items() if isinstance(f, Numbers)}

    def key(self, name: str) -> str:
        """The name in the file of a field."""
        return self.keys.get(name, name)

    def _present(self, thing: T) -> Iterator[tuple[str, Field, Any]]:
        held = thing if self.holder is None else attrgetter(self.holder[1])(thing)
        for name, kept in self.fields.items():
            value = getattr(held, name)
            empty = value is None or (isinstance(value, str | tuple) and not value)
            if not (empty and name in self.optional):
                yield self.key(name), kept, value

    def _made(
        self,
        given: dict[str, Any],
        present: Callable[[str], bool],
        value_of: Callable[[str, Field], Any],
    ) -> T:
        values = dict(given)
        for name, kept in self.fields.items():
            key = self.key(name)
            if present(key):
                values[name] = value_of(key, kept)
            elif name not in self.optional:
                raise KeyError(key)
        if self.holder is None:
            made = self.type(**values)
        else:
            made = self.type(**{self.holder[1]: self.holder[0](**values)})
        self.check(made)
        return made

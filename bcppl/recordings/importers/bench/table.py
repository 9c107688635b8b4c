"""Columns of numbers by name from the files that benches log: CSV, NumPy's .npy and .npz, Parquet."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np

from bcppl.arrays import Array
from bcppl.errors import InputError, reason_of
from bcppl.recordings.array_files import npy, npz
from bcppl.recordings.hdf5 import one_line

Names = Sequence[str | int]
_ELEMENT = re.compile(r"(.+)\[(\d+)\]")  # a column of an array (T, C): "wrench[3]"
_FEW_FIELDS = re.compile(r"invalid column index \d+ at row (\d+) with (\d+) columns")
_NO_NUMBER = re.compile(r"string '(.*)' to float64 at row (\d+)")
_DELIMITERS = (",", ";", "\t")
_BEFORE_NAMES = 20  # lines of comments at most


def read_columns(path: Path, names: Names) -> Array:
    """The columns (T, C) of a file, float64, in the order of their names.

    Args:
        path: a file that ends in .csv, .txt, .npy (structured), .npz or .parquet.
        names: of the columns; numbers count them from 0 in a file without names, and `name[k]` is column k of
            an array (T, C) of an .npz file or of a structured one.

    Raises:
        InputError: the file is missing or of another kind, lacks a column, or holds what is no number.
    """
    if not path.is_file():
        raise InputError(f"there is no file {path}; give its path relative to the configuration.")
    readers: dict[str, Callable[[Path, Names], Array]] = {
        ".csv": _csv, ".txt": _csv, ".npy": _npy, ".npz": _npz, ".parquet": _parquet,
    }  # fmt: skip
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path} ends in {path.suffix!r}; give a file that ends in {', '.join(readers)}.")
    table = reader(path, names)
    if len(table) < 2:
        raise InputError(f"{path} holds {len(table)} rows; give a log of two or more.")
    return table


def _csv(path: Path, names: Names) -> Array:
    """Numpy's reader: 10 million rows of seven columns in 5 s on one core."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [file.readline() for _ in range(_BEFORE_NAMES)]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as text ({error}); export it as CSV in UTF-8.") from error
    comments = [k for k, line in enumerate(lines) if line.startswith("#") or not line.strip()]
    first = next((k for k in range(len(lines)) if k not in comments), 0)
    delimiter = next((each for each in _DELIMITERS if each in lines[first]), None)
    cells = _cells(path, lines[first], delimiter)
    if all(map(is_number, cells)):
        # Names may stand in the last comment before the numbers, as numpy writes them.
        above = _cells(path, lines[first - 1].lstrip("# "), delimiter) if first else []
        known, skipped = (above if len(above) == len(cells) else []), first
    else:
        known, skipped = cells, first + 1
    row = next((line for line in lines[skipped:] if line.strip() and not line.startswith("#")), "")
    fields = _cells(path, row, delimiter) if row else cells
    if not _counts(fields) & _counts(cells):
        raise InputError(
            f"{path} has {len(cells)} fields in its first line and {len(fields)} in its first row; give each "
            "column a name, and write decimal points, not commas."
        )
    places = [_place(path, name, known, len(cells)) for name in names]
    try:
        with catch_warnings():
            simplefilter("ignore", UserWarning)  # that there is no row: a stream without one is refused
            table = np.loadtxt(
                path, delimiter=delimiter, skiprows=skipped, usecols=places, ndmin=2, quotechar='"',
                encoding="utf-8-sig",
            )  # fmt: skip
    except ValueError as error:
        cause = reason_of(error)
        remedy = _remedy(cause)
        raise InputError(f"{path} holds what is no number ({cause}); {remedy}.") from error
    return np.asarray(table, dtype=np.float64)


def _counts(cells: Sequence[str]) -> set[int]:
    """How many fields a line may have: a delimiter at its end may end the last or begin an empty one."""
    return {len(cells), len(cells) - (cells[-1:] == [""])}


def _remedy(cause: str) -> str:
    """What to do about text that numpy's reader names as no number."""
    if short := _FEW_FIELDS.search(cause):
        return f"line {short[1]} of the numbers ends after {short[2]}, as where a log is cut off: remove it"
    found = _NO_NUMBER.search(cause)
    text, row = (found[1].strip(), found[2]) if found else ("", "")
    if re.fullmatch(r"[-+]?\d*,\d+([eE][-+]?\d+)?", text):
        return "write decimal points, not commas"
    if re.match(r"\d{4}-\d\d-\d\d|\d+:\d\d", text):
        return "write times as numbers, such as seconds"
    if row == "0" and re.search("[^\\W\\d]", text):
        return "take out the line below the names, if it holds units"
    return "write nan where nothing was measured"


def _cells(path: Path, line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    try:
        line = line.strip(" \r\n")
        return [cell.strip() for row in csv.reader([line], delimiter=delimiter) for cell in row]
    except csv.Error as error:
        raise InputError(f"{path} is no table ({one_line(error)}); export it as CSV again.") from error


def is_number(cell: str) -> bool:
    """Whether text is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _place(path: Path, name: str | int, known: Sequence[str], count: int) -> int:
    if isinstance(name, int):
        if not 0 <= name < count:
            raise InputError(f"{path} has {count} columns, and none of the number {name}; count from 0.")
        return name
    if known.count(name) > 1:
        raise InputError(f"{path} has the column {name!r} twice; rename one, or give its number from 0.")
    if name not in known:
        raise InputError(_missing(path, name, known))
    return known.index(name)


def _missing(path: Path, name: str, known: Sequence[str]) -> str:
    if not known:
        return f"{path} has no names of columns; give {name!r} as its number from 0."
    close = get_close_matches(name, known, 1)
    meant = f"write {close[0]!r} if that is meant." if close else f"its columns are {', '.join(known)}."
    return f"{path} has no column {name!r}; {meant}"


def _npy(path: Path, names: Names) -> Array:
    try:
        array = npy(path)
    except Exception as error:  # numpy has errors of many types
        raise _unreadable(path, error) from error
    fields = array.dtype.names
    if fields is None:
        if array.ndim != 2:
            raise InputError(f"{path} holds an array {array.shape}; give rows (T, C) or a structured one.")
        return np.column_stack([_numbers(path, array[:, _place(path, n, [], array.shape[1])]) for n in names])
    return _by_name(path, names, list(fields), lambda name: array[name])


def _npz(path: Path, names: Names) -> Array:
    try:
        with npz(path) as arrays:
            return _by_name(path, names, list(arrays.files), lambda name: arrays[name])
    except InputError:
        raise
    except Exception as error:  # zip files and numpy have errors of many types
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> InputError:
    cause = one_line(error)
    return InputError(f"{path} holds no plain numbers ({cause}); save it again, without objects.")


def _parquet(path: Path, names: Names) -> Array:
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise InputError(
            f"{path} is a Parquet file, which needs pyarrow: pip install 'bcppl[bench]'; or export it as CSV."
        ) from error
    try:
        file = parquet.ParquetFile(path)
        known = list(file.schema_arrow.names)
        wanted = [known[_place(path, name, known, len(known))] for name in names]
        table = file.read(columns=list(dict.fromkeys(wanted)))
    except InputError:
        raise
    except Exception as error:  # Arrow's own classes
        raise InputError(f"{path} cannot be read as Parquet ({error}); export it again.") from error
    return _by_name(path, wanted, known, lambda name: table.column(name).to_numpy())


def _by_name(path: Path, names: Names, known: list[str], read: Callable[[str], Any]) -> Array:
    columns: list[Array] = []
    for name in names:
        element = None if str(name) in known else _ELEMENT.fullmatch(str(name))
        key = str(name) if element is None else element[1]
        if key not in known:
            raise InputError(_missing(path, key, known))
        values = np.asarray(read(key))
        if element is not None:
            if values.ndim != 2 or int(element[2]) >= values.shape[1]:
                raise InputError(f"{path} has {key!r} of shape {values.shape}, which has no column {name!r}.")
            values = values[:, int(element[2])]
        if values.ndim != 1:
            raise InputError(f"{path} has {key!r} of shape {values.shape}; name a column of it, '{key}[0]'.")
        columns.append(_numbers(path, values))
    if len({len(column) for column in columns}) > 1:
        raise InputError(f"{path} has columns of several lengths; give those of one stream.")
    return np.column_stack(columns)


def _numbers(path: Path, values: Any) -> Array:
    if values.dtype.kind not in "iuf":
        raise InputError(f"{path} has a column of type {values.dtype}; give numbers.")
    return np.asarray(values, dtype=np.float64)

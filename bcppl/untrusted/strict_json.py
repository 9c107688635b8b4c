"""JSON of files: no name twice, no number that is none, and no more of it than a reader can hold."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import Any, NoReturn

from bcppl.errors import InputError

LARGEST = 16 << 20  # bytes: Python holds JSON in up to twenty times as many


def read(path: Path, remedy: str, finite: bool = True) -> Any:
    """The content of a JSON file.

    Args:
        path: of the file.
        remedy: what to do where it is none: "write it again".
        finite: whether NaN and infinite numbers are refused; Python writes them, JSON has none.

    Raises:
        InputError: it is missing, larger than 16 MB, or no JSON, or an object has a name twice.
    """
    try:
        if path.stat().st_size > LARGEST:
            raise ValueError(f"it is larger than {LARGEST >> 20} MB")
        return parsed(path.read_text(encoding="utf-8"), finite)
    except OSError as error:
        raise InputError(f"{path} is missing or cannot be read ({error.strerror}); {remedy}.") from error
    except ValueError as error:
        raise InputError(f"{path} is no valid JSON ({error}); {remedy}.") from error


def parsed(text: str, finite: bool = True) -> Any:
    """The value of JSON text.

    Raises:
        ValueError: it is no JSON, is nested too deeply, or an object has a name twice.
    """
    constant, number = (_refused, _finite) if finite else (None, None)
    try:
        return json.loads(text, object_pairs_hook=_once, parse_constant=constant, parse_float=number)
    except RecursionError:
        raise ValueError("its lists or objects are nested too deeply") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        (name, _), *_ = Counter(name for name, _ in pairs).most_common(1)
        raise ValueError(f"the name {name[:40]!r} is given twice")
    return made


def _refused(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number of JSON")


def _finite(word: str) -> float:
    number = float(word)
    if not math.isfinite(number):
        raise ValueError(f"the number {word[:20]} is too large")
    return number

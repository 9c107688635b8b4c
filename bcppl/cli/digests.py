"""Digests of what a run was given by name: files may have changed since."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bcppl.errors import InputError


def digest(name: str) -> str:
    """Of a file's bytes, else of the version that has what is named: results of another one are others."""
    from importlib.metadata import version

    content = Path(name).read_bytes() if Path(name).is_file() else version("bcppl").encode()
    return hashlib.sha256(content).hexdigest()[:16]


def digests_of(names: Iterable[Any]) -> dict[str, str]:
    """By name, of those that are files."""
    return {name: digest(name) for name in names if isinstance(name, str) and Path(name).is_file()}


def refuse_changed(known: Mapping[str, Any], run: Path) -> None:
    """Refuse to go on with a run whose files, by name with their digests, are others now."""
    for name, before in known.items():
        if Path(name).is_file() and digest(name) != before:
            raise InputError(
                f"{name} has changed since the run in {run} was begun, so that its beliefs would not follow "
                "from those before; put it back, or begin another run."
            )

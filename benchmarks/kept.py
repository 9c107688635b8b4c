"""Results kept in a file as they are done: a later call evaluates only those that are missing."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any


def recorded(file: Path | None, key: Sequence[Any]) -> Any:
    """The result of a key, as JSON holds it; None where the file has none."""
    if file is not None and file.exists():
        asked = json.loads(json.dumps(key))
        for line in file.read_text(encoding="utf-8").splitlines():
            known, result = json.loads(line)
            if known == asked:
                return result
    return None


def added(file: Path | None, key: Sequence[Any], evaluate: Callable[[], Any]) -> Any:
    """The result of `evaluate`, added to the file under a key."""
    result = evaluate()
    keep(file, key, result)
    return result


def keep(file: Path | None, key: Sequence[Any], result: Any) -> None:
    """Add a result to the file under a key."""
    if file is not None:
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps([key, result]) + "\n")

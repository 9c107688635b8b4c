"""Importers: one file each, found by name, so that a new one is a new file and no other change.

A module here defines `NAME` (the word on the command line), `HELP` (one line), and a function
`command(...) -> Recording` whose parameters are annotated for typer. Importers keep their annotations as
objects (no `from __future__ import annotations`), so that a command line can extend the signature.
"""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType


def importers() -> dict[str, ModuleType]:
    """The importers by `NAME`, in alphabetical order."""
    found = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    return {module.NAME: module for module in sorted(found, key=lambda module: module.NAME)}

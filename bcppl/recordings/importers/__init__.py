"""Importers: one file each, found by name, so that a new one is a new file and no other change.

A module here, or a package, defines `NAME` (the word on the command line), `HELP` (one line), and a
function `command(...)` whose parameters are annotated for typer. It returns a `Recording`, or an `Imported`
that also reports how the data were read. Importers keep their annotations as objects (no
`from __future__ import annotations`), so that a command line can extend the signature.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from bcppl.sensors.measurements import Recording

# Of importers whose logs do not say what is what.
Configuration = Annotated[
    Path | None,
    typer.Argument(metavar="[CONFIG]", help="The configuration; without it, what the log holds is listed."),
]
Draft = Annotated[
    Path | None,
    typer.Option("--write", metavar="CONFIG", help="Write a configuration with guesses, to be edited."),
]


@dataclass(frozen=True, eq=False)
class Imported:
    """What an importer made of its data.

    Attributes:
        recording: of the data.
        report: lines on how they were read: rates, gaps, clocks, and what was assumed or left out.
    """

    recording: Recording
    report: Sequence[str] = ()


def importers() -> dict[str, ModuleType]:
    """The importers by `NAME`, in alphabetical order."""
    found = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    return {module.NAME: module for module in sorted(found, key=lambda module: module.NAME)}

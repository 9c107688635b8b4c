"""`bcppl new`: files to begin with, with comments, to be edited."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from bcppl.errors import InputError

new_app = typer.Typer(help="Write a file to begin with.", no_args_is_help=True)


@new_app.callback()
def _kinds() -> None: ...  # with one command alone, typer would leave out its name


@new_app.command("bench")
def bench(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The configuration to write.")] = Path(
        "bench.yaml"
    ),
) -> None:
    """Write the configuration of a robot bench's log, for `bcppl import bench`."""
    template = files("bcppl.recordings.importers.bench.configuration").joinpath("template.yaml")
    _write(file, template.read_text(encoding="utf-8"))
    print(f"wrote {file}: edit it, then bcppl import bench {file} -o recording.h5")


def _write(file: Path, text: str) -> None:
    """Write a text to a file that is not there yet.

    Raises:
        InputError: the file exists, or its folder does not.
    """
    if file.exists():
        raise InputError(f"{file} exists already; give another name, or remove it first.")
    if not file.parent.is_dir():
        raise InputError(f"there is no folder {file.parent} to write {file.name} into; make it first.")
    file.write_text(text, encoding="utf-8")

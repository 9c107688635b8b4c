"""`bcppl new`: files to begin with, with comments, to be edited."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from bcppl.errors import InputError

KINDS = {
    "model": "a generative program, for --model",
    "proposal": "an inference program with a proposal of its own, for --inference",
    "kernel": "an inference program with a kernel of its own, for --inference",
    "sensor": "a kind of measurement, for a model's file to import",
}

new_app = typer.Typer(help="Write a file to begin with.", no_args_is_help=True)


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


def _begun(kind: str) -> Callable[..., None]:
    def begin(
        name: Annotated[str, typer.Argument(metavar="NAME", help="Of the file, without .py.")],
    ) -> None:
        stem = name.removesuffix(".py")
        if not Path(stem).name.isidentifier():
            raise InputError(f"{name!r} is no name of a Python module; give letters, digits and underscores.")
        file, template = Path(f"{stem}.py"), files("bcppl.cli.templates").joinpath(f"{kind}.py")
        _write(file, template.read_text(encoding="utf-8").replace("NAME", Path(stem).name))
        print(f"wrote {file}: {KINDS[kind]}; its first lines say how it is used")

    return begin


for _kind, _what in KINDS.items():
    new_app.command(_kind, help=f"Write {_what}, to be edited.")(_begun(_kind))


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

"""`bcppl check`, `bcppl import` and `bcppl simulate`: recordings in and out."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from bcppl.cli import loading
from bcppl.errors import InputError
from bcppl.recordings import Recording, describe, notes, problems, save, validate
from bcppl.recordings.importers import importers

OUT = Annotated[Path, typer.Option("--out", "-o", help="The recording to write (.h5).")]


def check(
    recording: Annotated[str, typer.Argument(help="A recording (.h5), or the name of a shipped one.")],
) -> None:
    """Say what a recording holds, and what is wrong with it (exit code 2 if anything is)."""
    found = loading.unchecked_recording(recording)
    console = Console()
    table = Table(show_header=False, box=None, pad_edge=False)
    for what, value in describe(found):
        table.add_row(f"[bold]{what}[/bold]", value)
    console.print(table)
    for note in notes(found):
        console.print(f"[yellow]note:[/yellow] {note}", highlight=False)
    wrong = problems(found)
    for problem in wrong:
        console.print(f"[red]wrong:[/red] {problem}", highlight=False)
    if wrong:
        raise typer.Exit(2)
    console.print("[green]nothing wrong was found.[/green]")


def simulate(
    model: Annotated[str, typer.Argument(help="A model's name, or a file.")] = "peg_in_hole",
    out: OUT = Path("recording.h5"),
    seed: Annotated[int, typer.Option(help="Same seed, same recording.")] = 0,
) -> None:
    """Write a recording that a model's own world makes up: a true pose from the prior, and noisy sensors."""
    loading.refuse_seed(seed)
    chosen = loading.model(model)
    if chosen.simulate_recording is None:
        raise InputError(
            f"model {model!r} simulates no recordings; these do: {', '.join(loading.simulating())}. "
            "A model of your own does once it has a `simulate_recording(seed)`."
        )
    _write(chosen.simulate_recording(seed), out)


import_app = typer.Typer(help="Make a recording from data in another format.", no_args_is_help=True)


def _write(recording: Recording, out: Path) -> None:
    validate(recording)
    if not out.parent.is_dir():
        raise InputError(f"there is no folder {out.parent} to write {out.name} into; make it first.")
    if out.is_dir():
        raise InputError(f"{out} is a folder; give the name of a file to write.")
    save(recording, out)
    Console().print(f"wrote {out}: {dict(describe(recording))['measurements']}", highlight=False)


def _importing(command: Callable[..., Recording]) -> Callable[..., None]:
    """The command of an importer with `--out` added, its other options as the importer declares them."""

    @functools.wraps(command)
    def importing(*, out: Path, **options: Any) -> None:
        loading.refuse_seed(options.get("seed", 0))
        _write(command(**options), out)

    wrapped: Any = importing
    signature = inspect.signature(command)
    added = inspect.Parameter(
        "out", inspect.Parameter.KEYWORD_ONLY, annotation=OUT, default=Path("recording.h5")
    )
    parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in signature.parameters.values()]
    wrapped.__signature__ = signature.replace(parameters=[*parameters, added], return_annotation=None)
    wrapped.__annotations__ = {p.name: p.annotation for p in [*parameters, added]}
    return wrapped


for _name, _module in importers().items():
    import_app.command(_name, help=_module.HELP)(_importing(_module.command))

"""`bcppl check`, `bcppl import` and `bcppl simulate`: recordings in and out."""

from __future__ import annotations

import functools
import inspect
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from bcppl.arguments import LARGEST_SEED
from bcppl.cli.options import AsJson, Recorded
from bcppl.cli.outputs import refuse_overwriting
from bcppl.errors import InputError
from bcppl.untrusted.visible_text import visible

if TYPE_CHECKING:
    from bcppl.recordings import Recording
    from bcppl.recordings.importers import Imported

UNNAMED = Path("recording.h5")
OUT = Annotated[
    Path | None,
    typer.Option("--out", "-o", dir_okay=False, help=f"The recording to write; {UNNAMED} unless given."),
]


def check(
    recording: Recorded,
    as_json: AsJson = False,
) -> None:
    """Describe a recording and list its problems (exit code 2 if there are any), notes and doubts.

    A doubt is what probably is wrong: it is well formed, but does not fit the part within the guess.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from bcppl.models.shipped import load_recording
    from bcppl.recordings import describe, notes, problems
    from bcppl.recordings.file import is_checked
    from bcppl.sensors.plausibility import doubts

    loaded = load_recording(recording)
    wrong = problems(loaded)
    described, remarks, doubted = (_made(each, loaded, wrong) for each in (describe, notes, doubts))
    if Path(recording).is_file() and not is_checked(recording):
        remarks.append("the file has no checksum, so a changed number goes unnoticed: save it again for one.")
    console = Console(stderr=as_json)
    table = Table(show_header=False, box=None, pad_edge=False)
    for what, value in described:
        table.add_row(f"[bold]{escape(visible(what))}[/bold]", escape(visible(value)))
    console.print(table)
    for word, colour, lines in (
        ("note", "yellow", remarks), ("doubt", "yellow", doubted), ("wrong", "red", wrong),
    ):  # fmt: skip
        for line in lines:
            console.print(f"[{colour}]{word}:[/{colour}] {escape(visible(line))}", highlight=False)
    if as_json:
        listed = {"description": dict(described), "notes": remarks, "doubts": doubted, "problems": wrong}
        print(json.dumps(listed))
    if wrong:
        raise typer.Exit(2)
    if doubted:
        console.print(f"[yellow]no problem, but {len(doubted)} doubt{'s'[: len(doubted) > 1]}.[/yellow]")
        return
    console.print("[green]no problem.[/green]")


def _made(make: Callable[[Recording], list[Any]], recording: Recording, wrong: Sequence[str]) -> list[Any]:
    """What is made of a recording, or nothing where its problems prevent that: these are listed instead."""
    try:
        return make(recording)
    except Exception:
        if not wrong:
            raise
        return []


def simulate(
    model: Annotated[str, typer.Argument(help="A model's name, or a file.")] = "peg_in_hole",
    out: OUT = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Same seed, same recording.")] = 0,
) -> None:
    """Write a recording that a model's own world simulates: a true pose from the prior, and noisy sensors."""
    from bcppl.cli import loading

    chosen = loading.model(model)
    if chosen.simulate_recording is None:
        raise InputError(
            f"model {model!r} simulates no recordings; these do: {', '.join(loading.simulating())}. "
            "A model of your own does once it has a `simulate_recording(seed)`."
        )
    out = _writable(out)
    _write(chosen.simulate_recording(seed), out)


def _write(recording: Recording, out: Path) -> None:
    from rich.console import Console

    from bcppl.recordings import describe, save, validate

    validate(recording)
    save(recording, out)
    written = f"wrote {out}: {dict(describe(recording))['measurements']}"
    Console().print(visible(written), highlight=False, markup=False)


def _writable(out: Path | None, *read: Path) -> Path:
    """Where to write a recording: not over what is read or is none, such as a log, nor over one unasked."""
    import h5py

    if out is None:
        others = (UNNAMED.with_stem(f"{UNNAMED.stem}_{number}") for number in itertools.count(2))
        out = next(name for name in itertools.chain([UNNAMED], others) if not name.exists())
    refuse_overwriting("--out", out, *read)
    if out.is_file() and out.stat().st_size and not h5py.is_hdf5(out):
        raise InputError(f"--out would overwrite {out}, which is no recording; give another name.")
    return out


class Importers(TyperGroup):
    """One command for each importer; they are imported when `bcppl import` is called."""

    def list_commands(self, ctx: Any) -> list[str]:
        """The importers' names."""
        return list(_commands())

    def get_command(self, ctx: Any, name: str) -> Any:
        """The command of an importer."""
        return _commands().get(name)


import_app = typer.Typer(cls=Importers, help="Make a recording from data in another format.")


@functools.cache
def _commands() -> dict[str, Any]:
    from bcppl.recordings.importers import importers

    commands = {}
    for name, module in importers().items():
        app = typer.Typer(add_completion=False)
        app.command(name, help=module.HELP)(_importing(module.command))
        commands[name] = typer.main.get_command(app)
    return commands


def _importing(command: Callable[..., Recording | Imported]) -> Callable[..., None]:
    """The command of an importer with `--out` added, its other options as the importer declares them.

    The report is printed before the recording is checked, for it often says why that fails.
    """

    @functools.wraps(command)
    def importing(*, out: Path | None, **options: Any) -> None:
        from rich.console import Console

        from bcppl.recordings.importers import Imported

        out = _writable(out, *(each for each in options.values() if isinstance(each, Path)))
        made = command(**options)
        imported = made if isinstance(made, Imported) else Imported(made)
        for line in imported.report:
            Console().print(visible(line), highlight=False, markup=False, soft_wrap=True)
        _write(imported.recording, out)

    wrapped: Any = importing
    signature = inspect.signature(command)
    added = inspect.Parameter("out", inspect.Parameter.KEYWORD_ONLY, annotation=OUT, default=None)
    parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in signature.parameters.values()]
    wrapped.__signature__ = signature.replace(parameters=[*parameters, added], return_annotation=None)
    wrapped.__annotations__ = {p.name: p.annotation for p in [*parameters, added]}
    return wrapped

"""`bcppl view`: a run, or a recording, as a page in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bcppl.cli.options import Arm, Link, LinkFromPeg, WorldFromBase
from bcppl.cli.outputs import files_of_run, refuse_overwriting
from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.robot.arm_with_peg import ArmWithPeg
    from bcppl.viewer import Page

PAGE = "view.html"


def view(
    run: Annotated[
        str, typer.Argument(help="The folder of a run, or a recording (.h5, or the name of a shipped one).")
    ],
    save: Annotated[
        Path | None,
        typer.Option("--save", dir_okay=False, help="Write the page to this file, and do not open it."),
    ] = None,
    of: Annotated[
        str | None, typer.Option(help="The run's recording, where it is no longer where it was run.")
    ] = None,
    robot: Arm = None,
    link: Link = None,
    link_from_peg: LinkFromPeg = None,
    world_from_base: WorldFromBase = None,
) -> None:
    """Show part, peg, cameras, particles and measurements, step by step, on a page that needs no network."""
    import webbrowser

    from bcppl.cli.arm import arm_with_peg

    folder, arm = Path(run), arm_with_peg(robot, link, link_from_peg, world_from_base)
    if folder.is_dir():
        page, place = of_run(folder, of, arm), folder / PAGE
    else:
        if of is not None:
            raise InputError(f"--of names a run's recording, but {run} is no folder of a run; leave it out.")
        page, place = of_recording(run, arm), Path(f"{folder.stem}.{PAGE}")
    place = save or place
    refuse_overwriting("--save", place, run, of, *files_of_run(run))
    page.save(place)
    print(f"wrote {place}: {page.steps} steps, {len(page.text) / 1e6:.1f} MB; it needs no other file.")
    if save is None and not webbrowser.open(place.resolve().as_uri()):
        print("no browser can be opened here: open the file in one.")


def of_recording(name: str, arm: ArmWithPeg | None = None) -> Page:
    """The page of a recording without a belief.

    Raises:
        InputError: there is no such recording, or it has problems.
    """
    from bcppl.cli import loading
    from bcppl.viewer import view

    return view(loading.recording(name), title=name, arm=arm)


def of_run(folder: Path, of: str | None = None, arm: ArmWithPeg | None = None) -> Page:
    """The page of the run in a folder, up to its newest belief.

    Args:
        folder: that `bcppl run` wrote.
        of: the recording; by default the one that run.json names.
        arm: that holds the peg.

    Raises:
        InputError: the folder holds no run, or one of an earlier version; beliefs are missing, or are of
            another recording than the one that is there.
    """
    from bcppl.cli import loading
    from bcppl.cli.run_folder import RECORD, belief_name, read_record
    from bcppl.recordings.beliefs import load_belief, load_fingerprint, load_label
    from bcppl.recordings.fingerprint import is_of
    from bcppl.viewer import view

    record = read_record(folder)
    name = of or record["recording"]
    try:
        recording = loading.recording(name)
    except InputError as error:
        if of is not None:
            raise
        what = f"the recording {name!r} that {folder / RECORD} names cannot be read ({error})"
        raise InputError(f"{what.replace('.)', ')')}; give it with --of RECORDING.") from error
    rows = [{str(k): str(v) for k, v in row.items()} for row in record["rows"] if isinstance(row, dict)]
    if not rows or len(rows) != len(record["rows"]):
        raise InputError(f"the run in {folder} has no step to show; run the recording again.")
    history = []
    for number in range(len(rows)):
        file = folder / belief_name(number)
        if not file.is_file():
            raise InputError(
                f"{folder} has no {file.name}, which holds the particles after step {number}; run the "
                "recording again, or view the recording alone."
            )
        if number <= len(recording.measurements) and not is_of(load_fingerprint(file), recording, number):
            raise InputError(
                f"{file} is of another recording than {name}: part, guess or measurements differ; give the "
                "one that was run with --of."
            )
        history.append((load_label(file), load_belief(file)))
    notes = _notes(folder, record, len(rows) - 1)
    return view(recording, history, rows, title=name, facts=_facts(record), notes=notes, arm=arm)


def _facts(record: dict[str, Any]) -> dict[str, object]:
    settings = " ".join(f"{name}={value}" for name, value in record["settings"].items())
    named = {name: record[name] for name in ("model", "inference", "seed")}
    return {**named, "settings": settings, "bcppl": record.get("version", "")}


def _notes(folder: Path, record: dict[str, Any], taken: int) -> list[str]:
    notes = [str(each) for name in ("doubts", "warnings") for each in record.get(name) or []]
    if not record.get("complete"):
        stopped = f"The run has not been completed, {taken} measurements are shown"
        notes.insert(0, f"{stopped}: go on with it by `bcppl run --resume {folder}`.")
    return notes

"""`bcppl run`: the posterior of a part's pose after each measurement of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bcppl.arguments import LARGEST_SEED
from bcppl.cli.setting_option import Settings
from bcppl.errors import InputError

if TYPE_CHECKING:
    from bcppl.recordings import Recording

FEWEST = 20  # particles, below which a run warns


def run(
    recording: Annotated[str, typer.Argument(help="A recording (.h5), or the name of a shipped one.")],
    model: Annotated[
        str | None, typer.Option(help="A model's name or file; by default the one the recording names.")
    ] = None,
    inference: Annotated[
        str | None,
        typer.Option(help="An inference program's name or file; by default the one that the model names."),
    ] = None,
    particles: Annotated[int, typer.Option(min=2, help="How many particles.")] = 75,
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="Same seed, same belief, bit for bit.")
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option(file_okay=False, help="Folder for beliefs and figures; runs/RECORDING by default."),
    ] = None,
    set_: Settings = None,
    explain: Annotated[
        bool,
        typer.Option(help="Compare by evidence what could be wrong with the touches; takes about a minute."),
    ] = False,
) -> None:
    """Estimate the part's pose: a row per measurement, the posterior, and a folder of beliefs and figures."""
    from rich.console import Console

    from bcppl.cli import loading
    from bcppl.cli.report import Report
    from bcppl.cli.run_folder import RunFolder
    from bcppl.inference.progress import sole_bar

    measured = loading.recording(recording)
    given = loading.settings(set_ or [])
    chosen = loading.with_settings(loading.model(model, measured.model), given, model or measured.model)
    inference, infer = loading.inference(inference, chosen)
    path = out or Path("runs") / Path(recording).stem
    blocked = next((p for p in (path, *path.parents) if p.exists() and not p.is_dir()), None)
    if blocked is not None:
        raise InputError(f"--out {path} cannot be made, {blocked} is a file; give a folder.")
    settings = {
        "recording": recording,
        "model": model or measured.model,
        "inference": inference,
        "particles": particles,
        "seed": seed,
        "settings": given,
    }
    scene = chosen.prepare(measured)
    chosen.observe(scene, measured.measurements)  # refuses what cannot be read before anything is written
    console = Console(highlight=False)
    if particles < FEWEST:
        console.print(
            f"--particles is {particles}: so few tend to collapse on a wrong pose and be sure of it; "
            "75 is a good start.",
            style="yellow",
        )
    report, folder = Report(console, measured, chosen), RunFolder(path, measured, settings)
    try:
        with sole_bar(console) as progress:
            task = progress.add_task("prior", total=len(measured.measurements))
            steps = infer(chosen, measured, particles=particles, seed=seed, scene=scene)
            for count, step in enumerate(steps):
                folder.add(step, report.row(step))
                progress.update(task, completed=count, description=next_label(measured, count + 1))
    finally:
        # Whatever stopped the run, what was computed is shown and kept.
        if report.steps:
            folder.note(warnings=report.finish(), relative_to_peg=report.relative_deviations())
            folder.draw(report.steps)
            console.print(f"beliefs and figures are in {path}")
    if explain:
        folder.note(explanations=[each._asdict() for each in report.explain()])


def next_label(recording: Recording, count: int) -> str:
    """The label of the measurement that is assimilated after so many steps, as the table names it."""
    last = min(count, len(recording.measurements))
    return f"{recording.measurements[last - 1].kind} {last}"

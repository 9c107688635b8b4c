"""`bcppl run`: the posterior of a part's pose after each measurement of a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from warnings import catch_warnings, simplefilter

import typer

from bcppl.arguments import LARGEST_SEED
from bcppl.cli.options import AsJson, Settings
from bcppl.errors import InputError
from bcppl.untrusted.visible_text import visible

if TYPE_CHECKING:
    from bcppl.recordings import Recording

FEWEST = 20  # particles, below which a run warns
HERE = "cpu"
OF_THE_RUN = ("particles", "seed", "device", "out", "set_")  # what a run that is resumed has from its folder


def run(
    context: typer.Context,
    recording: Annotated[
        str | None, typer.Argument(help="A recording (.h5), or the name of a shipped one.")
    ] = None,
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
    device: Annotated[str, typer.Option(help="Where the particles are: cpu, or cuda for a GPU.")] = HERE,
    out: Annotated[
        Path | None,
        typer.Option(
            file_okay=False,
            help="Folder for beliefs and figures; runs/RECORDING by default, or the next one that is free.",
        ),
    ] = None,
    set_: Settings = None,
    explain: Annotated[
        bool,
        typer.Option(help="Compare by evidence what could be wrong with the touches; takes about a minute."),
    ] = False,
    resume: Annotated[
        Path | None,
        typer.Option(
            file_okay=False, help="The folder of a run that was stopped: go on with it, to the same bits."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Estimate the part's pose: a row per measurement, the posterior, and a folder of beliefs and figures."""
    from rich.console import Console

    from bcppl.cli import loading
    from bcppl.cli.digests import digests_of, refuse_changed
    from bcppl.cli.predictive_checks import PredictiveChecks
    from bcppl.cli.report import Report
    from bcppl.cli.run_folder import PAGE, STEP, RunFolder, beside, read_record
    from bcppl.devices import HOST, device_named
    from bcppl.inference.progress import sole_bar
    from bcppl.inference.saved import load_step
    from bcppl.sensors.plausibility import doubts

    record: dict[str, Any] = {}
    if resume is not None:
        record = read_record(resume)
        given = [name for name in OF_THE_RUN if _is_given(context, name)]
        if given:
            option = given[0].strip("_")
            raise InputError(
                f"--{option} is that of the run in {resume}; leave it out, or begin another run."
            )
        for option, other in (("model", model), ("inference", inference)):
            if other is not None and Path(other).name != Path(record[option]).name:
                raise InputError(
                    f"--{option} is {other!r}, and the run in {resume} has {record[option]!r}; give that "
                    "one, or begin another run."
                )
        record["recording"] = recording = recording or record["recording"]
        particles, seed = record["particles"], record["seed"]
        device = record["device"]
        refuse_changed(record.get("files", {}), resume)
    if recording is None:
        raise InputError("there is nothing to run; give a recording, or the folder of a run by --resume.")
    with catch_warnings(record=True) as warned:
        simplefilter("always")
        measured = loading.recording(recording, model)
    settings = record.get("settings") or loading.settings(set_ or [])
    named, by = record.get("model", measured.model), f"the run in {resume}" if record else "the recording"
    chosen = loading.with_settings(loading.model(model, named, by), settings, model or named)
    inference, infer = loading.inference(inference, chosen, record.get("inference", ""), by)
    scene = chosen.prepare(measured)
    chosen.observe(scene, measured.measurements)  # refuses what cannot be read before anything is written
    console = Console(highlight=False, stderr=as_json)
    if particles < FEWEST:
        console.print(
            f"--particles is {particles}: so few tend to collapse on a wrong pose and be sure of it; "
            "75 is a good start.",
            style="yellow",
        )
    kept = record.get("doubts")
    read = [str(each.message) for each in warned if issubclass(each.category, RuntimeWarning)]
    doubted = [str(doubt) for doubt in kept] if isinstance(kept, list) else [*read, *doubts(measured)]
    for doubt in doubted:
        console.print(f"doubt: {visible(doubt)}", style="yellow", markup=False)
    report = Report(console, measured, chosen)
    options: dict[str, Any] = {"particles": particles, "seed": seed, "scene": scene}
    if device != HERE:
        options["device"] = device_named(device)
        loading.check_takes(infer, "device", f"{inference} runs on the processor only", "leave out --device")
    if resume is not None and (resume / STEP).exists():
        loading.check_takes(infer, "start", f"{inference} cannot go on with a run", "run the recording again")
        start = options["start"] = load_step(resume / STEP, chosen, measured, scene)
        folder = RunFolder.resumed(resume, record, measured, start.taken)
        sites = start.population.trace.addresses
        checks = PredictiveChecks.resumed(record["checked"], folder.history, sites)
        report.resume(start, folder.rows, checks)
    else:
        path = resume or out or beside(Path("runs") / Path(recording).stem)
        folder = RunFolder(
            path,
            measured,
            {
                "recording": recording,
                "model": model or named,
                "inference": inference,
                "particles": particles,
                "seed": seed,
                "device": device,
                "settings": settings,
                "files": digests_of([model or named, inference, *settings.values()]),
                "doubts": doubted,
            },
            begun=resume is not None,
        )
    try:
        with sole_bar(console) as progress:
            total = len(measured.measurements)
            task = progress.add_task(next_label(measured, report.rows), total=total, completed=report.rows)
            for made in infer(chosen, measured, **options):
                step = made if device == HERE else replace(made, population=made.population.on(HOST))
                folder.add(step, report.row(step), report.checks.labels)
                progress.update(
                    task, completed=report.rows - 1, description=next_label(measured, report.rows)
                )
    finally:
        # Whatever stopped the run, what was computed is shown and kept.
        if not folder.history:
            if resume is None:
                folder.discard()
        else:
            folder.note(
                warnings=report.finish(),
                relative_to_peg=report.relative_deviations(),
                complete=report.is_complete,
            )
            try:
                folder.draw()
            finally:
                folder.write_page(report.conclusion, report.steps[-1])
            where = f"beliefs and figures are in {folder.path}, all on one page in {PAGE}"
            console.print(where, markup=False)
    if explain:
        folder.note(explanations=[each._asdict() for each in report.explain()])
    if as_json:
        print(folder.text)


def next_label(recording: Recording, count: int) -> str:
    """The label of the measurement that is assimilated after so many steps, as the table names it."""
    last = min(count, len(recording.measurements))
    return f"{recording.measurements[last - 1].kind} {last}"


def _is_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"

"""`bcppl live` and `bcppl serve`: a belief that follows measurements while they are made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bcppl.arguments import LARGEST_SEED
from bcppl.cli.interrupts import ended_like_an_interrupt
from bcppl.cli.options import (
    Arm,
    Force,
    InferenceName,
    Link,
    LinkFromPeg,
    ModelName,
    Recorded,
    Settings,
    TableHeight,
    WorldFromBase,
)
from bcppl.cli.outputs import refuse_overwriting
from bcppl.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from rich.console import Console

    from bcppl.inference.filters.smc import Step
    from bcppl.inference.live import UpdateInfo
    from bcppl.inference.live.server import Server
    from bcppl.recordings import Recording
    from bcppl.traces import Model
    from bcppl.viewer import LivePage

PARTICLES = Annotated[int, typer.Option(min=2, help="How many particles.")]
SEED = Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Of inference.")]
DEADLINE = Annotated[
    float,
    typer.Option(
        min=0.001, help="s; where updates take longer, windows are joined, then particles are fewer."
    ),
]
VIEW = Annotated[
    bool, typer.Option("--view", help="Show part, particles and measurements on a page that follows.")
]
RECORDING, BELIEF, ARRIVED = "recording.h5", "belief.h5", "arrived.h5"  # what `serve` keeps
SOON = 10.0  # s within which a browser asks for a page


def live(
    recording: Recorded,
    speed: Annotated[float, typer.Option(min=0.01, help="2 plays twice as fast as it was recorded.")] = 1.0,
    model: ModelName = None,
    inference: InferenceName = None,
    particles: PARTICLES = 75,
    seed: SEED = 0,
    deadline: DEADLINE = 0.5,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", dir_okay=False, help="File for the last belief (.h5).")
    ] = None,
    view: VIEW = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", dir_okay=False, help="Write the page to this file at the end (.html)."),
    ] = None,
    robot: Arm = None,
    link: Link = None,
    link_from_peg: LinkFromPeg = None,
    world_from_base: WorldFromBase = None,
    set_: Settings = None,
) -> None:
    """Play a recording as if it were being made, and follow it: how late each update was, and the belief."""
    from rich.console import Console

    from bcppl.cli.arm import arm_with_peg
    from bcppl.cli.report import Report
    from bcppl.inference.live import Filter, play

    for option, file in (("--out", out), ("--save", save)):
        if file is not None:
            refuse_overwriting(option, file, recording)
    if robot is not None and not (view or save):
        raise InputError("--robot is drawn on a page; add --view or --save.")
    arm = arm_with_peg(robot, link, link_from_peg, world_from_base)
    console = Console(highlight=False)
    measured, chosen, infer = _chosen(recording, model, inference, set_)
    report = Report(console, measured, chosen)
    empty, interrupted = replace(measured, measurements=[]), False

    def shown(step: Step, update: UpdateInfo) -> None:
        if not update.fault:
            report.row(step)

    settings: dict[str, Any] = {"particles": particles, "seed": seed, "deadline": deadline}
    failed: Exception | None = None
    with (
        ended_like_an_interrupt(),
        Filter(chosen, empty, infer=infer, on_update=shown, **settings) as following,
    ):
        page = following.view(recording, arm) if view or save else None
        asked = view and page is not None and _asked(page, console)
        report.row(following.step)
        try:
            for measurement in play(measured, speed):
                following.observe(measurement.action, measurement.observation)
        except KeyboardInterrupt:
            interrupted = True
            console.print("interrupted; what has been measured is kept", style="yellow")
        try:
            last = following.settle()
        except KeyboardInterrupt:
            interrupted, last = True, following.step
            console.print(f"interrupted; {following.behind} measurements are not assimilated", style="yellow")
        except Exception as error:  # what was assimilated before it is shown and kept
            failed, last = error, following.step
        report.recording = following.recording
        report.finish()
        console.print(lateness(following.updates, deadline))
        if page is not None and asked:
            page.opened(SOON)
    if page is not None and save is not None:
        page.page().save(save)
        console.print(f"the page is in {save}", markup=False)
    if out is not None:
        _save(last, following.recording, out)
        console.print(f"the belief is in {out}", markup=False)
    if failed is not None:
        raise failed
    if interrupted:
        raise KeyboardInterrupt


def _save(last: Step, recording: Recording, out: Path) -> None:
    from bcppl.cli import latent_sites
    from bcppl.recordings.beliefs import save_belief
    from bcppl.recordings.fingerprint import fingerprint

    save_belief(
        last.belief,
        out,
        label=last.info.label,
        log_evidence=last.info.log_evidence,
        random_state=last.random_state,
        latent=latent_sites.values_of(last),
        of=fingerprint(recording, last.taken),
    )


def _asked(page: LivePage, console: Console) -> bool:
    """Whether a browser has been asked for a page."""
    import webbrowser

    console.print(f"follow at {page.url}", markup=False, soft_wrap=True)
    return webbrowser.open(page.url)


def lateness(updates: Sequence[UpdateInfo], deadline: float) -> str:
    """How late updates were, in a sentence."""
    late = sorted(update.seconds for update in updates if not update.fault)
    if not late:
        return "there was no update."
    within = sum(seconds <= deadline for seconds in late)
    joined = sum(update.joined - 1 for update in updates)
    fewest = min(update.particles for update in updates)
    return (
        f"{within} of {len(late)} updates were done within {deadline:g} s of their measurement "
        f"(95 %: {late[int(0.95 * (len(late) - 1))]:.2f} s, the latest: {late[-1]:.2f} s); {joined} windows "
        f"were joined with others, {fewest} particles were the fewest."
    )


def serve(
    scene: Annotated[
        str, typer.Argument(help="A recording with part, guess and peg; its measurements come first.")
    ],
    host: Annotated[
        str, typer.Option(help="127.0.0.1 is reached from this machine alone; others see what is sent.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 for one that is free.")] = 0,
    token: Annotated[
        str | None,
        typer.Option(envvar="BCPPL_TOKEN", help="What clients have to know; a new one by default."),
    ] = None,
    model: ModelName = None,
    inference: InferenceName = None,
    particles: PARTICLES = 75,
    seed: SEED = 0,
    deadline: DEADLINE = 0.5,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            file_okay=False,
            help="Folder for the last belief and its recording, at the end, and for all that arrived.",
        ),
    ] = None,
    view: VIEW = False,
    table: TableHeight = None,
    force: Force = None,
    set_: Settings = None,
) -> None:
    """Serve a live belief on a socket, in MessagePack (see docs/live.md), until it is interrupted."""
    import asyncio
    from importlib.util import find_spec

    from rich.console import Console

    if find_spec("msgpack") is None:
        raise InputError("bcppl serve needs msgpack; pip install 'bcppl[serve]'.")
    from bcppl.cli import candidates
    from bcppl.inference.live import Filter
    from bcppl.inference.live.server import Server
    from bcppl.inference.live.session import Session
    from bcppl.recordings import save

    if out is not None:
        for name in (RECORDING, BELIEF, ARRIVED):
            if (out / name).exists():
                raise InputError(f"--out {out} has a {name} already; give another folder.")
        out.mkdir(parents=True, exist_ok=True)
    console = Console(highlight=False)
    measured, chosen, infer = _chosen(scene, model, inference, set_, begun=False)
    limits = [*candidates.off_table(table, measured.peg), *candidates.constraints(force)]
    settings: dict[str, Any] = {"particles": particles, "seed": seed, "deadline": deadline}
    with (
        ended_like_an_interrupt(),
        Filter(chosen, measured, infer=infer, constraints=limits, **settings) as following,
    ):
        if view:
            _asked(following.view(scene), console)
        server = Server(Session(following), host, port, token)
        try:
            asyncio.run(_serving(server, console))
        finally:
            if out is not None:
                try:
                    following.settle()
                finally:  # whatever ended the filter, what was assimilated before it is kept
                    save(following.recording, out / RECORDING)
                    _save(following.step, following.recording, out / BELIEF)
                    console.print(f"recording and belief are in {out}", markup=False)
                    if left := following.left_out + following.behind:
                        save(following.arrived, out / ARRIVED)
                        console.print(
                            f"{left} measurements are not in them; all that arrived is in {out / ARRIVED}",
                            markup=False,
                        )


async def _serving(server: Server, console: Console) -> None:
    listening = await server.listen()
    console.print(f"listening at {server.address[0]}:{server.address[1]}, token {server.token}", markup=False)
    async with listening:
        await listening.serve_forever()


def _chosen(
    name: str, model: str | None, inference: str | None, set_: list[str] | None, begun: bool = True
) -> tuple[Recording, Model, Callable[..., Iterator[Step]]]:
    """The recording, the model with its settings, and the inference program."""
    from bcppl.cli import loading

    measured = loading.recording(name, model, begun=begun)
    named = model or measured.model
    chosen = loading.with_settings(loading.model(model, measured.model), loading.settings(set_ or []), named)
    given, infer = loading.inference(inference, chosen)
    cure = "let it take start=None, and give it to `smc`"
    loading.check_takes(infer, "start", f"{given} cannot go on from one measurement to the next", cure)
    return measured, chosen, infer

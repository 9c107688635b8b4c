"""`bcppl run`: the main job, from a recording to beliefs, a table and two figures."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.table import Table

from bcppl import poses
from bcppl.beliefs import average_distance, average_nearest_distance
from bcppl.cli import latent_sites, loading, surprises
from bcppl.errors import InputError
from bcppl.figures import add_over_time, belief_in_3d
from bcppl.inference.progress import sole_bar
from bcppl.recordings import Recording
from bcppl.recordings.beliefs import save_belief
from bcppl.recordings.fingerprint import fingerprint
from bcppl.traces import Model

HEADER = (
    "measurement",
    "time s",
    "ESS",
    "distinct",
    "log Z",
    "accepted",
    "steps",
    "ADD mm",
    "truth gap",
    "p value",
    "sim. s",
    "wall s",
)
FEWEST = 20
LARGEST_GAP = 5.0  # nats: the truth may score better than the best particle by chance, not by more
WIDTHS = (12, 7, 6, 8, 9, 8, 5, 7, 9, 8, 7, 6)


def run(
    recording: Annotated[str, typer.Argument(help="A recording (.h5), or the name of a shipped one.")],
    model: Annotated[
        str | None, typer.Option(help="A model's name or file; by default the one the recording names.")
    ] = None,
    inference: Annotated[
        str | None,
        typer.Option(
            help="An inference program's name or file; by default guided_smc for models with programs that "
            "take measurements in, tempered_smc for others."
        ),
    ] = None,
    particles: Annotated[int, typer.Option(help="How many particles.")] = 75,
    seed: Annotated[int, typer.Option(help="Same seed, same belief, bit for bit.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for beliefs and figures; runs/RECORDING by default.")
    ] = None,
) -> None:
    """Find the part: one row for each measurement, the final pose with its spread, beliefs and figures."""
    if particles < 2:
        raise InputError(f"--particles is {particles}; give 2 or more, 75 is a good start.")
    loading.refuse_seed(seed)
    found = loading.recording(recording)
    chosen = loading.model(model or found.model)
    inference = inference or chosen.inference[0]
    infer = loading.inference(inference)
    try:
        inspect.signature(infer).bind(chosen, found, particles=particles, seed=seed, scene=None)
    except TypeError as error:
        raise InputError(
            f"`infer` of {inference} cannot be called ({error}); "
            "define it as infer(model, recording, *, particles=75, seed=0, scene=None)."
        ) from error
    folder = out or Path("runs") / Path(recording).stem
    blocked = next((p for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None)
    if blocked is not None:
        raise InputError(f"--out {folder} cannot be made, {blocked} is a file; give a folder.")
    scene = chosen.prepare(found)
    chosen.observe(scene, found.measurements)  # what cannot be read is refused before anything is written
    console = Console(highlight=False)
    steps: list[Any] = []
    rows: list[list[str]] = []
    watch = surprises.Watch()
    made = {
        "recording": recording,
        "model": model or found.model,
        "inference": inference,
        "particles": particles,
        "seed": seed,
        "version": version("bcppl"),
    }
    if particles < FEWEST:
        console.print(
            f"--particles is {particles}: so few tend to collapse on a wrong pose and be sure of it; "
            "75 is a good start.",
            style="yellow",
        )
    try:
        with sole_bar(console) as progress:
            task = progress.add_task("prior", total=len(found.measurements))
            for step in infer(chosen, found, particles=particles, seed=seed, scene=scene):
                if not steps:
                    _start(folder)
                    progress.console.print(_row(HEADER), style="bold", soft_wrap=True)
                _keep(folder, len(steps), step, found)
                steps.append(step)
                rows.append(_cells(step, found, watch.cell(step)))
                _write_record(folder, made, steps, rows)
                progress.console.print(_row(rows[-1]), soft_wrap=True)
                doing = next_label(found, len(steps))
                progress.update(task, completed=len(steps) - 1, description=doing)
    finally:
        # Whatever stopped the run, what was computed is shown and kept.
        if steps:
            if len(steps) <= len(found.measurements):
                console.print(
                    f"stopped after {steps[-1].info.label}: {len(steps) - 1} of {len(found.measurements)} "
                    "measurements were taken in.",
                    style="yellow",
                )
            _report(console, found, chosen, steps)
            if not watch.told:
                console.print(surprises.NOT_TOLD, style="dim", markup=False)
            warning = watch.warning(steps[-1])
            if warning is not None:
                console.print(warning, style="yellow", markup=False)
            _draw(folder, found, steps)
            console.print(f"beliefs and figures are in {folder}")


def next_label(recording: Recording, taken: int) -> str:
    """The measurement after so many, as the table names it: what is being worked on."""
    last = min(taken, len(recording.measurements))
    return f"{recording.measurements[last - 1].kind} {last}"


def _start(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for old in (*folder.glob("belief_*.h5"), *folder.glob("*.png")):
        old.unlink()


def _keep(folder: Path, number: int, step: Any, recording: Recording) -> None:
    save_belief(
        step.belief,
        folder / f"belief_{number:03d}.h5",
        label=step.info.label,
        log_evidence=step.info.log_evidence,
        random_state=step.random_state,
        latent=latent_sites.values_of(step),
        of=fingerprint(recording, number),
    )


def _write_record(
    folder: Path, made: dict[str, Any], steps: Sequence[Any], rows: Sequence[Sequence[str]]
) -> None:
    """What was run, the table so far, and what the last step says of every latent site, as JSON."""
    unfinished = folder / "run.json.part"
    table = [dict(zip(HEADER, row, strict=True)) for row in rows]
    whole = {**made, "rows": table, "latent": latent_sites.summarised(steps[-1])}
    unfinished.write_text(json.dumps(whole, indent=1), encoding="utf-8")
    unfinished.replace(folder / "run.json")


def _row(cells: Sequence[str]) -> str:
    first, *others = (c.rjust(w) for c, w in zip(cells, WIDTHS, strict=True))
    return " ".join([first.strip().ljust(WIDTHS[0]), *others])


def _number(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _cells(step: Any, recording: Recording, surprise: str) -> list[str]:
    info = step.info
    add = math.nan
    if recording.truth is not None:
        add = 1e3 * step.belief.weighted_add(recording.part.surface_points(), recording.truth)
    return [
        info.label,
        _number(info.time, 2),
        _number(info.effective_sample_size, 1),
        str(info.distinct),
        _number(info.log_evidence, 2),
        _number(info.acceptance, 2),
        str(len(info.exponents) or ""),
        _number(add, 2),
        _number(info.truth_gap, 2),
        surprise,
        _number(info.effort["physics"].amount if "physics" in info.effort else math.nan, 0),
        _number(info.seconds, 2),
    ]


def _report(console: Console, recording: Recording, model: Model, steps: Sequence[Any]) -> None:
    belief = steps[-1].belief
    sites = latent_sites.summarised(steps[-1])
    why = latent_sites.why_no_truth_gap(model, recording.truth is not None, sites)
    if why is not None and all(math.isnan(step.info.truth_gap) for step in steps):
        console.print(why, style="dim", markup=False)
    guess = torch.as_tensor(recording.guess.world_from_part, dtype=torch.float64)
    turned = torch.rad2deg(poses.local(guess, belief.mean)[3:]).tolist()
    mean, spread = belief.mean.tolist(), belief.spread.tolist()
    table = Table(title="pose of the part (world_from_part)", title_justify="left", box=None, pad_edge=False)
    for name in ("axis", "mean", "standard deviation"):
        table.add_column(name, justify="left" if name == "axis" else "right")
    for k, axis in enumerate("xyz"):
        table.add_row(f"{axis}", f"{1e3 * mean[k]:.3f} mm", f"{1e3 * spread[k]:.3f} mm")
    for k, axis in enumerate("xyz"):
        table.add_row(
            f"turn about the part's {axis}, from the guess",
            f"{turned[k]:.3f}°",
            f"{math.degrees(spread[3 + k]):.3f}°",
        )
    console.print(table)
    # q and -q are one rotation: the one with w >= 0 is what people compare.
    sign = -1.0 if mean[3] < 0 else 1.0
    console.print("quaternion w x y z: " + " ".join(f"{sign * q:.6f}" for q in mean[3:]))
    rows = latent_sites.rows(sites, model.pose)
    if rows:
        console.print(latent_sites.table(rows))
    if recording.truth is not None:
        points = recording.part.surface_points()
        console.print(
            f"ADD: {1e3 * belief.weighted_add(points, recording.truth):.3f} mm over the particles by weight, "
            f"{1e3 * float(average_distance(belief.mean, points, recording.truth)):.3f} mm at the mean "
            f"(ADD-S {1e3 * float(average_nearest_distance(belief.mean, points, recording.truth)):.3f} mm)"
        )
    gap = steps[-1].info.truth_gap
    if gap > LARGEST_GAP:
        console.print(
            f"the particles missed the truth, which scores {gap:.0f} nats better than the best of them: "
            "try more particles or another seed.",
            style="yellow",
        )
    wall = sum(step.info.seconds for step in steps)
    spent = [f"wall time {wall:.2f} s"]
    for name in steps[-1].info.effort:
        efforts = [step.info.effort[name] for step in steps if name in step.info.effort]
        unit = {"rendering": "images", "physics": "rollouts"}.get(name, "items")
        spent.append(
            f"{name} {sum(e.seconds for e in efforts):.2f} s ({sum(e.items for e in efforts)} {unit})"
        )
        if name == "physics":
            spent[-1] = spent[-1][:-1] + f", {sum(e.amount for e in efforts):.0f} s simulated)"
    console.print(", ".join(spent))


def _draw(folder: Path, recording: Recording, steps: Sequence[Any]) -> None:
    points = recording.part.surface_points()
    known = recording.truth is not None
    true = recording.truth if known else steps[-1].belief.mean
    adds = np.stack([step.belief.add(points, true).numpy() for step in steps])
    weights = np.stack([step.belief.weights.numpy() for step in steps])
    kinds = ["prior", *(m.kind for m in recording.measurements)][: len(steps)]
    touched = [k for k, kind in enumerate(kinds) if kind in ("window", "push")]
    labels = [step.info.label for step in steps]
    contact = touched[0] if touched and "view" in kinds else None
    figure = add_over_time(np.arange(len(steps), dtype=np.float64), adds, weights, labels, contact)
    if not known:
        figure.axes[0].set_ylabel("distance from the final mean (mm)")
    figure.savefig(folder / "add_over_time.png", dpi=150)
    views = [k for k, kind in enumerate(kinds) if kind == "view"]
    middle = views[-1] if views else len(steps) // 2
    panels = dict.fromkeys([0, middle, len(steps) - 1])
    titles = {0: "start", middle: "after vision" if views else f"after {labels[middle]}"}
    titles[len(steps) - 1] = ("after contact" if touched else "after vision") if len(steps) > 1 else "start"
    shown = [
        (titles[k], steps[k].belief.world_from_part.numpy(), steps[k].belief.log_weights.numpy())
        for k in panels
    ]
    belief_in_3d(recording.part, shown, recording.truth).savefig(folder / "belief_in_3d.png", dpi=150)

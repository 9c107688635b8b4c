"""`bcppl sweep`: every combination of recordings, models, settings and seeds, each run once."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from bcppl.arguments import LARGEST_SEED
from bcppl.cli.digests import digest
from bcppl.cli.options import Settings
from bcppl.errors import InputError
from bcppl.sweeps import CellsFailed, kept, key_of, product, swept

RESULTS, TABLE, BELIEFS = "results.jsonl", "results.csv", "beliefs"  # in the folder
WIDTH = 100  # columns of the table at least, also where the output is no terminal
BACKENDS = ("loky", "ray", "dask")
MASSES = (0.5, 0.9)
HOLDS = "in the {:.0f} % region"
FILES = ("recording", "model", "inference")  # of a cell, where they are files
OVER = ("recording", "seed", "contents")  # a line of the table is over all of these
SCENE = "scene"  # before the seed of a recording that a model simulates


def sweep(
    recordings: Annotated[
        list[str] | None, typer.Argument(help="Recordings (.h5), or the names of shipped ones.")
    ] = None,
    model: Annotated[list[str] | None, typer.Option(help="A model, as of `run`; may be repeated.")] = None,
    inference: Annotated[
        list[str] | None, typer.Option(help="An inference program, as of `run`; may be repeated.")
    ] = None,
    particles: Annotated[
        list[int] | None, typer.Option(min=2, help="How many, 75 by default; may be repeated.")
    ] = None,
    seeds: Annotated[str, typer.Option(help="Seeds of inference: 5, or 0:20 for 0 to 19.")] = "0",
    set_: Settings = None,
    scenes: Annotated[
        str | None,
        typer.Option(help="In place of recordings: seeds (0:20) of those that --model simulates."),
    ] = None,
    out: Annotated[
        Path, typer.Option(file_okay=False, help="Folder of results; those that are there are not run again.")
    ] = Path("sweep"),
    jobs: Annotated[int, typer.Option(help="Runs at a time, of one thread each; -1 for all cores.")] = 1,
    backend: Annotated[
        str, typer.Option(help="loky (processes of this machine), ray or dask (a cluster, or a local one).")
    ] = BACKENDS[0],
    share: Annotated[
        str, typer.Option(metavar="K/N", help="The K-th of N equal shares, for the tasks of an array.")
    ] = "1/1",
) -> None:
    """Run every combination of what is given; a setting that is given twice has two values."""
    from rich.console import Console

    from bcppl.inference.progress import watched

    named = _recordings(recordings or [], scenes, model or [])
    models, programs, settings = model or [""], inference or [""], _settings(set_ or [])
    cells = product(
        recording=named,
        model=models,
        inference=programs,
        particles=particles or [75],
        settings=settings,
        seed=_numbers("--seeds", seeds),
    )
    # A recording that a pattern matches besides its name is the same cell, and has one result.
    cells = list({key_of(cell): cell for cell in cells}.values())
    words = {v for each in settings for v in each.values() if isinstance(v, str)}
    stated = {word for word in words if Path(word).is_file()}
    _refuse_wrong(models, programs, settings)
    digests = {name: digest(name) for name in {*named, *models, *programs, *stated}}
    for cell in cells:
        given = [each for each in cell["settings"].values() if isinstance(each, str) and each in stated]
        cell["contents"] = [digests[name] for name in (*(cell[name] for name in FILES), *given)]
    number, shares = _share(share)
    with workers(backend):
        done = swept(
            partial(of_cell, here=Path.cwd(), beliefs=(out / BELIEFS).absolute()),
            cells,
            file=(out / RESULTS).absolute(),
            jobs=jobs,
            share=(number, shares),
        )
        (out / BELIEFS).mkdir(parents=True, exist_ok=True)
        found, failed = [], list[tuple[Mapping[str, Any], str]]()
        try:
            total = len(cells[number - 1 :: shares])
            for each in watched(done, total=total, description="runs"):
                found.append(each)
        except CellsFailed as error:
            failed = error.failures
            raise
        finally:
            # Whatever stopped the sweep, what was computed is shown.
            console = Console(highlight=False)
            console.width = max(console.width, WIDTH)
            if found:
                console.print(_table(found))
            if found or failed:
                _write(out, failed)
                console.print(f"{len(found)} of {len(cells)} runs are in {out}", markup=False)


def of_cell(cell: Mapping[str, Any], here: Path, beliefs: Path) -> dict[str, Any]:
    """What came of one run, whose files are named from `here`; its last belief is written into a folder."""
    found = {**cell, **{name: str(here / cell[name]) for name in FILES if (here / cell[name]).is_file()}}
    return _followed(found, beliefs, hashlib.sha256(key_of(cell).encode()).hexdigest()[:16])


def _followed(cell: Mapping[str, Any], beliefs: Path, name: str) -> dict[str, Any]:
    from bcppl.beliefs import average_distance, average_point_distance
    from bcppl.cli import latent_sites, loading
    from bcppl.cli.predictive_checks import PredictiveChecks
    from bcppl.recordings.beliefs import save_belief
    from bcppl.recordings.fingerprint import fingerprint

    word, _, scene = cell["recording"].partition(" ")
    if word == SCENE:
        simulating = loading.model(cell["model"])
        assert simulating.simulate_recording is not None
        recording = simulating.simulate_recording(int(scene))
    else:
        recording = loading.recording(cell["recording"])
    named = loading.model(cell["model"] or None, recording.model)
    chosen = loading.with_settings(named, cell["settings"], cell["model"] or recording.model)
    _, infer = loading.inference(cell["inference"] or None, chosen)
    begun, checks = time.perf_counter(), PredictiveChecks()
    for step in infer(chosen, recording, particles=cell["particles"], seed=cell["seed"]):
        checks.cell(step)
    seconds = time.perf_counter() - begun
    belief, points, truth = step.belief, recording.part.surface_points(), recording.truth
    save_belief(
        belief,
        beliefs / f"{name}.h5",
        label=step.info.label,
        log_evidence=step.info.log_evidence,
        random_state=step.random_state,
        latent=latent_sites.values_of(step),
        of=fingerprint(recording, len(recording.measurements)),
    )
    result: dict[str, Any] = {
        "mean": belief.mean.tolist(),
        "spread": belief.spread.tolist(),
        "log_evidence": step.info.log_evidence,
        "effective_sample_size": step.info.effective_sample_size,
        "distinct": step.info.distinct,
        "warnings": checks.warnings(step, chosen.pose),
        "seconds": seconds,
        "belief": f"{BELIEFS}/{name}.h5",
    }
    if truth is not None:
        regions = [belief.credible_region(mass, average_point_distance(points)) for mass in MASSES]
        result["add_mm"] = 1e3 * float(average_distance(belief.mean, points, truth))
        result["weighted_add_mm"] = 1e3 * belief.weighted_add(points, truth)
        for mass, region in zip(MASSES, regions, strict=True):
            result[HOLDS.format(100 * mass)] = bool(region.contains(truth))
    return result


def _recordings(given: Sequence[str], scenes: str | None, models: Sequence[str]) -> list[str]:
    """Names or files of recordings, or scenes by their seeds."""
    if scenes is None:
        if not given:
            raise InputError("sweep is given no recording; give some, or a --model and --scenes.")
        if lost := [name for name in given if name.endswith(".h5") and not Path(name).is_file()]:
            raise InputError(f"{lost[0]} is not a file; give the paths of recordings (.h5).")
        return list(given)
    if given or len(models) != 1:
        raise InputError("--scenes are simulated by one model: give one --model and no recordings.")
    from bcppl.cli import loading

    if loading.model(models[0]).simulate_recording is None:
        raise InputError(
            f"model {models[0]!r} simulates no recordings; these do: {', '.join(loading.simulating())}."
        )
    return [f"{SCENE} {seed}" for seed in _numbers("--scenes", scenes)]


def _numbers(option: str, text: str) -> range:
    """The numbers of `5` or of `0:20`."""
    first, colon, end = text.partition(":")
    if not (first.isdecimal() and (end.isdecimal() if colon else True)):
        raise InputError(f"{option} is given {text!r}; give one number, or a range such as 0:20.")
    numbers = range(int(first), int(end) if colon else int(first) + 1)
    if not numbers or numbers[-1] > LARGEST_SEED:
        raise InputError(f"{option} {text} is no range of seeds; give one from 0 to {LARGEST_SEED}.")
    return numbers


def _settings(given: Sequence[str]) -> list[dict[str, Any]]:
    """All combinations of settings, of which a name that is given twice has two values."""
    from bcppl.cli import loading

    axes: dict[str, list[Any]] = {}
    for name, value in (item for each in given for item in loading.settings([each]).items()):
        axes.setdefault(name, []).append(value)
    return product(**axes)


def _refuse_wrong(models: Sequence[str], programs: Sequence[str], settings: Sequence[Any]) -> None:
    """Refuse before the first run what every one would refuse, unless recordings name the model."""
    from bcppl.cli import loading

    for model in filter(None, models):
        chosen = [loading.with_settings(loading.model(model), each, model) for each in settings]
        for program in filter(None, programs):
            loading.inference(program, chosen[0])


def _share(text: str) -> tuple[int, int]:
    number, slash, shares = text.partition("/")
    if not (slash and number.isdecimal() and shares.isdecimal()):
        raise InputError(f"--share is given {text!r}; give K/N, such as 3/10.")
    return int(number), int(shares)


def workers(backend: str) -> AbstractContextManager[Any]:
    """Within it runs go to the workers of a backend of joblib."""
    from joblib import parallel_config

    if backend == BACKENDS[0]:
        return nullcontext()
    try:
        if backend == "ray":
            from ray.util.joblib import register_ray

            register_ray()
            return parallel_config("ray")
        if backend == "dask":
            from distributed import Client

            Client()  # of DASK_SCHEDULER_ADDRESS where that is set; joblib takes the last one
            return parallel_config("dask")
    except ImportError as error:
        raise InputError(
            f"--backend {backend} needs another package: pip install bcppl[{backend}]."
        ) from error
    raise InputError(f"there is no backend {backend!r}; give one of {', '.join(BACKENDS)}.")


def _table(found: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> Any:
    """A line for all recordings and seeds of one model, program, number of particles and settings."""
    import numpy as np
    from rich.table import Table

    groups: dict[str, list[Mapping[str, Any]]] = {}
    flat = [_flat(cell) for cell, _ in found]
    varied = [n for n in flat[0] if n not in OVER and len({str(each.get(n)) for each in flat}) > 1]
    for each, (_, result) in zip(flat, found, strict=True):
        groups.setdefault(" ".join(f"{n}={each[n]}" for n in varied), []).append(result)
    table = Table(box=None, pad_edge=False)
    columns = (
        "runs",
        "ADD mm",
        "90 %",
        "worst",
        "in 50 %",
        "in 90 %",
        "deviation mm",
        "warned",
        "s",
    )
    for name in (" ", *columns):
        table.add_column(name, justify="right" if name.strip() else "left")
    for name, results in sorted(groups.items()):
        adds = [one["add_mm"] for one in results if "add_mm" in one]
        held = [[one[HOLDS.format(100 * m)] for one in results if "add_mm" in one] for m in MASSES]
        spreads = [1e3 * math.sqrt(sum(s * s for s in one["spread"][:3])) for one in results]
        table.add_row(
            name,
            str(len(results)),
            *[f"{np.quantile(adds, q):.2f}" if adds else "" for q in (0.5, 0.9, 1.0)],
            *[f"{100 * np.mean(each):.0f} %" if each else "" for each in held],
            f"{np.median(spreads):.3f}",
            str(sum(bool(one["warnings"]) for one in results)),
            f"{np.median([one['seconds'] for one in results]):.2f}",
        )
    return table


def _flat(cell: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """A cell's entries and its settings, by their names with something before these."""
    settings = {f"{before}{name}": value for name, value in cell["settings"].items()}
    return {**{k: v for k, v in cell.items() if k != "settings"}, **settings}


def _write(out: Path, failed: Sequence[tuple[Mapping[str, Any], str]]) -> None:
    """All results of a folder, and why others have none, as a table that other programs read."""
    from bcppl.recordings.hdf5 import replacing

    path, found = out / TABLE, [(json.loads(key), result) for key, result in kept(out / RESULTS).items()]
    found += [(cell, {"error": reason}) for cell, reason in failed]
    # A setting may have the name of a result, such as `spread`.
    rows = [{**_flat(cell, "set."), **result} for cell, result in found]
    names = list(dict.fromkeys(name for row in rows for name in row))
    with replacing(path) as beside, beside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)

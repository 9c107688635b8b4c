"""The posterior that candidates are ranked from: of a recording that is run, or of a run's belief file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from bcppl.cli import loading
from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.progress import sole_bar
from bcppl.recordings import Recording
from bcppl.recordings.beliefs import is_belief, load_belief, load_fingerprint, load_label, load_latent
from bcppl.recordings.fingerprint import is_of
from bcppl.traces import Model, Series, generate
from bcppl.untrusted import strict_json


@dataclass(frozen=True, eq=False)
class Posterior:
    """A population after all measurements of a recording, which holds no others; and the model's scene."""

    recording: Recording
    model: Model
    population: Population
    scene: Any


def posterior(
    name: str,
    of: str | None,
    model: str | None,
    settings: Mapping[str, Any],
    inference: str | None,
    particles: int,
    seed: int,
    console: Console,
    check: Callable[[Recording], None] = lambda recording: None,
) -> Posterior:
    """The posterior of a recording, which is run, or in a belief's file; `check` refuses a recording."""
    if Path(name).is_file() and is_belief(name):
        if inference is not None:
            raise InputError(f"--inference is given with {name}, a belief, which needs no run; leave it out.")
        return _read(Path(name), of, model, settings, check)
    if of is not None:
        raise InputError(f"--of names a belief's recording, but {name} is a recording; leave it out.")
    recording = loading.recording(name, model, begun=False)
    check(recording)
    named = model or recording.model
    chosen = _static(loading.with_settings(loading.model(model, recording.model), settings, named), named)
    _, infer = loading.inference(inference, chosen)
    scene = chosen.prepare(recording)
    population = None
    with sole_bar(console) as progress:
        task = progress.add_task("prior", total=len(recording.measurements) + 1)
        for step in infer(chosen, recording, particles=particles, seed=seed, scene=scene):
            population = getattr(step, "population", None)
            progress.update(task, advance=1, description=step.info.label)
    if not isinstance(population, Population):
        raise InputError("steps of this inference program have no population to predict with; use another.")
    return Posterior(recording, chosen, population, scene)


def _static(model: Model, name: str) -> Model:
    if isinstance(model.program, Series):
        raise InputError(
            f"in model {name} the pose moves, so a plan made now would miss it; give a model of a part that "
            "stays where it is."
        )
    return model


def _read(
    path: Path,
    of: str | None,
    model: str | None,
    settings: Mapping[str, Any],
    check: Callable[[Recording], None],
) -> Posterior:
    """The population of a belief's file, its sites observed as the recording has them."""
    label, belief = load_label(path), load_belief(path)
    record = run_record(path)
    of = of or record.get("recording")
    if of is None:
        raise InputError(f"{path} names no recording, nor does a run.json beside it; give --of RECORDING.")
    whole = loading.recording(of, model)
    by = "the recording" if record.get("model") is None else str(path.parent / "run.json")
    named = record.get("model") or whole.model
    settings = {**record.get("settings", {}), **settings}
    chosen = loading.with_settings(loading.model(model, named, by), settings, model or named)
    chosen = _static(chosen, model or named)
    assimilated = _assimilated(path, label)
    if assimilated > len(whole.measurements):
        raise InputError(
            f"{path} is after {label}, but {of} has {len(whole.measurements)} measurements; "
            "give the recording that it was run on with --of."
        )
    if not is_of(load_fingerprint(path), whole, assimilated):
        raise InputError(
            f"{path} is of another recording than {of}: part, guess or measurements differ; give the "
            "one that it was run on with --of."
        )
    measured = list(whole.measurements[:assimilated])
    scene = chosen.prepare(whole)
    observed = chosen.observe(scene, measured)
    latent = {chosen.pose: belief.world_from_part, **load_latent(path)}
    if not torch.equal(latent[chosen.pose], belief.world_from_part):
        raise InputError(
            f"{path} has other poses at {chosen.pose!r} than it states as its belief; make it again."
        )
    try:
        trace, _ = generate(
            chosen.program, (scene, [m.action for m in measured]), observed, len(belief), choices=latent
        )
    except (KeyError, ValueError, InputError) as error:
        raise InputError(
            f"{path} does not fit the model or the recording ({error}); give --of and --model as it was run."
        ) from error
    # What a file lacks was drawn from the prior.
    if drawn := [address for address in trace.choices if address not in latent]:
        raise InputError(
            f"{path} holds no values of {', '.join(drawn)}, which the model infers besides the pose; give "
            "one that `bcppl run` or `bcppl live` wrote."
        )
    check(whole)
    recording = replace(whole, measurements=measured)
    return Posterior(recording, chosen, Population(trace, belief.log_weights), scene)


def _assimilated(path: Path, label: str) -> int:
    """The number of measurements that a belief has assimilated, by the label of its step."""
    count = "0" if label == "prior" else label.rpartition(" ")[2]
    if not (count.isascii() and count.isdecimal() and len(count) < 10):
        raise InputError(
            f"{path} has the label {label!r}, which does not give the number of its measurements; give one "
            'that `bcppl run` wrote, or save it with the label of its step ("prior", "measurement 3").'
        )
    return int(count)


def run_record(path: Path) -> dict[str, Any]:
    """The recording, model and settings of the run.json that `bcppl run` wrote beside a belief.

    Raises:
        InputError: it is no run.json of `bcppl run`; where there is none, nothing is wrong.
    """
    file, remedy = path.parent / "run.json", "run it again, or remove that file and give --of and --model"
    if not file.is_file():
        return {}
    record = strict_json.read(file, remedy, finite=False)
    kinds = {"recording": str, "model": str, "settings": dict}
    if not isinstance(record, dict):
        raise InputError(f"{file} is no record of a run; {remedy}.")
    named = {name: record[name] for name in kinds if record.get(name) is not None}
    for name, value in named.items():
        if not isinstance(value, kinds[name]):
            raise InputError(f"{file} has a {name} of type {type(value).__name__}; {remedy}.")
    return named

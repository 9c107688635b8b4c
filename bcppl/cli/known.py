"""What is known before the next measurement: a recording that was run, or a belief that a run left."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
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


@dataclass(frozen=True, eq=False)
class Known:
    """What candidates are ranked from.

    Attributes:
        recording: with the measurements that were taken in, and no others.
        model: what explains it.
        population: after them.
        scene: of the model.
    """

    recording: Recording
    model: Model
    population: Population
    scene: Any


def known(
    name: str,
    of: str | None,
    model: str | None,
    inference: str | None,
    particles: int,
    seed: int,
    console: Console,
    check: Callable[[Recording], None] = lambda recording: None,
) -> Known:
    """Run a recording, or read a belief.

    Args:
        name: a recording's file or name, or a belief's file.
        of: the recording that a belief is of; None: what the run.json beside it says.
        model: None: the one that the recording or the run.json names.
        inference: None: the default one for the model.
        particles: of a run.
        seed: of a run.
        console: shows how far a run is.
        check: refuses a recording before anything is run.

    Raises:
        InputError: something is not to be found, does not fit, or cannot be gone on from.
    """
    if Path(name).is_file() and is_belief(name):
        if inference is not None:
            raise InputError(
                f"{name} is a belief, on which nothing is run, so --inference says nothing; leave it out."
            )
        return _read(Path(name), of, model, check)
    if of is not None:
        raise InputError(
            f"--of says which recording a belief is of, but {name} is a recording; leave it out."
        )
    found = loading.recording(name)
    check(found)
    chosen = _chosen(model or found.model)
    infer = loading.inference(inference or chosen.inference[0])
    scene = chosen.prepare(found)
    population = None
    with sole_bar(console) as progress:
        task = progress.add_task("prior", total=len(found.measurements) + 1)
        for step in infer(chosen, found, particles=particles, seed=seed, scene=scene):
            population = getattr(step, "population", None)
            progress.update(task, advance=1, description=step.info.label)
    if not isinstance(population, Population):
        raise InputError(
            "this inference shows no population, so nothing can be foretold from it; use another."
        )
    return Known(found, chosen, population, scene)


def _chosen(name: str) -> Model:
    found = loading.model(name)
    if isinstance(found.program, Series):
        raise InputError(
            f"in model {name} the pose moves, so a plan made now would miss it; give a model of a part that "
            "stays where it is."
        )
    return found


def _read(path: Path, of: str | None, model: str | None, check: Callable[[Recording], None]) -> Known:
    """The population of a belief's file, its sites observed as the recording has them."""
    label, belief, latent = load_label(path), load_belief(path), load_latent(path)
    noted = _noted(path)
    of = of or noted.get("recording")
    if of is None:
        raise InputError(
            f"{path} does not say which recording it is of, and no run.json lies beside it; "
            "say so with --of RECORDING."
        )
    whole = loading.recording(of)
    chosen = _chosen(model or noted.get("model") or whole.model)
    taken = _taken(path, label)
    if taken > len(whole.measurements):
        raise InputError(
            f"{path} stands after {label}, but {of} has {len(whole.measurements)} measurements; "
            "give the recording that it was run on with --of."
        )
    if not is_of(load_fingerprint(path), whole, taken):
        raise InputError(
            f"{path} is of another recording than {of}: part, guess or measurements differ; give the "
            "one that it was run on with --of."
        )
    measured = list(whole.measurements[:taken])
    scene = chosen.prepare(whole)
    observed = chosen.observe(scene, measured)
    try:
        trace, _ = generate(
            chosen.program,
            (scene, [m.action for m in measured]),
            observed,
            len(belief),
            choices=latent,
        )
    except (KeyError, ValueError, InputError) as error:
        raise InputError(
            f"{path} does not fit the model or the recording ({error}); give --of and --model as it was run."
        ) from error
    check(whole)
    recording = Recording(**{**vars(whole), "measurements": measured})
    return Known(recording, chosen, Population(trace, belief.log_weights.to(torch.float64)), scene)


def _taken(path: Path, label: str) -> int:
    """How many measurements a belief has taken in, by the label of its step."""
    count = "0" if label == "prior" else label.rpartition(" ")[2]
    if not (count.isascii() and count.isdecimal() and len(count) < 10):
        raise InputError(
            f"{path} has the label {label!r}, which does not say how many measurements it has taken in; give "
            'one that `bcppl run` wrote, or save it with the label of its step ("prior", "measurement 3").'
        )
    return int(count)


def _noted(path: Path) -> dict[str, Any]:
    """What the run that left a belief has written down, if that lies beside it."""
    try:
        found = json.loads((path.parent / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}

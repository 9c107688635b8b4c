"""A step of SMC over a recording in a file, from which the run is resumed in another process.

The steps after it are those of the run that was not interrupted, to the bit.
"""

from __future__ import annotations

import warnings
from dataclasses import asdict
from typing import Any

from bcppl.effort import Effort
from bcppl.errors import InputError
from bcppl.inference.filters.smc import Info, Step, own_state
from bcppl.inference.filters.step import StepInfo
from bcppl.inference.saved.populations import (
    Location,
    opened,
    population_content,
    population_of,
    write,
)
from bcppl.recordings import Recording, once_each
from bcppl.recordings.fingerprint import fingerprint
from bcppl.traces import Model, Series


def save_step(step: Step, path: Location, recording: Recording) -> None:
    """Write a step of `bcppl.inference.smc` to an HDF5 file, all or nothing.

    Args:
        step: with its particles, its random state and its record.
        path: where to.
        recording: of which the fingerprint of the measurements so far is kept.

    Raises:
        InputError: as `bcppl.inference.saved.save`.
    """
    with own_state([step.random_state], len(step.population)):
        population = population_content(step.population)
    info = step.info._asdict()
    info["step"] = info["step"]._asdict()
    info["effort"] = {name: asdict(e) for name, e in info["effort"].items() if isinstance(e, Effort)}
    run = {"taken": step.taken, "info": info, "of": fingerprint(_distinct(recording), step.taken)}
    write(path, {"populations": [population], "run": run}, step.random_state)


def _distinct(recording: Recording) -> Recording:
    """The recording as it is run: every measurement once. That is warned of where it is run."""
    with warnings.catch_warnings(action="ignore"):
        return once_each(recording)


def load_step(path: Location, model: Model, recording: Recording, scene: Any = None) -> Step:
    """The step in a file that `save_step` wrote, for `smc(..., start=step)` and the inference programs.

        scene = model.prepare(recording)
        step = load_step("step_3.h5", model, recording, scene)
        for belief, info in infer(model, recording, start=step, scene=scene):
            print(info.label)

    Args:
        path: of the file.
        model: that the run was of.
        recording: that the run was of; it may have more measurements by now.
        scene: `model.prepare(recording)` unless given.

    Raises:
        InputError: there is no such file, it is damaged or of another version, it holds no step, or it is of
            another recording or model.
    """
    with opened(path) as content:
        if "run" not in content:
            raise InputError("it holds a population and no step of a run; use `bcppl.inference.saved.load`.")
        run, state = content["run"], content["random_state"]
        taken, recording = run["taken"], _distinct(recording)
        if taken > len(recording.measurements) or run["of"] != fingerprint(recording, taken):
            raise InputError(
                f"it is of a run that has assimilated {taken} measurements of another recording; "
                "give the recording of that run."
            )
        scene = model.prepare(recording) if scene is None else scene
        actions = [measurement.action for measurement in recording.measurements[:taken]]
        moves = isinstance(model.program, Series)

        def given(number: int) -> tuple[Any, ...]:
            return scene, actions[max(0, number - 1) : number] if moves else actions

        (held,) = content["populations"]
        with own_state([state], held["trace"]["particles"]):
            population = population_of(held, model.program, given)
        record = run["info"]
        efforts = {name: Effort(**numbers) for name, numbers in record["effort"].items()}
        info = Info(**{**record, "effort": efforts, "step": StepInfo(**record["step"])})
        return Step(population.belief(model.pose), info, population, state, taken)

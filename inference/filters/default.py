"""The inference program that suits a model, with its settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from inspect import signature
from typing import Any

from bcppl.errors import InputError
from bcppl.inference.filters.smc import Step, refuse_no_recording
from bcppl.traces import Model

Infer = Callable[..., Iterator[Step]]


def default_inference(model: Model) -> tuple[str, Infer]:
    """The name of a model's own inference program, and its `infer` with the model's settings."""
    if not isinstance(model, Model):
        raise InputError(
            f"inference is given a {type(model).__name__} in place of a model; give bcppl.models.NAME.model."
        )
    name, settings = model.inference
    if find_spec(f"bcppl.inference.filters.{name}") is None:
        raise InputError(
            f"the model names {name!r} as its inference program; "
            "give tempered_smc, guided_smc or bayes_contact."
        )
    return name, partial(import_module(f"bcppl.inference.filters.{name}").infer, **settings)


def infer(model: Model, recording: Any, **settings: Any) -> Iterator[Step]:
    """Beliefs over a recording by the model's own inference program: the prior's, then one per measurement.

    Args:
        model: what explains the recording.
        recording: a `bcppl.Recording`.
        settings: of the program (`bcppl.inference.tempered_smc.infer`, `bcppl.inference.guided_smc.infer`)
            in place of the model's own: `particles`, `seed`, `scene`, `start` and others.

    Raises:
        InputError: what is given is no model or no recording, a setting is unknown or out of range, or the
            recording does not fit the model.
        InferenceError: no particle is left with any weight.
    """
    name, program = default_inference(model)
    refuse_no_recording(recording)
    known = signature(program).parameters
    for setting in settings:
        if setting not in known:
            own = [each for each in known if each not in ("model", "recording")]
            raise InputError(f"{name} has no setting {setting!r}; its settings are {', '.join(own)}.")
    return program(model, recording, **settings)

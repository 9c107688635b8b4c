"""The inference program that suits a model, with its settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from typing import Any

from bcppl.inference.filters.smc import Step
from bcppl.traces import Model

Infer = Callable[..., Iterator[Step]]


def default_inference(model: Model) -> tuple[str, Infer]:
    """The name of a model's own inference program, and its `infer` with the model's settings."""
    name, settings = model.inference
    return name, partial(import_module(f"bcppl.inference.filters.{name}").infer, **settings)


def infer(model: Model, recording: Any, **settings: Any) -> Iterator[Step]:
    """Beliefs over a recording by the model's own inference program: the prior's, then one per measurement.

    Args:
        model: what explains the recording.
        recording: a `bcppl.Recording`.
        settings: of the program (`bcppl.inference.tempered_smc.infer`, `bcppl.inference.guided_smc.infer`)
            in place of the model's own: `particles`, `seed`, `scene`, `start` and others.

    Raises:
        InputError: a setting is out of range, or the recording does not fit the model.
        InferenceError: no particle is left with any weight.
    """
    return default_inference(model)[1](model, recording, **settings)

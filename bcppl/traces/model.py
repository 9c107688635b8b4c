"""A model: a generative program, and how a recording becomes its arguments and its constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

Program = Callable[..., Any]


@dataclass(frozen=True)
class Model:
    """What a model file defines under the name `model`.

    Attributes:
        program: a Pyro program `program(scene, actions)`. Its arguments are what the robot did, never what
            it saw.
        prepare: `prepare(recording) -> scene`, what stays the same over a run: the prior, simulators.
        observe: `observe(scene, measurements) -> {address: value}`, the constraints that the measurements put
            on `program(scene, [m.action for m in measurements])`: all, also those of earlier measurements.
        pose: address of the sought pose (`world_from_part`).
        invent: `invent(seed, **options) -> Recording`, a recording made up by the model; None if it has none.
    """

    program: Program
    prepare: Callable[[Any], Any]
    observe: Callable[[Any, Sequence[Any]], Mapping[str, Tensor]]
    pose: str
    invent: Callable[..., Any] | None = None

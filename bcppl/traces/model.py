"""A model: a generative program, and how a recording becomes its arguments and its constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

from torch import Tensor

from bcppl.traces.run import Program
from bcppl.traces.series import Series


@dataclass(frozen=True)
class Model:
    """What a model file defines under the name `model`.

    Attributes:
        program: a Pyro program `program(scene, actions)`. Its arguments are what the robot did, never what
            it saw. Or a series, for a pose that moves: `init(scene, [])`, then `step(state, scene, [action])`
            for each measurement, both with the pose at the same address.
        prepare: `prepare(recording) -> scene`, what stays the same over a run: the prior, simulators.
        observe: `observe(scene, measurements) -> {address: value}`, the constraints that the measurements put
            on `program(scene, [m.action for m in measurements])`: all, also those of earlier measurements.
            For a series it is given the newest measurement alone, and names the step's own addresses.
        pose: address of the sought pose (`world_from_part`).
        simulate_recording: `simulate_recording(seed, **options) -> Recording`, simulated by the model's own
            world; None if it has none.
        proposals: programs that an inference may use, `proposal(trace)` or `proposal(trace, spreads)`, such
            as one latent value's conditional given the others. Each samples new values at latent addresses,
            every particle's from its own old ones; `spreads` are covariances of other particles in the
            coordinates of each continuous latent value, by address. The target does not depend on proposals.
        inference: the name of the inference program that suits the model best, and its settings.
    """

    program: Program | Series
    prepare: Callable[[Any], Any]
    observe: Callable[[Any, Sequence[Any]], Mapping[str, Tensor]]
    pose: str
    simulate_recording: Callable[..., Any] | None = None
    proposals: Sequence[Callable[..., Any]] = ()
    inference: tuple[str, Mapping[str, Any]] = ("tempered_smc", MappingProxyType({}))

    def with_settings(self, **settings: Any) -> Model:
        """The model with settings of its scenes, such as `profile="panda"` of `look_and_touch`."""
        return replace(self, prepare=partial(self.prepare, **settings))

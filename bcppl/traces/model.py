"""A model: a generative program, and how a recording becomes its arguments and its constraints."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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
        invent: `invent(seed, **options) -> Recording`, a recording made up by the model; None if it has none.
        proposals: programs that an inference may use, `proposal(trace)` or `proposal(trace, spreads)`: what
            the model's author knows of its posterior, such as one latent value's conditional given the
            others. Each draws new values at latent addresses, every particle's from its own old ones;
            `spreads` are covariances of other particles in the coordinates of each continuous latent value,
            by address. No answer hangs on proposals, only how soon it comes: a model still never knows how it
            is inferred.
        arrival: two programs, there and back, by which a population may take a new measurement in
            (`bcppl.inference.filters.smcp3.Pair`): `there(trace)` reads the trace with the new arguments and
            observations and chooses the latent values that come with them, and new ones in place of old ones;
            `back(trace)` chooses the old ones, as they were before. None where the model has none. No answer
            hangs on it either.
        climbs: how many climbs from the prior should look for modes before depth images are let in
            (`bcppl.inference.filters.tempered_smc.infer`): where the best mode may be narrow. 0 for none.
    """

    program: Program | Series
    prepare: Callable[[Any], Any]
    observe: Callable[[Any, Sequence[Any]], Mapping[str, Tensor]]
    pose: str
    invent: Callable[..., Any] | None = None
    proposals: Sequence[Callable[..., Any]] = ()
    arrival: tuple[Callable[[Any], Any], Callable[[Any], Any]] | None = None
    climbs: int = 0

"""The verbs for proposals, Gen's: propose samples a program's choices, assess gives their log-density."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from bcppl.errors import InputError
from bcppl.traces.coincidence import refuse_coincidence
from bcppl.traces.run import Program, Run, run
from bcppl.traces.series import Series, runnable
from bcppl.traces.shown import shapes
from bcppl.traces.trace import Trace
from bcppl.traces.verbs import kind_of, refuse_unvisited, simulate


@dataclass(frozen=True, eq=False, repr=False)
class Proposed:
    """What `propose` returns.

    Attributes:
        choices: values by address (N, *event).
        log_prob: their log-density (N,) under the program.
        result: what the program returned.
    """

    choices: Mapping[str, Tensor]
    log_prob: Tensor
    result: Any = None

    def __repr__(self) -> str:
        return f"Proposed({shapes(self.choices)})"


def propose(program: Program | Series, args: tuple[Any, ...], particles: int) -> Proposed:
    """Run a proposal program forward: its choices and their log-density.

    Raises:
        InputError: the program observes something itself (`obs=`, `pyro.factor`).
    """
    trace = simulate(program, args, particles)
    _refuse_fixed(trace._run)
    return Proposed(trace.choices, trace.log_prob(), trace.result)


def _refuse_fixed(ran: Run) -> None:
    """Refuse a program that observes something itself: that has no density of being chosen."""
    if ran.fixed:
        raise InputError(
            f"a program that is to propose or to be assessed observes {min(ran.fixed)!r} itself (`obs=` or "
            "`pyro.factor`); take that out, and give values as observations."
        )


def assess(
    program: Program | Series, args: tuple[Any, ...], choices: Mapping[str, Tensor], particles: int
) -> Tensor:
    """Log-density (N,) of a program at given values for all of its choices.

    Raises:
        InputError: a choice is missing, or an address is never visited.
    """
    return assessed(program, args, choices, particles).log_prob()


def assessed(
    program: Program | Series, args: tuple[Any, ...], choices: Mapping[str, Tensor], particles: int
) -> Trace:
    """The trace of a program at given values for all of its choices, which are its latent values.

    Raises:
        InputError: a choice is missing, or an address is never visited.
    """
    program = runnable(program)
    ran = run(program, args, particles, choices, {})
    _refuse_fixed(ran)
    refuse_unvisited(choices, ran)
    refuse_coincidence(program, args, particles, ran)
    missing = [a for a in ran.values if a not in choices and a not in ran.fixed]
    if missing:
        raise InputError(
            f"assess needs a value for address {missing[0]!r}; give one for every choice of the program."
        )
    return kind_of(program).of_run(program, args, particles, ran, {})

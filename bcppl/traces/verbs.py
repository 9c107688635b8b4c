"""The verbs on traces, Gen's: simulate, generate, extend, update, and for proposals propose and assess.

Cusumano-Towner et al., Gen: a general-purpose probabilistic programming system with programmable inference,
PLDI 2019, section 4 (the generative function interface). All of them act on N particles at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.traces.carried import Entry
from bcppl.traces.trace import Program, Run, Trace, run


def _trace(
    program: Program, args: tuple[Any, ...], particles: int, ran: Run, observed: Mapping[str, Tensor]
) -> Trace:
    hidden = {a: v for a, v in ran.values.items() if a not in observed and a not in ran.fixed}
    return Trace(program, args, particles, hidden, dict(observed), dict(ran.carried))


def _refuse_unvisited(observations: Mapping[str, Tensor], ran: Run) -> None:
    missing = [a for a in observations if a not in ran.distributions]
    if missing:
        raise InputError(
            f"an observation was given for address {missing[0]!r}, which the program never visits; "
            f"it visits {', '.join(ran.distributions) or 'none'}."
        )


def _refuse_one_each(observations: Mapping[str, Tensor], ran: Run, particles: int) -> None:
    """An observation is the same for all particles: resampling would not carry one for each along."""
    for address, value in observations.items():
        event = tuple(ran.distributions[address].event_shape)
        if tuple(value.shape) != event and particles > 1:
            raise InputError(
                f"the observation at address {address!r} has shape {tuple(value.shape)}, "
                f"its site's event {event}; give one value, the same for all particles."
            )


def simulate(program: Program, args: tuple[Any, ...] = (), particles: int = 1) -> Trace:
    """Run a program forward: every site is sampled, what would be observed included.

    Raises:
        InputError: see `bcppl.traces.trace.run`.
    """
    ran = run(program, args, particles, {}, {})
    return _trace(program, args, particles, ran, {})


def generate(
    program: Program, args: tuple[Any, ...], observations: Mapping[str, Tensor], particles: int
) -> tuple[Trace, Tensor]:
    """Run a program with some sites constrained, the others drawn from the program itself.

    Args:
        program: a Pyro program.
        args: its arguments.
        particles: N.
        observations: values by address, of the site's event shape: the same for all particles.

    Returns:
        The trace and the log weight (N,): the summed log-probability of what was constrained.

    Raises:
        InputError: an observed address is never visited, or an observation has not its site's event shape;
            see also `bcppl.traces.trace.run`.
    """
    ran = run(program, args, particles, observations, {})
    _refuse_unvisited(observations, ran)
    _refuse_one_each(observations, ran, particles)
    trace = _trace(program, args, particles, ran, observations)
    constrained = [a for a in ran.distributions if a in observations or a in ran.fixed]
    weight = trace.log_prob(*constrained) if constrained else torch.zeros(particles, dtype=torch.float64)
    return trace, weight


def extend(trace: Trace, args: tuple[Any, ...], observations: Mapping[str, Tensor]) -> tuple[Trace, Tensor]:
    """Run the program on with new arguments (more measurements): only the new sites are evaluated.

    Values at the old addresses stay; new latent sites are drawn from the program. The old sites are taken to
    have the distributions they had.

    Args:
        trace: what is extended.
        args: the new arguments.
        observations: values of new addresses.

    Returns:
        The longer trace and its log weight (N,): the log-probability of the new observations.

    Raises:
        InputError: an address vanishes, or an observation is of an old address, of one never visited, or
            of the wrong shape.
    """
    old = {**trace.choices, **trace.observations}
    again = [a for a in observations if a in old]
    if again:
        raise InputError(
            f"address {again[0]!r} was observed or sampled before; extend takes new addresses only."
        )
    ran = run(trace.program, args, trace.particles, {**old, **observations}, trace.carried)
    _refuse_unvisited(observations, ran)
    _refuse_one_each(observations, ran, trace.particles)
    lost = [a for a in old if a not in ran.distributions]
    if lost:
        raise InputError(f"with the new arguments the program no longer visits address {lost[0]!r}.")
    longer = _trace(trace.program, args, trace.particles, ran, {**trace.observations, **observations})
    longer.known.update(trace.known)
    new = [
        a for a in ran.distributions if a in observations or (a in ran.fixed and a not in trace.distributions)
    ]
    weight = longer.log_prob(*new) if new else torch.zeros(trace.particles, dtype=torch.float64)
    return longer, weight


@dataclass(frozen=True, eq=False)
class Update:
    """What `update` returns; its log ratio is evaluated when it is asked for.

    Attributes:
        trace: at the new values.
        previous: the trace that was updated.
        discarded: the values that were replaced, by address.
    """

    trace: Trace
    previous: Trace
    discarded: Mapping[str, Tensor]

    @cached_property
    def log_ratio(self) -> Tensor:
        """Log p(new trace) - log p(old trace), (N,)."""
        return self.trace.log_prob() - self.previous.log_prob()


def update(trace: Trace, values: Mapping[str, Tensor]) -> Update:
    """Give some latent addresses new values (N, *event); the others and the arguments stay.

    Raises:
        InputError: an address is not latent, or a value has the wrong shape.
    """
    new = trace.at(values)
    return Update(new, trace, {a: trace.choices[a] for a in values})


@dataclass(frozen=True, eq=False)
class Proposed:
    """What `propose` returns: values by address (N, *event), and their log-density (N,) under the program."""

    choices: Mapping[str, Tensor]
    log_prob: Tensor = field(repr=False)


def propose(program: Program, args: tuple[Any, ...], particles: int) -> Proposed:
    """Run a proposal program forward: its choices and their log-density."""
    trace = simulate(program, args, particles)
    return Proposed(trace.choices, trace.log_prob())


def assess(program: Program, args: tuple[Any, ...], choices: Mapping[str, Tensor], particles: int) -> Tensor:
    """Log-density (N,) of a program at given values for all of its choices.

    Raises:
        InputError: a choice is missing, or an address is never visited.
    """
    none: dict[str, Entry] = {}
    ran = run(program, args, particles, choices, none)
    _refuse_unvisited(choices, ran)
    missing = [a for a in ran.values if a not in choices and a not in ran.fixed]
    if missing:
        raise InputError(
            f"assess needs a value for address {missing[0]!r}; give one for every choice of the program."
        )
    return _trace(program, args, particles, ran, choices).log_prob()

"""The verbs that make and lengthen traces, Gen's: simulate, generate, extend.

Cusumano-Towner et al., Gen: a general-purpose probabilistic programming system with programmable inference,
PLDI 2019, section 4 (the generative function interface). All of them act on N particles at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.support import refuse_several_poses
from bcppl.errors import InputError
from bcppl.traces.coincidence import refuse_coincidence
from bcppl.traces.run import Program, Run, refuse_other_than_tensors, run
from bcppl.traces.series import Series, SeriesTrace, Stage, runnable
from bcppl.traces.trace import Trace


def trace_of(
    program: Program, args: tuple[Any, ...], particles: int, ran: Run, observed: Mapping[str, Tensor]
) -> Trace:
    """The trace of a run in which the addresses `observed` were constrained."""
    hidden = {
        a: _one_each(v, ran.distributions[a], particles)
        for a, v in ran.values.items()
        if a not in observed and a not in ran.fixed
    }
    kind = SeriesTrace if isinstance(program, Stage) else Trace
    trace = kind(program, args, particles, hidden, dict(observed))
    trace._ran(ran)
    return trace


def _copied(observations: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Observations as a trace keeps them: an array that is written to again does not change it."""
    refuse_other_than_tensors(observations)
    return {address: value.detach().clone() for address, value in observations.items()}


def _refuse_poses_in_plates(trace: Trace, old: Mapping[str, Tensor]) -> None:
    """A latent pose is one for each particle: proposals, kernels and beliefs read it so."""
    for address, value in trace.choices.items():
        if value.shape[-1:] == (7,) and value.ndim != 2 and address not in old:
            refuse_several_poses(address, value, trace.distributions[address])


def _one_each(value: Tensor, site: Any, particles: int) -> Tensor:
    """A latent value as a trace holds it: one for each particle."""
    if value.ndim == len(site.batch_shape) - 1 + len(site.event_shape):
        value = value.expand(particles, *value.shape).clone()
    return value


def _real(choices: Mapping[str, Tensor], ran: Run) -> None:
    """Whole numbers given for a real site are made real: kernels would round what they move."""
    for address, value in choices.items():
        with suppress(NotImplementedError):
            if not value.is_floating_point() and not ran.distributions[address].support.is_discrete:
                ran.values[address] = value.to(torch.float64)


def refuse_unvisited(observations: Mapping[str, Tensor], ran: Run) -> None:
    """An error that names an address that a value was given for and that was not visited."""
    missing = [a for a in observations if a not in ran.distributions]
    if missing:
        raise InputError(
            f"an observation was given for address {missing[0]!r}, which the program never visits; "
            f"it visits {', '.join(ran.distributions) or 'none'}."
        )


def _refuse_one_each(observations: Mapping[str, Tensor], ran: Run, particles: int) -> None:
    """An observation is the same for all particles: resampling would not carry one for each along."""
    for address, value in observations.items():
        site = ran.distributions[address]
        one = (*site.batch_shape[:-1], *site.event_shape)
        if tuple(value.shape) != one and particles > 1:
            raise InputError(
                f"the observation at address {address!r} has shape {tuple(value.shape)}, "
                f"its site's plates and event {one}; give one value, the same for all particles."
            )


def simulate(program: Program | Series, args: tuple[Any, ...] = (), particles: int = 1) -> Trace:
    """Run a program forward: every site is sampled, what would be observed included.

    Raises:
        InputError: see `bcppl.traces.run.run`.
    """
    program = runnable(program)
    ran = run(program, args, particles, {}, {})
    refuse_coincidence(program, args, particles, ran)
    return trace_of(program, args, particles, ran, {})


def generate(
    program: Program | Series,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    particles: int,
    choices: Mapping[str, Tensor] | None = None,
) -> tuple[Trace, Tensor]:
    """Run a program with some sites constrained, the others drawn from the program itself.

    Args:
        program: a Pyro program.
        args: its arguments.
        particles: N.
        observations: values by address, of the shape of the site's plates and event: the same for all
            particles. They are copied.
        choices: values (N, ...) of latent addresses, such as a proposal gave; the others are drawn. One value
            without the particle axis is that of all particles.

    Returns:
        The trace and the log weight (N,): the summed log-probability of what was constrained and of the
        choices that were given.

    Raises:
        InputError: an observed address is never visited, an observation has not its site's shape, or a
            choice is of an observed address or one never visited, or a latent pose lies in a plate;
            see also `bcppl.traces.run.run`.
    """
    program, choices, observations = runnable(program), choices or {}, _copied(observations)
    again = [a for a in choices if a in observations]
    if again:
        raise InputError(f"address {again[0]!r} is observed and given a value for each particle; give one.")
    given = {**observations, **choices}
    ran = run(program, args, particles, given, {})
    refuse_unvisited(given, ran)
    refuse_coincidence(program, args, particles, ran)
    _real(choices, ran)
    _refuse_one_each(observations, ran, particles)
    trace = trace_of(program, args, particles, ran, observations)
    _refuse_poses_in_plates(trace, {})
    constrained = [a for a in ran.distributions if a in given or a in ran.fixed]
    return trace, _weight(trace, constrained)


def extend(
    trace: Trace,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    choices: Mapping[str, Tensor] | None = None,
) -> tuple[Trace, Tensor]:
    """Run the program on with new arguments (more measurements): only the new sites are evaluated.

    Values at the old addresses stay; new latent sites are drawn from the program. The old sites are taken to
    have the distributions they had.

    A series (`bcppl.traces.Series`) is run on by one step, whose arguments and observations are given; then
    it is the step's sites that are new.

    Args:
        trace: what is extended.
        args: the new arguments.
        observations: values of new addresses; they are copied.
        choices: values (N, ...) of new latent addresses, such as a proposal gave; those that are left out are
            drawn from the program.

    Returns:
        The longer trace and its log weight (N,): the log-probability of the new observations and of the
        choices that were given.

    Raises:
        InputError: an address vanishes, or an observation or a choice is of an old address, of one never
            visited, or of the wrong shape, or a new latent pose lies in a plate.
    """
    choices, observations = choices or {}, _copied(observations)
    if isinstance(trace, SeriesTrace):
        return _stepped(trace, args, observations, choices)
    old = {**trace.choices, **trace.observations}
    again = [a for a in (*observations, *choices) if a in old]
    if again:
        raise InputError(
            f"address {again[0]!r} was observed or sampled before; extend takes new addresses only."
        )
    ran = run(trace.program, args, trace.particles, {**old, **observations, **choices}, trace.carried)
    refuse_unvisited({**observations, **choices}, ran)
    refuse_coincidence(trace.program, args, trace.particles, ran, old)
    _real(choices, ran)
    _refuse_one_each(observations, ran, trace.particles)
    lost = [a for a in old if a not in ran.distributions]
    if lost:
        raise InputError(f"with the new arguments the program no longer visits address {lost[0]!r}.")
    longer = trace_of(trace.program, args, trace.particles, ran, {**trace.observations, **observations})
    _refuse_poses_in_plates(longer, old)
    longer.known.update(trace.known)
    fixed = ran.fixed.difference(trace.distributions) if ran.fixed else ran.fixed
    new = [a for a in ran.distributions if a in observations or a in choices or a in fixed]
    return longer, _weight(longer, new)


def _stepped(
    trace: SeriesTrace,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    choices: Mapping[str, Tensor],
) -> tuple[Trace, Tensor]:
    """A series run on by one step."""
    program, given = trace.next_stage(), {**observations, **choices}
    ran = run(program, args, trace.particles, given, trace.carried)
    refuse_unvisited(given, ran)
    _real(choices, ran)
    if program.number == 1:
        refuse_coincidence(program, args, trace.particles, ran)
    _refuse_one_each(observations, ran, trace.particles)
    longer = trace_of(program, args, trace.particles, ran, observations)
    if program.number == 1:
        _refuse_poses_in_plates(longer, {})
    return longer, _weight(longer, [a for a in ran.distributions if a in given or a in ran.fixed])


def _weight(trace: Trace, constrained: list[str]) -> Tensor:
    """The log-probability (N,) of what was constrained; zeros where nothing was."""
    if not constrained:
        return torch.zeros(trace.particles, dtype=torch.float64)
    # A caller may go on with the weights in place: what the trace knows is not theirs.
    return trace.log_prob(*constrained).clone()

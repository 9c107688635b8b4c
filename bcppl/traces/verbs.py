"""The verbs that make traces, Gen's: simulate runs a program forward, generate constrains some of its sites.

Cusumano-Towner et al., Gen: a general-purpose probabilistic programming system with programmable inference,
PLDI 2019, section 4 (the generative function interface). All of them act on N particles at once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.support import refuse_several_poses
from bcppl.errors import InputError
from bcppl.traces.carried import Entry
from bcppl.traces.coincidence import refuse_coincidence
from bcppl.traces.run import Program, Run, refuse_other_than_tensors, run
from bcppl.traces.series import Series, SeriesTrace, Stage, runnable
from bcppl.traces.trace import Trace, refuse_masked


def simulate(program: Program | Series, args: tuple[Any, ...] = (), particles: int = 1) -> Trace:
    """Run a program forward: every site is sampled, those that would be observed included.

    Raises:
        InputError: see `bcppl.traces.run.run`.
    """
    program = runnable(program)
    ran = run(program, args, particles, {}, {})
    refuse_coincidence(program, args, particles, ran)
    return kind_of(program).of_run(program, args, particles, ran, {})


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
        observations: values by address, of the shape of the site's plates and event: the same for all
            particles. They are copied.
        particles: N.
        choices: values (N, ...) of latent addresses, such as a proposal gave; the others are drawn. One value
            without the particle axis is that of all particles.

    Returns:
        The trace and the log weight (N,): the summed log-probability of the observations and of the choices
        that were given.

    Raises:
        InputError: an observed address is never visited, an observation has not its site's shape, or a
            choice is of an observed address or one never visited, or a latent pose lies in a plate, or a
            latent site is masked; see also `bcppl.traces.run.run`.
    """
    trace, weighed = constrained(runnable(program), args, particles, observations, choices or {})
    for address in trace.choices:
        refuse_masked(address, trace._run.distributions[address])
    return trace, log_weight(trace, weighed)


def constrained(
    program: Program,
    args: tuple[Any, ...],
    particles: int,
    observations: Mapping[str, Tensor],
    choices: Mapping[str, Tensor],
    carried: Mapping[str, Entry] | None = None,
) -> tuple[Trace, list[str]]:
    """A program run from the beginning, or one step of a series, and the addresses that weigh it.

    See `generate`.
    """
    observations = copied(observations)
    again = [a for a in choices if a in observations]
    if again:
        raise InputError(f"address {again[0]!r} is observed and given a value for each particle; give one.")
    given = {**observations, **choices}
    ran = run(program, args, particles, given, carried or {})
    refuse_unvisited(given, ran)
    trace = kind_of(program).of_run(program, args, particles, ran, observations)
    # The steps of a series after the first visit what that has visited.
    later = isinstance(program, Stage) and program.number > 1
    refuse_unfit(trace, observations, trace.addresses if later else ())
    return trace, [a for a in ran.distributions if a in given or a in ran.fixed]


def log_weight(trace: Trace, addresses: list[str]) -> Tensor:
    """The summed log-probability (N,) of the sites that were constrained."""
    if not addresses:
        return torch.zeros(trace.particles, dtype=torch.float64)
    # A caller may go on with the weights in place: the trace keeps its own.
    return trace.log_prob(*addresses).clone()


def kind_of(program: Program) -> type[Trace]:
    """The class of a program's traces."""
    return SeriesTrace if isinstance(program, Stage) else Trace


def copied(observations: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Observations as a trace keeps them: an array that is written to again does not change it."""
    refuse_other_than_tensors(observations)
    return {address: value.detach().clone() for address, value in observations.items()}


def refuse_unvisited(given: Iterable[str], ran: Run) -> None:
    """Refuse a value that was given for an address that was not visited.

    Raises:
        InputError: names the address.
    """
    missing = [a for a in given if a not in ran.distributions]
    if missing:
        raise InputError(
            f"an observation was given for address {missing[0]!r}, which the program never visits; "
            f"it visits {', '.join(ran.distributions) or 'none'}."
        )


def refuse_unfit(trace: Trace, observations: Mapping[str, Tensor], old: Collection[str]) -> None:
    """Refuse what does not fit the particles: an observation or the sites at other than `old` addresses.

    Raises:
        InputError: the program fits N particles by coincidence; an observation is given for each particle,
            which resampling would not reorder; or a latent pose lies in a plate, while proposals, kernels
            and beliefs take one for each particle.
    """
    ran, particles = trace._run, trace.particles
    refuse_coincidence(trace.program, trace.args, particles, ran, old)
    for address, value in observations.items():
        site = ran.distributions[address]
        one = (*site.batch_shape[:-1], *site.event_shape)
        if tuple(value.shape) != one and particles > 1:
            raise InputError(
                f"the observation at address {address!r} has shape {tuple(value.shape)}, "
                f"its site's plates and event {one}; give one value, the same for all particles."
            )
    for address, value in trace.choices.items():
        if value.shape[-1:] == (7,) and value.ndim != 2 and address not in old:
            refuse_several_poses(address, value, ran.distributions[address])

"""The verbs that run programs, Gen's: simulate, generate, and for proposals propose and assess.

Cusumano-Towner et al., Gen: a general-purpose probabilistic programming system with programmable inference,
PLDI 2019, section 4 (the generative function interface). All of them act on N particles at once.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bcppl.devices import on_device, to_device
from bcppl.distributions.support import freedom_of, refuse_several_poses
from bcppl.errors import InputError
from bcppl.traces.carried import Entry
from bcppl.traces.differentiation.graph import kept
from bcppl.traces.faults import Fault, ProgramError
from bcppl.traces.indexing import indexed
from bcppl.traces.run import Program, Run, run
from bcppl.traces.series import Series, SeriesTrace, Stage, runnable
from bcppl.traces.trace import Trace, refuse_masked_latents
from bcppl.traces.values import Value, held, shapes, tensors

WEIGHTED = ("extend", "update")  # verbs in whose place `bcppl.inference` has one for populations
# A vector that was meant as one event is unlikely to have more entries.
FEW = 20


def refuse_no_trace(where: str, given: Any) -> None:
    """Refuse what is no trace."""
    if not isinstance(given, Trace):
        own = "; give its `.trace`" if hasattr(given, "trace") else ""
        also = ", or weigh all by bcppl.inference.update" if own and where in WEIGHTED else ""
        raise InputError(f"{where} is given a {type(given).__name__} in place of a trace{own}{also}.")


def simulate(program: Program | Series, args: tuple[Any, ...] = (), particles: int = 1) -> Trace:
    """Run a program forward: every site is sampled, those that would be observed included.

    Raises:
        InputError: see `bcppl.traces.run.run`.
    """
    program, args = runnable(program), held(args)
    ran = run(program, args, particles, {}, {})
    _refuse_coincidence(program, args, particles, ran)
    return _traced(program, args, particles, ran)


def generate(
    program: Program | Series,
    args: tuple[Any, ...],
    observations: Mapping[str, Value],
    particles: int,
    choices: Mapping[str, Value] | None = None,
) -> tuple[Trace, Tensor]:
    """Run a program with some sites constrained, the others drawn from the program itself.

    Args:
        program: a Pyro program.
        args: its arguments.
        observations: tensors, arrays or numbers by address, of the shape of the site's plates and event: the
            same for all particles. They are copied; floats become float64.
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
    return trace, log_weight(trace, weighed)


@dataclass(frozen=True, eq=False, repr=False)
class Proposed:
    """Choices by address (N, *event), their log-density (N,) under the program, and its result."""

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


def assess(
    program: Program | Series, args: tuple[Any, ...], choices: Mapping[str, Value], particles: int
) -> Tensor:
    """Log-density (N,) of a program at given values for all of its choices.

    Raises:
        InputError: a choice is missing, or an address is never visited.
    """
    return assessed(program, args, choices, particles).log_prob()


def assessed(
    program: Program | Series, args: tuple[Any, ...], choices: Mapping[str, Value], particles: int
) -> Trace:
    """The trace of a program at given values for all of its choices; it raises what `assess` does."""
    program, args = runnable(program), held(args)
    ran = run(program, args, particles, choices, {})
    _refuse_fixed(ran)
    ran.refuse_unvisited(choices)
    _refuse_coincidence(program, args, particles, ran)
    missing = [a for a in ran.values if a not in choices and a not in ran.fixed]
    if missing:
        raise InputError(
            f"assess needs a value for address {missing[0]!r}; give one for every choice of the program."
        )
    return _traced(program, args, particles, ran)


def constrained(
    program: Program,
    args: tuple[Any, ...],
    particles: int,
    observations: Mapping[str, Value],
    choices: Mapping[str, Value],
    carried: Mapping[str, Entry] | None = None,
) -> tuple[Trace, list[str]]:
    """A program run as by `generate`, or one step of a series, and the addresses that weigh it."""
    observations, args = copied(observations), held(args)
    again = [a for a in choices if a in observations]
    if again:
        raise InputError(f"address {again[0]!r} is observed and given a value for each particle; give one.")
    given = {**observations, **choices}
    ran = run(program, args, particles, given, carried or {})
    ran.refuse_unvisited(given)
    trace = _traced(program, args, particles, ran, observations)
    refuse_masked_latents(trace)
    # The steps of a series after the first visit what that has visited.
    later = isinstance(program, Stage) and program.number > 1
    refuse_unfit(trace, observations, trace.addresses if later else ())
    return trace, [a for a in ran.distributions if a in given or a in ran.fixed]


def trace_to_device(trace: Trace, device: torch.device) -> Trace:
    """The same particles on a device: their values and arguments are moved there, where they are not."""
    if all(value.device == device for value in trace.choices.values()):
        return trace
    with on_device(device):
        args, choices = to_device((trace.args, trace.choices), device)
        return constrained(trace.program, args, trace.particles, trace.observations, choices)[0]


def log_weight(trace: Trace, addresses: list[str]) -> Tensor:
    """The summed log-probability (N,) of the sites that were constrained."""
    if not addresses:
        return torch.zeros(trace.particles, dtype=torch.float64)
    # A caller may go on with the weights in place: the trace keeps its own.
    return trace.log_prob(*addresses).clone()


def _traced(
    program: Program,
    args: tuple[Any, ...],
    particles: int,
    ran: Run,
    observations: Mapping[str, Tensor] | None = None,
) -> Trace:
    kind = SeriesTrace if isinstance(program, Stage) else Trace
    return kind.of_run(program, args, particles, ran, observations or {})


def copied(observations: Mapping[str, Value]) -> dict[str, Tensor]:
    """Observations as a trace keeps them: an array that is written to again does not change it."""
    values = tensors(observations).items()
    return {a: value.clone() if kept() else value.detach().clone() for a, value in values}


def _refuse_fixed(ran: Run) -> None:
    """Refuse a program that observes something itself: that has no density of being chosen."""
    if ran.fixed:
        raise InputError(
            f"a program that is to propose or to be assessed observes {min(ran.fixed)!r} itself (`obs=` or "
            "`pyro.factor`); take that out, and give values as observations."
        )


def refuse_unfit(trace: Trace, observations: Mapping[str, Tensor], old: Collection[str]) -> None:
    """Refuse what does not fit the particles: an observation or the sites at other than `old` addresses."""
    ran, particles = trace._run, trace.particles
    _refuse_coincidence(trace.program, trace.args, particles, ran, old)
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
            refuse_several_poses(address, value, freedom_of(ran.distributions[address]))


def _refuse_coincidence(
    program: Program, args: tuple[Any, ...], particles: int, ran: Run, old: Collection[str] = ()
) -> None:
    """Run a program once more, for N + 1 particles, where its shapes may fit N of them alone.

    That is where a plate or an axis of an event has N entries, or the first site, of few particles, has N
    before it is expanded to them; sites at `old` addresses were checked before. All sites are set, the last
    particle to the first one's values: nothing is drawn and no simulator is run. A proposal that reads a
    trace is not checked: it is made for the trace's particles.
    """
    # A program's first site depends on no sampled value, so that N entries are a coincidence where N is small
    # and intended where it is large. A later step of a series begins from the state, which has N.
    begins = particles <= FEW and (not isinstance(program, Stage) or program.before is None)
    suspects = ran.coincident | ran.whole if begins else ran.coincident
    if not suspects.difference(old) or any(hasattr(arg, "particles") for arg in args):
        return
    index = torch.cat([torch.arange(particles), torch.tensor([0])])
    given = {
        a: _one_more(v, ran.distributions[a], index) for a, v in ran.values.items() if a not in ran.fixed
    }
    carried = {name: entry.take(index) for name, entry in ran.carried.items()}
    larger = program.take(index) if isinstance(program, Stage) else program
    state = torch.get_rng_state()
    try:
        again = run(larger, args, particles + 1, given, carried)
        if isinstance(larger, Stage):
            indexed(again.result, None, particles + 1)
    except InputError as error:
        raise ProgramError(
            Fault.COUNT,
            None,
            f"with {particles} particles the shapes fit by coincidence alone; with one more, "
            f"{str(error).removesuffix('.')}.",
        ) from error
    finally:
        torch.set_rng_state(state)


def _one_more(value: Tensor, distribution: Any, index: Tensor) -> Tensor:
    shared = value.ndim == len(distribution.batch_shape) - 1 + len(distribution.event_shape)
    return value if shared else value[index]

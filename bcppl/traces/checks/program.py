"""The check of a program, a series or a model, by the checks of this folder in turn."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch

from bcppl.errors import InputError
from bcppl.traces.checks.comparing import Start, log_probs
from bcppl.traces.checks.densities import check_densities, check_numbers
from bcppl.traces.checks.gradients import check_gradients
from bcppl.traces.checks.particles import check_particles
from bcppl.traces.checks.runs import check_addresses, check_reruns, check_values, undisturbed
from bcppl.traces.checks.updates import check_simulated, check_updates
from bcppl.traces.model import Model
from bcppl.traces.run import Program
from bcppl.traces.series import Series, SeriesTrace, runnable
from bcppl.traces.trace import Trace
from bcppl.traces.values import Value
from bcppl.traces.verbs import constrained

# Arguments and observations of a program, or of one step of a series.
Case = tuple[tuple[Any, ...], Mapping[str, Value]]


def check_program(
    program: Program | Series | Model,
    args: Any = (),
    observations: Mapping[str, Value] | None = None,
    particles: int = 10,
    *,
    steps: Sequence[Case] = (),
) -> None:
    """Check that a program is one that traces, weights and kernels are right for.

    The program is run at values from its prior, then: again at other values (are the addresses the same?);
    again at the same values (is anything random, or left behind by a run?); with some particles' values
    replaced, in another order, and for fewer particles (is each particle's density its own?); by `update`
    instead of a new run (is a dependence missed?), and with all sites sampled. Draws of a site are compared
    with its density, and gradients with differences. The random state is the same afterwards as before.

    Args:
        program: a Pyro program; a series, of which `init` is checked and then each of `steps`; or a model.
        args: the arguments of the program or of `init`; for a model, a recording: its first measurements
            are enough, `replace(recording, measurements=recording.measurements[:3])`.
        observations: values by address; sites that are left out are latent. None for a model.
        particles: N, 3 or more.
        steps: of a series, the arguments and the observations of each step.

    Raises:
        ProgramError: the first mistake that shows: its kind is `fault`, its address `site`.
        InputError: the program does not run, or there are fewer than 3 particles.
    """
    if particles < 3:
        raise InputError(f"a program is to be checked with {particles} particles; give 3 or more.")
    if isinstance(program, Model):
        program, (args, observations), steps = _cases(program, args)
    with undisturbed():
        for start, given in _starts(program, (args, observations or {}), steps):
            check_addresses(start, particles, given, program)
            check_numbers(start, particles)
            trace = start(particles)
            # Evaluated before any other run could change what a site of it reads.
            log_probs(trace)
            log_probs(other := _another(trace))
            check_values(trace)
            check_reruns(trace, other, given, program)
            check_particles(trace, other)
            check_updates(trace, other)
            check_simulated(trace)
            check_densities(trace)
            check_gradients(trace)


def _cases(model: Model, recording: Any) -> tuple[Program | Series, Case, list[Case]]:
    """A model's program, with what a recording's measurements make of its arguments and observations."""
    scene, measurements = model.prepare(recording), list(recording.measurements)
    if not isinstance(model.program, Series):
        case: Case = (scene, [each.action for each in measurements]), model.observe(scene, measurements)
        return model.program, case, []
    steps: list[Case] = [((scene, [each.action]), model.observe(scene, [each])) for each in measurements]
    return model.program, ((scene, []), {}), steps


def _starts(
    program: Program | Series, first: Case, steps: Sequence[Case]
) -> Iterator[tuple[Start, tuple[Any, ...]]]:
    """What makes traces of the program, or of `init` and each step, and the arguments it is given."""
    start = _first(runnable(program), first)
    yield start, first[0]
    for case in steps:
        start = _next(start, case)
        yield start, case[0]


def _first(program: Program, case: Case) -> Start:
    return lambda particles: constrained(program, case[0], particles, case[1], {})[0]


def _another(trace: Trace) -> Trace:
    """A trace at other values; of a series, of the same step from the states of the other particles."""
    other, _ = constrained(trace.program, trace.args, trace.particles, trace.observations, {})
    return other[torch.arange(trace.particles).roll(1)] if isinstance(other, SeriesTrace) else other


def _next(start: Callable[[int], Trace], case: Case) -> Start:
    def longer(particles: int) -> Trace:
        trace = start(particles)
        assert isinstance(trace, SeriesTrace)
        return constrained(trace.next_stage(), case[0], particles, case[1], {}, trace.carried)[0]

    return longer

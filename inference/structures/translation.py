"""Trace translators: particles of one program or structure turned into particles of another, and weighed.

Cusumano-Towner, Bichsel, Gehr, Vechev and Mansinghka, Incremental inference for probabilistic programs, PLDI
2018; the map between the values is that of Green, Reversible jump Markov chain Monte Carlo computation and
Bayesian model determination, Biometrika 82, 1995, eq. 7. A pair of programs defines it, as in SMCP3 (Lew et
al., AISTATS 2023): each chooses auxiliary values at random and returns new values and the choices of the
other that undo it. So a translator and its inverse are written once, and serve in both directions.

    def split(trace):                                   # one mean becomes two
        gap = pyro.sample("gap", dist.HalfNormal(one))
        return {"mean_0": trace["mean_0"] - gap, "mean_1": trace["mean_0"] + gap}, {}

    def merged(trace):                                  # and two become one
        centre, gap = (trace["mean_0"] + trace["mean_1"]) / 2, (trace["mean_1"] - trace["mean_0"]) / 2
        return {"mean_0": centre}, {"gap": gap}
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.filters.smcp3 import (
    BACKWARD,
    FORWARD,
    NEW,
    OLD,
    refuse_observed_choices,
    refuse_other_choices,
)
from bcppl.inference.kernels.jacobian import (
    Key,
    Point,
    charted,
    log_abs_det_jacobian,
    refuse_apart,
    refuse_leaving,
    refuse_unequal,
)
from bcppl.inference.population import Population
from bcppl.traces import Program, Trace, generate, simulate
from bcppl.traces.differentiation.programs import result_with_grad, with_gradients
from bcppl.traces.values import Values, shapes
from bcppl.traces.verbs import assessed


class Translated(NamedTuple):
    """Traces of another program or structure, and what their weights owe to the way they came.

    Attributes:
        trace: of N particles.
        log_factor: (N,) log of the backward programs' density over the forward ones', times the Jacobian
            determinant. Times the ratio of the targets' densities, it is the weight of a translation, and a
            Metropolis-Hastings ratio.
    """

    trace: Trace
    log_factor: Tensor


def translated(
    old: Trace, forward: Program, backward: Program, renewed: Callable[[Values], Trace], check: bool = False
) -> Translated:
    """Traces translated by a pair of programs.

    Latent addresses that both traces have keep their values, if the forward program returns no others. New
    ones to which it gives no value are sampled from the model; so are, in reverse, old ones that are visited
    no more and to which the backward program gives no value.

    Args:
        old: of N particles.
        forward: reads the old trace.
        backward: reads the new trace.
        renewed: the trace of the other program at the values that are given, the others kept or sampled.
        check: check that the backward program undoes the forward one, that the Jacobians of both cancel, and
            that particles are not mixed.

    Raises:
        InputError: a program gives an address that is not visited, more coordinates than it takes, or
            (checked) the programs do not undo each other.
    """
    count = old.particles
    chosen = simulate(forward, (old,), count)
    refuse_observed_choices("forward", chosen.choices, old)
    values, back = _read("forward", chosen.result, chosen.choices)
    new = renewed(values)
    _refuse_other_than_latent("forward", values, new)
    sampled = [a for a in new.choices if a not in values and a not in old.choices]
    # A program that only samples has as its choices, in reverse, the values that were there before.
    if back is None:
        back = {a: old.choices[a] for a in simulate(backward, (new,), count).choices if a in old.choices}
    reverse = assessed(backward, (new,), back, count)
    refuse_observed_choices("backward", reverse.choices, new)
    undone, forth = _read("backward", reverse.result, reverse.choices)
    lost = [a for a in old.choices if a not in new.choices and a not in undone]
    before = {a: v for a, v in old.choices.items() if a not in lost}
    after = {a: v for a, v in new.choices.items() if a not in sampled}
    inputs = charted(OLD, before, old.distributions)
    for address in set(before).intersection(after):
        refuse_leaving(address, inputs[OLD, address].chart, before[address], after[address])
    inputs |= charted(FORWARD, chosen.choices, chosen.distributions)
    outputs = charted(NEW, after, new.distributions) | charted(BACKWARD, back, reverse.distributions)

    there = partial(_mapped, "forward", forward, old, inputs, outputs)
    log_jacobian = zero = torch.zeros(count, dtype=torch.float64)
    if inputs or outputs:
        log_jacobian = log_abs_det_jacobian(there, inputs, outputs, check=check)
    if check:
        forth = {a: new[a] for a in chosen.choices if a in new.choices} if forth is None else forth
        refuse_other_choices(chosen.choices, forth)
        ends = {(OLD, a): undone[a] if a in undone else new[a] for a in before}
        refuse_apart("the backward program", inputs, ends | {(FORWARD, a): v for a, v in forth.items()})
        if inputs or outputs:
            undo = partial(_mapped, "backward", backward, new, outputs, inputs)
            refuse_unequal("a translator", log_jacobian, log_abs_det_jacobian(undo, outputs, inputs), inputs)
    log_chosen = chosen.log_prob()
    log_sampled = new.log_prob(*sampled) if sampled else zero
    log_lost = old.log_prob(*lost) if lost else zero
    log_factor = reverse.log_prob() + log_lost - log_chosen - log_sampled + log_jacobian
    # A choice without density has left the range of its type (see `metropolis_hastings`).
    return Translated(new, torch.where(log_chosen + log_sampled == -torch.inf, -torch.inf, log_factor))


def translate(
    population: Population,
    forward: Program,
    backward: Program,
    program: Program,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
) -> Population:
    """A population of one program turned into one of another, weighted for it.

    Its evidence estimates that of the other program, without bias where that of the population has none.

    Args:
        population: of N particles, of the first program.
        forward: reads a trace of the first program, returns values of latent addresses of the second and
            choices of `backward`.
        backward: reads a trace of the second program, returns values of latent addresses of the first and
            choices of `forward`.
        program: the second one. Latent addresses of the same name keep their values, if none are returned.
        args: its arguments.
        observations: values by address.

    Raises:
        InputError: see `translated`.
        NoWeightError: no particle has any weight left.
    """
    old = population.trace

    visited = generate(program, args, observations, 1)[0].choices

    def renewed(values: Values) -> Trace:
        kept = {a: v for a, v in old.choices.items() if a in visited}
        return generate(program, args, observations, len(old), {**kept, **values})[0]

    new, log_factor = translated(old, forward, backward, renewed)
    moved = replace(population, trace=new, approximation=None)
    return moved.reweighed(new.log_prob() - old.log_prob() + log_factor)


def sampling_nothing(trace: Trace) -> None:
    """A program that chooses nothing: new values are sampled from the model, and old ones kept."""


def _mapped(
    which: str, program: Program, trace: Trace, inputs: Point, outputs: Point, point: Mapping[Key, Tensor]
) -> dict[Key, Tensor]:
    """The other end of a translation, recomputed with gradients from a point of one end.

    Args:
        which: "forward" or "backward".
        program: reads the trace.
        trace: of N particles, at one end.
        inputs: its values and the program's choices.
        outputs: those at the other end.
        point: values in place of those of the inputs.
    """
    choosing = FORWARD if which == "forward" else BACKWARD
    start = {a: v for (kind, a), v in point.items() if kind != choosing}
    choices = {a: v for (kind, a), v in point.items() if kind == choosing}
    result = result_with_grad(program, (with_gradients(trace, start),), choices, trace.particles)
    given, returned = _read(which, result, choices)
    returned = start if returned is None else returned
    reached = {**start, **given}
    return {(kind, a): returned[a] if kind in (FORWARD, BACKWARD) else reached[a] for kind, a in outputs}


def _read(which: str, result: Any, choices: Values) -> tuple[Values, Values | None]:
    """New values and the other program's choices; None for those where the program returned nothing."""
    if result is None:
        return choices, None
    if isinstance(result, tuple) and len(result) == 2 and all(isinstance(r, Mapping) for r in result):
        return result
    raise InputError(
        f"the {which} program of a translator returns a {type(result).__name__}; return "
        "(values by latent address, choices of the other program), or nothing."
    )


def _refuse_other_than_latent(which: str, values: Values, trace: Trace) -> None:
    for address in values:
        if address not in trace.choices:
            raise InputError(
                f"the {which} program of a translator gives a value of {address!r}, which is no latent "
                f"address there; latent are {shapes(trace.choices)}."
            )

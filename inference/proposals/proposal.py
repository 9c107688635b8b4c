"""Proposals: Pyro programs that, given a trace, sample new values at latent addresses.

Each particle's new value depends on its own old values only. What a proposal learns from a population is
fixed before it runs, the same for the forward and the backward density, and comes from other particles than
those that it moves (`bcppl.inference.kernels.moved_by`). So a program must not read `trace["mu"].mean()`:
that is for `Fittable`, or for the functions `learned` of `metropolis_hastings(proposal, *learned)`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.traces import Program


@dataclass(frozen=True)
class Fittable:
    """A proposal that learns from a population before it runs: `fit(population) -> program(trace)`."""

    fit: Callable[[Population], Program]


Proposal = Program | Fittable


def program_of(
    proposal: Proposal, learned: Sequence[Callable[[Population], Any]], population: Population
) -> Program:
    """The program `program(trace)` of a proposal, fitted to a population.

    Raises:
        InputError: what is given is neither a program nor one that learns.
    """
    if not isinstance(proposal, Fittable) and not callable(proposal):
        raise InputError(
            f"{proposal!r} is given in place of a proposal; give a program, or a shipped one such as "
            "drift('x') from bcppl.inference.proposals."
        )
    program = proposal.fit(population) if isinstance(proposal, Fittable) else proposal
    values = [learn(population) for learn in learned]
    return (lambda trace: program(trace, *values)) if values else program

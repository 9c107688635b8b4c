"""What a proposal is: a Pyro program that, given a trace, chooses new values at latent addresses.

Each particle's new value hangs on its own old values only. What a proposal learns from a population is fixed
before it runs, is the same on the way back, and comes from other particles than those that it moves
(`bcppl.inference.kernels.rejuvenate`): so `trace["mu"].mean()` is not for a program to read, but for `Fitted`
or for what `metropolis_hastings(proposal, *learned)` is told to learn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from bcppl.inference.population import Population

Program = Callable[..., Any]


@dataclass(frozen=True)
class Fitted:
    """A proposal that learns from a population before it runs.

    Attributes:
        fit: `fit(population) -> program(trace)`.
    """

    fit: Callable[[Population], Program]


Proposal = Program | Fitted


def program_of(
    proposal: Proposal, learned: Sequence[Callable[[Population], Any]], population: Population
) -> Program:
    """The program `program(trace)` of a proposal that has learned what it wants from a population."""
    program = proposal.fit(population) if isinstance(proposal, Fitted) else proposal
    values = [learn(population) for learn in learned]
    return (lambda trace: program(trace, *values)) if values else program

"""What a kernel is, and how moved particles are put back.

A kernel is fitted to a weighted population, `kernel(population) -> move`, and a move is
`(trace, target) -> (trace, accepted (N,))` that leaves the target invariant. What a move learns from the
population is fixed before it runs. `accepted` is 1 where a particle took its proposal, 0 where it stayed, or
a share between the two for a move that is made of several.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.proposals.proposal import Fitted
from bcppl.inference.targets import Target
from bcppl.traces import Trace

Move = Callable[[Trace, Target], tuple[Trace, Tensor]]
Kernel = Callable[[Population], Move]


def fitted(kernel: Kernel, population: Population) -> Move:
    """The move of a kernel that has learned from a population.

    Raises:
        InputError: it is no kernel but a proposal.
    """
    refuse_other("a population", kernel)
    try:
        move = kernel(population)
    except AttributeError as error:
        if error.obj is not population:
            raise
        move = None
    if not callable(move):
        raise InputError(f"{_called(kernel)} gives no move, so it is no kernel; {WRAP}.")
    return move


WRAP = "if it is a proposal, wrap it in metropolis_hastings(...)"


def refuse_other(where: str, kernel: Any) -> None:
    """Refuse what cannot be a kernel.

    Raises:
        InputError: says what was given to whom, and what to do with it.
    """
    if isinstance(kernel, Fitted):
        raise InputError(
            f"{where} is given a proposal in place of a kernel; wrap it in metropolis_hastings(...)."
        )
    if not callable(kernel):
        raise InputError(
            f"{where} is given a {type(kernel).__name__} in place of a kernel; "
            "give one such as metropolis_hastings(drift(...))."
        )
    if not takes(kernel, 1):
        raise InputError(
            f"{where} is given {_called(kernel)} in place of a kernel, which would take a population; {WRAP}."
        )


def takes(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with so many arguments."""
    try:
        inspect.signature(function).bind(*[None] * count)
    except TypeError:
        return False
    except ValueError:  # what is written in C may not say
        return True
    return True


def refuse_observed(what: str, choices: Iterable[str], trace: Trace) -> None:
    """Refuse a program that samples at an address that the model observes: it would be taken as auxiliary.

    Raises:
        InputError: names the address.
    """
    for address in choices:
        if address not in trace.choices and address in trace.addresses:
            raise InputError(
                f"{what} samples {address!r}, which is observed; sample at latent addresses "
                f"({', '.join(trace.choices) or 'none'}), and give auxiliary choices names of their own."
            )


def spread(mask: Tensor, like: Tensor) -> Tensor:
    """A mask (N,) with as many axes as values (N, ...)."""
    return mask.reshape(-1, *[1] * (like.ndim - 1))


def _called(function: Any) -> str:
    return str(getattr(function, "__name__", type(function).__name__))


def replaced(population: Population, index: Tensor, moved: Trace) -> Population:
    """The population with the particles at `index` (K,) replaced by those of a trace of K particles."""
    trace = put(population.trace, index, moved)
    return population.with_trace(trace)


def put(trace: Trace, index: Tensor, other: Trace) -> Trace:
    """A trace with the particles at `index` (K,) replaced by those of a trace of K particles."""
    if len(index) == 0:
        return trace
    source = torch.zeros(len(trace), dtype=torch.int64)
    source[index] = torch.arange(len(index))
    mask = torch.zeros(len(trace), dtype=torch.bool)
    mask[index] = True
    return other[source].where(mask, trace)

"""Kernels, and the moves that they make.

A kernel is fitted to a weighted population, `kernel(population) -> move`, and a move is
`(trace, target) -> (trace, accepted (N,))` that leaves the target invariant. What a move learns from the
population is fixed before it runs. `accepted` is 1 where a particle took its proposal, 0 where it stayed, or
a share between the two for a move that is made of several.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.population import Population
from bcppl.inference.proposals.proposal import Fittable
from bcppl.inference.targets import Target
from bcppl.traces import Trace

Function = TypeVar("Function", bound=Callable[..., Any])
Move = Callable[[Trace, Target], tuple[Trace, Tensor]]
Kernel = Callable[[Population], Move]


def fitted(kernel: Kernel, population: Population) -> Move:
    """The move of a kernel that has learned from a population."""
    refuse_no_kernel("a population", kernel)
    population = weighted(population)
    try:
        move = kernel(population)
    except AttributeError as error:
        if error.obj is not population:
            raise
        move = None
    if not callable(move):
        raise InputError(f"{_name(kernel)} gives no move, so it is no kernel; {WRAP}.")
    return move


def is_reversible(kernel: Kernel) -> bool:
    """Whether moves obey detailed balance with respect to any target that they are given, a surrogate too.

    Those of `metropolis_hastings`, `hmc` and `involutive` do, and combinations of them but for a `sequence`
    that does not read the same backwards. A kernel of one's own does if it is `marked` so.
    """
    return _marks_of(kernel).reversible


def learns(kernel: Callable[..., Any]) -> bool:
    """Whether a kernel's moves depend on where the particles are that it is fitted to.

    Those of a proposal that learns (`Fittable`) and of `hmc` do, those of a program do not, and a kernel of
    one's own is taken to, unless it is `marked` otherwise. Moves that do not need no other particles: the
    whole population makes them at once.
    """
    return _marks_of(kernel).learns


@dataclass(frozen=True, eq=False)
class _Marks:
    """What is known of a kernel. One that wraps it, and may have copied its attributes, is another."""

    kernel: Any
    reversible: bool = False
    learns: bool = True
    of: Callable[[Population], Kernel] | None = None
    parts: Sequence[Kernel] | None = None


def _marks_of(kernel: Any) -> _Marks:
    known = getattr(kernel, "_marks", None)
    return known if isinstance(known, _Marks) and known.kernel is kernel else _Marks(kernel)


def marked(kernel: Function, *, reversible: bool = True, learns: bool = True) -> Function:
    """The kernel, with marks that `is_reversible` and `learns` read."""
    vars(kernel)["_marks"] = replace(_marks_of(kernel), reversible=reversible, learns=learns)
    return kernel


def composed(of: Callable[[Population], Kernel]) -> Kernel:
    """A kernel that is put together for each sweep: `of(population)` gives it.

    What is put together may depend on which sites the trace has and on the approximation that the population
    carries, and be drawn at random; not on where the particles are.
    """

    def kernel(population: Population) -> Move:
        return fitted(of(population), population)

    vars(kernel)["_marks"] = _Marks(kernel, of=of)
    return kernel


def in_sequence(kernel: Function, parts: Sequence[Kernel]) -> Function:
    """The kernel, known to be these one after another."""
    vars(kernel)["_marks"] = replace(_marks_of(kernel), parts=parts)
    return kernel


def parts_of(kernel: Kernel, population: Population) -> list[Kernel]:
    """The kernels that one which is composed, or a sequence, is made of for a population; else itself."""
    marks = _marks_of(kernel)
    if marks.of is not None:
        return parts_of(marks.of(population), population)
    if marks.parts is None:
        return [kernel]
    return [each for part in marks.parts for each in parts_of(part, population)]


def weighted(population: Population) -> Population:
    """The population that a move learns from: where no particle has weight, all have the same.

    A move is valid whatever it learns from other particles than those that it moves.
    """
    if bool((population.log_weights > -torch.inf).any()):
        return population
    return replace(population, log_weights=torch.zeros_like(population.log_weights))


WRAP = "wrap a proposal in metropolis_hastings(...)"


def refuse_no_kernel(where: str, kernel: Any) -> None:
    """Refuse what cannot be a kernel."""
    if isinstance(kernel, Fittable):
        given = "a proposal"
    elif not callable(kernel):
        given = f"a {type(kernel).__name__}"
    elif not takes(kernel, 1):
        given = _name(kernel)
    else:
        return
    raise InputError(f"{where} is given {given} in place of a kernel; {WRAP}.")


def takes(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with so many arguments."""
    try:
        inspect.signature(function).bind(*[None] * count)
    except TypeError:
        return False
    except ValueError:  # a function written in C may have no signature
        return True
    return True


def _name(function: Any) -> str:
    return str(getattr(function, "__name__", type(function).__name__))


def refuse_observed(what: str, choices: Iterable[str], trace: Trace) -> None:
    """Refuse a program that samples at an observed address: its choice would be taken as auxiliary."""
    for address in choices:
        if address not in trace.choices and address in trace.addresses:
            raise InputError(
                f"{what} samples {address!r}, which is observed; sample at latent addresses "
                f"({', '.join(trace.choices) or 'none'}), and give auxiliary choices names of their own."
            )


def decided(target: Target, trace: Trace, proposed: Trace, log_ratio: Tensor) -> tuple[Trace, Tensor]:
    """The particles after a Metropolis-Hastings decision, and whether each took its proposal (N,).

    The log-ratio (N,) is the log-density of the reverse proposal minus that of the proposal, with Jacobian.
    """
    index, taken = target.accept(trace, proposed, log_ratio)
    accepted = torch.zeros(trace.particles, dtype=torch.float64)
    accepted[index] = 1.0
    return scattered(trace, index, taken), accepted


def scattered(trace: Trace, index: Tensor, source: Trace) -> Trace:
    """A trace with the particles at `index` (K,) replaced by those of a trace of K particles."""
    return trace.replaced(index, source) if len(index) else trace

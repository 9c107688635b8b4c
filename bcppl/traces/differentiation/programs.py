"""Programs run again with gradients, which traces do without: log-densities and results to differentiate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial, wraps
from typing import Any

import pyro
import torch
from torch import Tensor

from bcppl.distributions.support import density_argument
from bcppl.errors import InputError
from bcppl.traces.dependence.equality import alike, equal
from bcppl.traces.run import Program, Run, inward, run
from bcppl.traces.trace import Trace


def differentiable(program: Program) -> Program:
    """The same program, keeping gradients also where it is run without."""

    @wraps(program)
    def graded(*args: Any) -> Any:
        with torch.enable_grad():
            return program(*args)

    return graded


def with_gradients(trace: Trace, values: Mapping[str, Tensor]) -> Trace:
    """The trace at values that ask for gradients, to which its distributions are attached."""
    choices = {**trace.choices, **values}
    program = differentiable(trace.program)
    return replace(trace, program=program, choices=choices, carried=dict(trace.carried), known={})


def result_with_grad(
    program: Program, args: tuple[Any, ...], choices: Mapping[str, Tensor], particles: int
) -> Any:
    """The result of a program at values of all its choices, attached to those that ask for gradients."""
    return run(differentiable(program), args, particles, choices, {}).result


def log_prob_with_grad(
    trace: Trace, values: Mapping[str, Tensor], exponents: Mapping[str, float] | None = None
) -> Tensor:
    """Log-density of a trace at other values of some latent addresses, attached to these values.

    Args:
        trace: of N particles.
        values: (N, *event) by address, asking for gradients.
        exponents: by address, as in a tempered target; a site that is not named counts in full.

    Returns:
        (N,) float64, without the sites that depend on none of the values: these add a constant. One that
        depends on them and runs a simulator, or passes no gradient on, is refused.
    """
    given, before = {**trace.choices, **trace.observations, **values}, trace._run.distributions
    program = differentiable(trace.program)
    ran: Run = _refusing(partial(run, program, trace.args, trace.particles, given, trace.carried), "", values)
    total = torch.zeros(trace.particles, dtype=torch.float64, device=next(iter(values.values())).device)
    with torch.enable_grad(), pyro.validation_enabled(False):
        for address, distribution in ran.distributions.items():
            parameters, depends = _parameters(before[address], distribution)
            if depends is False and not ran.values[address].requires_grad:
                continue
            if depends is not False and getattr(distribution, "cost", 0) > 0:
                _refuse(address, "runs a simulator, which passes no gradient on", parameters, values)
            exponent = 1.0 if exponents is None else exponents.get(address, 1.0)
            if exponent == 0.0:
                continue
            value = density_argument(distribution, inward(ran.values[address], distribution))
            density = _refusing(partial(distribution.log_prob, value), address, values)
            if depends and not density.requires_grad:
                _refuse(address, "passes no gradient on", parameters, values)
            # Plates lie to the left of the particles.
            density = density.to(torch.float64).expand(distribution.batch_shape)
            total = total + exponent * density.reshape(-1, trace.particles).sum(dim=0)
    return total


def _parameters(before: Any, now: Any) -> tuple[list[Tensor], bool | None]:
    """The tensors of a distribution that ask for gradients, and whether it depends on the new values.

    None where its structure is not understood (`bcppl.traces.dependence.equality`).
    """
    parameters, changed = [], []

    def met(a: Any, b: Any) -> bool:
        if isinstance(b, Tensor) and b.requires_grad:
            parameters.append(b)
        elif not equal(a, b):
            changed.append(b)  # it was taken out of torch and carries no gradient
        return True

    understood = alike(before, now, met)
    return parameters, True if parameters or changed else False if understood else None


def _refuse(address: str, why: str, parameters: list[Tensor], values: Mapping[str, Tensor]) -> None:
    moved = list(values)
    if parameters:
        total = torch.stack([value.sum().to(torch.float64) for value in parameters]).sum()
        gradients = torch.autograd.grad(total, list(values.values()), allow_unused=True)
        moved = [a for a, gradient in zip(values, gradients, strict=True) if gradient is not None]
    raise InputError(
        f"site {address!r} depends on {', '.join(map(repr, moved))} and {why}; "
        "move that address with a proposal that needs no gradient."
    )


def _refusing(evaluate: Callable[[], Any], address: str, values: Mapping[str, Tensor]) -> Any:
    """The result of `evaluate`; a conversion out of torch is an error that names it."""
    try:
        return evaluate()
    except RuntimeError as error:
        if "requires grad" not in str(error):
            raise
        where = f"site {address!r}" if address else "the program"
        raise InputError(
            f"{where} takes {' or '.join(map(repr, values))} out of torch, which no gradient survives; "
            "move that address with a proposal that needs no gradient."
        ) from error

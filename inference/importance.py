"""Importance sampling, plain or tempered: the first step of SMC, or an estimate of evidence and posterior.

Robert and Casella, Monte Carlo Statistical Methods, 2004, section 3.3.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.filters.step import Stepped
from bcppl.inference.filters.tempering import Tempered
from bcppl.inference.population import Population
from bcppl.traces import Series, generate, propose

Program = Callable[..., Any]


def importance_sampling(
    program: Program | Series,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    particles: int,
    proposal: Program | None = None,
) -> Population:
    """Weighted particles from a program with observations; the estimate of the evidence is unbiased.

    Args:
        program: a Pyro program.
        args: its arguments.
        observations: values by address, of the shape of the sites' events.
        particles: N.
        proposal: a Pyro program `proposal(*args)` that samples values at latent addresses of `program`, with
            heavier tails than the posterior; other addresses are drawn from `program`. By default all are.

    Raises:
        InputError: an observed or proposed address is never visited, or the proposal samples no address or
            an observed one.
    """
    if proposal is None:
        return Population(*generate(program, args, observations, particles))
    proposed = propose(proposal, args, particles)
    if not proposed.choices:
        raise InputError("a proposal for importance sampling samples no address; give none.")
    trace, log_weights = generate(program, args, observations, particles, proposed.choices)
    return Population(trace, log_weights - proposed.log_prob)


def tempered_importance_sampling(
    program: Program | Series,
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    particles: int,
    step: Tempered,
) -> Stepped:
    """Weighted particles of the posterior, by tempering the likelihood of all observations together.

    The SMC sampler of Del Moral, Doucet and Jasra, JRSS B 68, 2006, section 3.3.2. For sequential data, start
    with `importance_sampling` and continue with `bcppl.inference.filters.step.steps`.

    Args:
        program: a Pyro program.
        args: its arguments.
        observations: values by address, of the shape of the sites' plates and events.
        particles: N.
        step: `tempered(kernel)`; it also tempers what the program itself conditions on (`obs=`,
            `pyro.factor`).

    Returns:
        The population, with the evidence of all observations, and a record of the steps.

    Raises:
        InputError: an observed address is never visited, or `step` is no `tempered(...)`.
        InferenceError: no particle is left with any weight.
    """
    if not isinstance(step, Tempered):
        raise InputError(
            f"tempered_importance_sampling is given a {type(step).__name__} as step; give tempered(kernel)."
        )
    trace, log_likelihood = generate(program, args, observations, particles)
    prior = Population(trace, torch.zeros_like(log_likelihood))
    return step.let_in(prior, [a for a in trace.addresses if a not in trace.choices], log_likelihood)

"""Importance sampling: the start of SMC, and by itself an estimate of evidence and posterior.

Robert and Casella, Monte Carlo Statistical Methods, 2004, section 3.3.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from bcppl.errors import InputError
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
        proposal: a Pyro program `proposal(*args)` that chooses values at latent addresses of `program`, more
            widely than the posterior; what it leaves out is drawn from `program`. By default all is.

    Raises:
        InputError: an observed or proposed address is never visited, the proposal chooses nothing, or
            chooses what is observed.
    """
    if proposal is None:
        return Population(*generate(program, args, observations, particles))
    proposed = propose(proposal, args, particles)
    if not proposed.choices:
        raise InputError("a proposal for importance sampling chooses nothing; leave it out.")
    trace, log_weights = generate(program, args, observations, particles, proposed.choices)
    return Population(trace, log_weights - proposed.log_prob)

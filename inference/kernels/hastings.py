"""Metropolis-Hastings with a proposal program: run by `propose`, its reverse move by `assess`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.kernels.kernel import Kernel, Move, decided, marked, refuse_observed
from bcppl.inference.population import Population
from bcppl.inference.proposals.proposal import Fittable, Proposal, program_of
from bcppl.inference.targets import Target
from bcppl.traces import Trace, assess, propose, update
from bcppl.traces.indexing import broadcast


def metropolis_hastings(proposal: Proposal, *learned: Callable[[Population], Any]) -> Kernel:
    """Metropolis-Hastings with a proposal program.

    Args:
        proposal: a Pyro program `proposal(trace, *values)`, or a shipped one such as `drift("hole")`. Its
            choices at latent addresses of the trace are new values, each particle's from its own old values
            only; its other choices are auxiliary and keep their values in the reverse move (so their
            distribution must not depend on what is moved in a way that forbids that).
        learned: functions of a population, such as `spread_of("hole")`; the program is given their results as
            `values`. They see other particles than those that are moved: a program that itself reads
            `trace["mu"].mean()` learns from the very particles that it moves, and is not right.

    The acceptance ratio is that of Hastings, Biometrika 57, 1970, on the pair (trace, auxiliary choices).

    Raises:
        InputError: (when the kernel moves) the proposal makes no choice at a latent address, or one at an
            observed address.
    """

    def kernel(population: Population) -> Move:
        program = program_of(proposal, learned, population)

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            forward = propose(program, (trace,), trace.particles)
            new = {a: v for a, v in forward.choices.items() if a in trace.choices}
            if not new:
                if callable(forward.result):
                    raise InputError(
                        "a proposal returns a function and samples nothing; if it learns from a population, "
                        "wrap it in Fittable(...), and if it is a kernel, use it as it is."
                    )
                chosen = ", ".join(forward.choices) or "nothing"
                raise InputError(
                    f"a proposal has no choice at a latent address: it chooses {chosen}, "
                    f"latent are {', '.join(trace.choices) or 'none'}; sample at one of these."
                )
            # A value to which its own proposal gives no density has left the range of its type: it stays.
            lost = forward.log_prob == -torch.inf
            if bool(lost.any()):
                new = {a: torch.where(broadcast(lost, v), trace[a], v) for a, v in new.items()}
            updated = update(trace, new)
            refuse_observed("a proposal", forward.choices, updated.trace)
            reverse = {**forward.choices, **updated.discarded}
            log_reverse = assess(program, (target.visible(updated.trace),), reverse, trace.particles)
            log_ratio = torch.where(lost, -torch.inf, log_reverse - forward.log_prob)
            return decided(target, trace, updated.trace, log_ratio)

        return move

    return marked(kernel, learns=isinstance(proposal, Fittable) or bool(learned))

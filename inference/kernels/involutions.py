"""Involutive MCMC: a program that chooses auxiliary values, and a map that is its own inverse."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.kernels.jacobian import (
    Charted,
    Key,
    charted,
    log_abs_det_jacobian,
    refuse_apart,
    refuse_leaving,
    refuse_unequal,
)
from bcppl.inference.kernels.kernel import Kernel, Move, decided, marked, refuse_observed
from bcppl.inference.population import Population
from bcppl.inference.proposals.proposal import Fittable, Proposal, program_of
from bcppl.inference.targets import Target
from bcppl.traces import Trace, assess, simulate, update
from bcppl.traces.values import Values

Involution = Callable[[Values, Values], tuple[Values, Values]]


def involutive(program: Proposal, involution: Involution, *, check: bool = False) -> Kernel:
    """Involutive MCMC: auxiliary choices, and a map of them and the latent values that is its own inverse.

    Green's reversible jump (Biometrika 82, 1995) with everything but the map derived: Cusumano-Towner, Lew
    and Mansinghka, Automating involutive MCMC using probabilistic and differentiable programming, 2020.
    The log-ratio of acceptance is log p(new) q(new choices | new) - log p(old) q(choices | old)
    + log|det J|; J is computed by autograd in the coordinates of the densities' base measures
    (`bcppl.inference.kernels.jacobian`).

    Args:
        program: a Pyro program `program(trace)`, or one that learns (`Fittable`), that samples the auxiliary
            choices.
        involution: `involution(values, choices) -> (new values, new choices)`, mappings from latent addresses
            and from the program's addresses to tensors (N, *event), each particle's from its own. What it
            leaves out stays. It is differentiated, so it computes in torch; it may map discrete
            values too.
        check: check, at every move, that the map undoes itself, that the Jacobians of both directions cancel,
            and that it does not mix particles.

    Returns:
        A kernel. Its move raises InputError where the map gives an unknown address, the wrong shape, nothing
        new, a value that carries no gradient, more coordinates than it takes, a pose moved along a held axis,
        or (checked) is not its own inverse.
    """

    def kernel(population: Population) -> Move:
        choose = program_of(program, (), population)

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            count = trace.particles
            forward = simulate(choose, (trace,), count)
            before = charted("latent", trace.choices, trace.distributions)
            before |= charted("choice", forward.choices, forward.distributions)
            mapped = partial(_mapped, involution)

            def log_jacobian(*ends: Mapping[Key, Tensor]) -> Tensor:
                start, end = ({k: Charted(v, before[k].chart) for k, v in each.items()} for each in ends)
                return log_abs_det_jacobian(mapped, start, end, check=check)

            start = {k: v.value for k, v in before.items()}
            after = mapped(start)
            new = {a: v for (kind, a), v in after.items() if kind == "latent" and v is not trace.choices[a]}
            if not new:
                raise InputError(
                    f"an involution gives no new value at a latent address; "
                    f"latent are {', '.join(trace.choices)}."
                )
            for address, value in new.items():
                refuse_leaving(address, before["latent", address].chart, trace.choices[address], value)
            log_forward = log_jacobian(start, after)
            if check:
                refuse_apart("the involution, applied twice,", before, mapped(after))
                refuse_unequal("the involution", log_forward, log_jacobian(after, mapped(after)), before)
            updated = update(trace, new)
            refuse_observed("the program of an involution", forward.choices, updated.trace)
            choices = {a: v for (kind, a), v in after.items() if kind == "choice"}
            reverse = assess(choose, (target.visible(updated.trace),), choices, count)
            chosen = forward.log_prob()
            # A choice to which its own program gives no density has left the range of its type.
            log_ratio = torch.where(chosen == -torch.inf, -torch.inf, reverse - chosen + log_forward)
            return decided(target, trace, updated.trace, log_ratio)

        return move

    return marked(kernel, learns=isinstance(program, Fittable))


def _mapped(involution: Involution, point: Mapping[Key, Tensor]) -> dict[Key, Tensor]:
    given: dict[str, dict[str, Tensor]] = {"latent": {}, "choice": {}}
    for (kind, address), value in point.items():
        given[kind][address] = value
    reached = involution(given["latent"], given["choice"])
    after = dict(point)
    for kind, values in zip(given, reached, strict=True):
        for address, value in values.items():
            if (kind, address) not in point:
                raise InputError(
                    f"an involution gives a {kind} value at {address!r}, which is too many: it takes "
                    f"{', '.join(given[kind]) or 'none'} and has to give back the same."
                )
            if value.shape != point[kind, address].shape:
                raise InputError(
                    f"an involution gives a value of {address!r} ({kind}) of shape {tuple(value.shape)}, "
                    f"it was {tuple(point[kind, address].shape)}; keep the particle axis first."
                )
            after[kind, address] = value
    return after

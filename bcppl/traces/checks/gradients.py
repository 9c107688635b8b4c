"""Whether gradients that a trace gives are those of its log-probabilities."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import biject_to
from torch.distributions.transforms import Transform

from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.support import freedom_of, support_of
from bcppl.errors import InputError
from bcppl.traces.checks.comparing import log_probs
from bcppl.traces.differentiation.programs import log_prob_with_grad
from bcppl.traces.faults import Fault, ProgramError
from bcppl.traces.trace import Trace

# Of a difference, in units of a value.
STEP = 1e-5
# A gradient is wrong if it is off by more, at most particles.
RELATIVE = 0.1


def check_gradients(trace: Trace) -> None:
    """Check gradients with respect to each real latent value, in double precision, by central differences.

    A site that is refused where a gradient is asked for, as one that takes `x.numpy()`, is not looked at. One
    that is not refused and passes none on, as with `x.detach().numpy()`, would count as a constant.

    Raises:
        ProgramError: the gradient of a site is another (GRADIENT): one or all of the ways in which it
            depends on a value are cut.
    """
    for latent, value in trace.choices.items():
        distribution = trace.distributions[latent]
        if value.dtype != torch.float64 or freedom_of(distribution) is not None:
            continue
        support = support_of(distribution)
        if isinstance(distribution, LazyDistribution) or support.is_discrete or support.event_dim > 0:
            continue
        _check(trace, latent, value, biject_to(support))


def _check(trace: Trace, latent: str, value: Tensor, to_support: Transform) -> None:
    # In unbounded coordinates a step stays within the support, however near to its edge the value is.
    free = to_support.inv(value)
    away = STEP * (1.0 + free.abs()) * torch.randn_like(value)
    after, before = to_support(free + away), to_support(free - away)
    step = (after - before) / 2.0
    ahead, behind = log_probs(trace.at({latent: after})), log_probs(trace.at({latent: before}))
    for site in trace.addresses:
        if not bool((ahead[site] != behind[site]).any()):
            continue
        gradient = _gradient(trace, latent, value, site)
        if gradient is None:
            continue
        along = (gradient * step).reshape(len(value), -1).sum(1)
        difference = (ahead[site] - behind[site]) / 2.0
        rounding = 1e-9 * (1.0 + ahead[site].abs())
        wrong = (along - difference).abs() > RELATIVE * torch.maximum(
            along.abs(), difference.abs()
        ) + rounding
        wrong = wrong & torch.isfinite(difference)
        if float(wrong.double().mean()) > 0.5:
            whole = not bool(gradient.any())
            remedy = "; for a simulator take the value out by `x.numpy()`, which moves by gradients refuse"
            raise ProgramError(
                Fault.GRADIENT,
                site,
                f"the gradient of site {site!r} with respect to {latent!r} is {'0, ' * whole}not that of its "
                f"log-probability, since {'all' if whole else 'a part of what'} it depends on is cut off; "
                "compute it with torch alone, without `detach`, `item`, `numpy` or `torch.tensor` of a "
                f"tensor{remedy * whole}.",
            )


def _gradient(trace: Trace, latent: str, value: Tensor, site: str) -> Tensor | None:
    """The gradient of one site's log-probability; None where it is refused."""
    leaf = value.detach().clone().requires_grad_()
    others = {address: 0.0 for address in trace.addresses if address != site}
    try:
        total = log_prob_with_grad(trace, {latent: leaf}, others)
    except InputError:
        return None
    if not total.requires_grad:
        return torch.zeros_like(leaf)
    (gradient,) = torch.autograd.grad(total.sum(), leaf, materialize_grads=True)
    return gradient

"""Log-likelihoods of many observations of the same sites, at all particles, without simulating again."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pyro
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.support import log_prob_inside
from bcppl.errors import InferenceError
from bcppl.traces import Trace
from bcppl.traces.dependence.equality import comparison
from bcppl.traces.run import inward

# Observations times particles that are evaluated together: they then stay in the processor's cache.
AT_ONCE = 1 << 18


def log_likelihoods(trace: Trace, observed: Sequence[str], values: Mapping[str, Tensor]) -> Tensor:
    """Log-likelihood (S, N) of observations at all particles of a trace.

    Args:
        trace: of N particles, the observed sites latent.
        observed: their addresses, in the order of the program.
        values: (S, *event) at each.
    """
    count = len(values[observed[0]])
    independent = _independent(trace, observed, values)
    total = torch.zeros(count, trace.particles, dtype=torch.float64)
    for address in independent:
        total += _at_site(address, trace.distributions[address], values[address], trace.particles)
    others = [address for address in observed if address not in independent]
    if others:
        total += torch.stack([_of_one(trace, others, values, k) for k in range(count)])
    return total


def _independent(trace: Trace, observed: Sequence[str], values: Mapping[str, Tensor]) -> list[str]:
    """The observed sites whose distributions do not depend on the observations at others of them.

    The first never does. For another one, particles are given one another's observations, all of them in
    turn, in two pairings: by one pairing alone, each could be given its own. An independent site's inputs
    then stay the same. A site that does not state its inputs may depend on any.
    """
    if len(observed) == 1:
        return list(observed)
    count, independent = len(values[observed[0]]), list(observed)
    turns = [torch.arange(first, first + trace.particles) for first in range(0, count, trace.particles)]
    for turn in (*turns, *(1 + turn for turn in turns[:1])):
        moved = trace.at({a: values[a][turn % count] for a in observed})
        same = comparison()
        independent = [
            a
            for k, a in enumerate(independent)
            if k == 0 or same(trace.distributions[a], moved.distributions[a])
        ]
    return independent


def _of_one(trace: Trace, addresses: Sequence[str], values: Mapping[str, Tensor], which: int) -> Tensor:
    """Log-likelihood (N,) of one observation at sites that depend on the observations before them."""
    shared = {a: v[which] for a, v in values.items()}
    moved = trace.at({a: v.expand(trace.particles, *v.shape) for a, v in shared.items()})
    same = comparison()
    total = torch.zeros(trace.particles, dtype=torch.float64)
    for address in addresses:
        before, site = trace.distributions[address], moved.distributions[address]
        # The trace's own site keeps its rendered images and simulations.
        site = before if same(before, site) else site
        total += _summed(_density(address, site, inward(shared[address], site)), site)
    return total


def _at_site(address: str, site: Any, values: Tensor, particles: int) -> Tensor:
    """Log-likelihood (S, N) of values (S, *event) at one site."""
    lazy = isinstance(site, LazyDistribution)
    if len(site.batch_shape) == 1 and (not lazy or site.broadcasts):
        rows = max(1, AT_ONCE // (particles * max(1, site.event_shape.numel())))
        batches = [_density(address, site, batch[:, None]) for batch in values.split(rows)]
        return torch.cat(batches).expand(len(values), particles)
    return torch.stack([_summed(_density(address, site, inward(v, site)), site) for v in values])


def _summed(density: Tensor, site: Any) -> Tensor:
    """The log-density (N,) of a site, summed over its plates."""
    batch = site.batch_shape
    return density.expand(batch).reshape(-1, batch[-1]).sum(dim=0)


def _density(address: str, site: Any, value: Tensor) -> Tensor:
    with torch.no_grad(), pyro.validation_enabled(False):
        density = log_prob_inside(site, value).to(torch.float64)
    if bool((density == torch.inf).any()):
        raise InferenceError(
            f"site {address!r} has a log-probability of inf for its simulated observation; "
            "a parameter of its distribution is out of range."
        )
    return density


def mark_failures(observed: Iterable[str], log_likelihoods: Tensor) -> Tensor:
    """Log-likelihoods (S, N), with NaN in the rows of observations that no particle can explain."""
    failed = torch.isnan(log_likelihoods).any(dim=1) | (log_likelihoods == -torch.inf).all(dim=1)
    if bool(failed.all()):
        raise InferenceError(
            f"the simulated observations at {', '.join(map(repr, observed))} have no log-probability at any "
            "particle; the simulation failed, or the sites' `sample` and `log_prob` do not fit."
        )
    return torch.where(failed[:, None], torch.nan, log_likelihoods)

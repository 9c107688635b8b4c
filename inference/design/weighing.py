"""Many observations of the same sites, weighed at all particles without simulating again."""

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
from bcppl.traces.dependence import Comparison
from bcppl.traces.run import inward

# Numbers of observations times particles that are weighed together: they then stay in the cache.
AT_ONCE = 1 << 18


def weighed(trace: Trace, observed: Sequence[str], values: Mapping[str, Tensor]) -> Tensor:
    """Log-probability (H, N) of observations at all particles of a trace.

    Args:
        trace: of N particles, the observed sites latent.
        observed: their addresses, in the order of the program.
        values: (H, *event) at each.

    Raises:
        InferenceError: a log-probability is +inf.
    """
    count = len(values[observed[0]])
    fixed = _independent(trace, observed, values)
    total = torch.zeros(count, trace.particles, dtype=torch.float64)
    for address in fixed:
        total += _weighed_at(address, trace.distributions[address], values[address], trace.particles)
    others = [address for address in observed if address not in fixed]
    if others:
        total += torch.stack([_at_one(trace, others, values, h) for h in range(count)])
    return total


def _independent(trace: Trace, observed: Sequence[str], values: Mapping[str, Tensor]) -> list[str]:
    """The observed sites whose distributions do not hang on what others of them observe.

    The first never does. Another one shows it where particles are given one another's observations, all of
    them in turn, by two pairings: by one alone, each could be given what it drew itself. Its inputs are the
    same then. A site that does not say what it hangs on may hang on any.
    """
    if len(observed) == 1:
        return list(observed)
    count, fixed = len(values[observed[0]]), list(observed)
    turns = [torch.arange(first, first + trace.particles) for first in range(0, count, trace.particles)]
    for turn in (*turns, *(1 + turn for turn in turns[:1])):
        index = turn % count
        moved = trace.at({a: values[a][index] for a in observed})
        same = Comparison()
        fixed = [
            a for k, a in enumerate(fixed) if k == 0 or same(trace.distributions[a], moved.distributions[a])
        ]
    return fixed


def _at_one(trace: Trace, addresses: Sequence[str], values: Mapping[str, Tensor], which: int) -> Tensor:
    """Log-probability (N,) of one observation at sites that hang on the observations before."""
    shared = {a: v[which] for a, v in values.items()}
    moved = trace.at({a: v.expand(trace.particles, *v.shape) for a, v in shared.items()})
    same = Comparison()
    total = torch.zeros(trace.particles, dtype=torch.float64)
    for address in addresses:
        before, site = trace.distributions[address], moved.distributions[address]
        # What was rendered or simulated for a site is kept by it.
        site = before if same(before, site) else site
        total += _summed(_density(address, site, inward(shared[address], site)), site)
    return total


def _weighed_at(address: str, site: Any, values: Tensor, particles: int) -> Tensor:
    """Log-probability (H, N) of values (H, *event) at one site."""
    lazy = isinstance(site, LazyDistribution)
    if len(site.batch_shape) == 1 and (not lazy or site.broadcasts):
        rows = max(1, AT_ONCE // (particles * max(1, site.event_shape.numel())))
        parts = [_density(address, site, part[:, None]) for part in values.split(rows)]
        return torch.cat(parts).expand(len(values), particles)
    return torch.stack([_summed(_density(address, site, inward(v, site)), site) for v in values])


def _summed(density: Tensor, site: Any) -> Tensor:
    """The density (N,) of a site with its plates."""
    batch = site.batch_shape
    return density.expand(batch).reshape(-1, batch[-1]).sum(dim=0)


def _density(address: str, site: Any, value: Tensor) -> Tensor:
    with torch.no_grad(), pyro.validation_enabled(False):
        density = log_prob_inside(site, value).to(torch.float64)
    if bool((density == torch.inf).any()):
        raise InferenceError(
            f"site {address!r} has a log-probability of inf for what was simulated there; "
            "a parameter of its distribution is out of range."
        )
    return density


def refuse_all_lost(observed: Iterable[str], log_likelihoods: Tensor) -> Tensor:
    """Log-likelihoods (H, N), rows NaN where nothing can be weighed.

    Raises:
        InferenceError: that is so in every row.
    """
    lost = torch.isnan(log_likelihoods).any(dim=1) | (log_likelihoods == -torch.inf).all(dim=1)
    if bool(lost.all()):
        raise InferenceError(
            f"what was simulated at {', '.join(map(repr, observed))} has no log-probability at any "
            "particle; the simulation failed, or the sites' `sample` and `log_prob` do not fit."
        )
    return torch.where(lost[:, None], torch.nan, log_likelihoods)

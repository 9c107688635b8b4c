"""The log-probabilities of a run's sites, and a view of its distributions that hides some."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from bcppl.distributions.shortcuts import narrowed, unvalidated
from bcppl.distributions.support import has_probability, log_prob_inside
from bcppl.errors import InputError
from bcppl.traces.dependence.surroundings import changed as surroundings_changed, evaluated, surroundings_of
from bcppl.traces.differentiation.graph import graph, kept, refuse_cut, taken_out
from bcppl.traces.explained import changed_outside, hidden_site, not_a_number, refuse_masked
from bcppl.traces.run import Run, inward


def log_probability(
    ran: Run, address: str, choices: Mapping[str, Tensor], observations: Mapping[str, Tensor]
) -> Tensor:
    """Log-probability (N,) of one site of a run, float64, the entries of its plates summed.

    Args:
        ran: the run.
        address: of the site.
        choices: the run's latent values.
        observations: its observed values.

    Raises:
        InputError: the site is latent and masked, its log-probabilities have a wrong shape, or a variable
            that it reads from outside has changed since the run.
        NotANumberError: one is NaN or +inf.
    """
    distribution = ran.distributions[address]
    if address in choices:
        refuse_masked(address, distribution)
    # A value that another one has moved out of the support is impossible, not a mistake.
    with graph(), unvalidated():
        value = _of_site(ran, address, distribution, address in choices)
    batch = distribution.batch_shape
    if value.shape not in ((), batch):
        raise InputError(
            f"site {address!r} has log-probabilities of shape {tuple(value.shape)}; its distribution "
            f"must give {tuple(batch)}, one for each particle and each entry of its plates."
        )
    value = value.to(torch.float64).expand(batch)
    if address in ran.structural:
        # Asked for alone, an impossible structure would have all the weight.
        possible = has_probability(distribution, ran.values[address].reshape(-1)[0])
        value = torch.where(possible, value, -torch.inf)
    if len(batch) > 1:
        value = value.sum(tuple(range(len(batch) - 1)))
    # The maximum is NaN where any is.
    if not bool(value.max() < torch.inf):
        value = torch.where(_impossible(ran, address, choices, observations), -torch.inf, value)
        if not bool(value.max() < torch.inf):
            raise not_a_number(address, value, choices.get(address), observations.get(address))
    return value


def _impossible(
    ran: Run, address: str, choices: Mapping[str, Tensor], observations: Mapping[str, Tensor]
) -> Tensor:
    """The particles (N,) with an impossible value before a site: its parameters may then be any."""
    addresses = list(ran.distributions)
    total = torch.zeros(ran.distributions[address].batch_shape[-1], dtype=torch.float64)
    for earlier in addresses[: addresses.index(address)]:
        if earlier in choices:
            total = total + log_probability(ran, earlier, choices, observations)
    return total == -torch.inf


def _of_site(ran: Run, address: str, distribution: Any, latent: bool) -> Tensor:
    value = inward(ran.values[address], distribution)
    if not kept():
        return _at(ran, address, narrowed(distribution), value, latent)
    try:
        attached = _at(ran, address, distribution, value, latent)
    except RuntimeError as error:
        if "requires grad" not in str(error):
            raise
        raise taken_out(f"site {address!r}") from error
    if not attached.requires_grad:
        refuse_cut(address, distribution)
    return attached


def _at(ran: Run, address: str, distribution: Any, value: Tensor, latent: bool) -> Tensor:
    if address not in ran.surroundings:
        return log_prob_inside(distribution, value, any_turn=not latent)
    then, now = ran.surroundings[address], surroundings_of(distribution)
    if (name := surroundings_changed(then, now)) is not None:
        raise changed_outside(address, name)
    return evaluated(distribution, lambda: log_prob_inside(distribution, value, any_turn=not latent))


class Hiding(UserDict[str, Any]):
    """The distributions of a trace, those at `hidden` addresses named but not given."""

    def __init__(self, distributions: Mapping[str, Any], hidden: frozenset[str]) -> None:
        self.data, self.hidden = dict(distributions), hidden

    def __getitem__(self, address: str) -> Any:
        if address in self.hidden:
            raise hidden_site(address)
        return self.data[address]

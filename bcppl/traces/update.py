"""The verbs that change values in a trace, Gen's: update takes new ones, regenerate draws them anew.

Cusumano-Towner et al., Gen: a general-purpose probabilistic programming system with programmable inference,
PLDI 2019, section 4.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from bcppl.traces.trace import Trace, unchanged


@dataclass(frozen=True, eq=False)
class Update:
    """What `update` returns; its log ratio is evaluated when it is asked for.

    Attributes:
        trace: at the new values.
        previous: the trace that was updated.
        discarded: the values that were replaced, by address.
    """

    trace: Trace
    previous: Trace
    discarded: Mapping[str, Tensor] = field(repr=False)

    @cached_property
    def log_ratio(self) -> Tensor:
        """Log p(new trace) - log p(old trace), (N,)."""
        named = self.trace.addresses
        return self.trace.log_prob(*named) - self.previous.log_prob(*named)


def update(trace: Trace, values: Mapping[str, Tensor]) -> Update:
    """Give some latent addresses new values (N, *event); the others and the arguments stay.

    Raises:
        InputError: an address is not latent, or a value has the wrong shape.
    """
    new = trace.at(values)
    return Update(new, trace, {a: trace.choices[a] for a in values})


@dataclass(frozen=True, eq=False)
class Regenerated:
    """What `regenerate` returns; its log weight is evaluated when it is asked for.

    Attributes:
        trace: with the values drawn anew.
        previous: the trace that they were drawn for.
        discarded: the values that were replaced, by address.
    """

    trace: Trace
    previous: Trace
    discarded: Mapping[str, Tensor] = field(repr=False)

    @cached_property
    def log_weight(self) -> Tensor:
        """The Metropolis-Hastings log acceptance ratio (N,) of proposing from the program itself.

        It is log p(new trace) - log p(old trace) over the sites that were not regenerated: the others' cancel
        against the proposal. A site whose inputs are unchanged is not evaluated.
        """
        total = torch.zeros(self.trace.particles, dtype=torch.float64)
        others = [address for address in self.trace.addresses if address not in self.discarded]
        same = unchanged(self.previous, self.trace, others)
        for address in others:
            if address not in same:
                total = total + self.trace.log_prob(address) - self.previous.log_prob(address)
        return total


def regenerate(trace: Trace, addresses: str | Collection[str]) -> Regenerated:
    """Draw some latent addresses anew from the program, given the others' values; the arguments stay.

    Several are drawn in the order of the program: later ones are given the earlier ones' new values.

    Args:
        trace: what is changed.
        addresses: one latent address or several.

    Raises:
        InputError: an address is not latent, or the values drawn change which addresses are visited.
    """
    addresses = [addresses] if isinstance(addresses, str) else list(addresses)
    return Regenerated(trace.regenerated(addresses), trace, {a: trace.choices[a] for a in addresses})

"""The verbs that change a trace, Gen's: update to new values, regenerate to samples from the program."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import address_list
from bcppl.cached import cached_property
from bcppl.errors import InputError
from bcppl.traces.dependence.changes import changed
from bcppl.traces.explained import other_addresses
from bcppl.traces.series import SeriesTrace
from bcppl.traces.trace import Trace
from bcppl.traces.values import Value, tensors
from bcppl.traces.verbs import constrained, copied, log_weight, refuse_no_trace, refuse_unfit


@dataclass(frozen=True, eq=False)
class Update:
    """The trace at new values, arguments and observations, and the previous one.

    Attributes:
        discarded: the values that were replaced, and those of addresses that are visited no more, by address.
        drawn: the new latent addresses whose values were sampled from the program.
    """

    trace: Trace
    previous: Trace
    discarded: Mapping[str, Tensor] = field(repr=False)
    drawn: frozenset[str] = frozenset()

    @cached_property
    def log_ratio(self) -> Tensor:
        """Log p(new trace) - log p(old trace) - log q(drawn), (N,): Gen's weight of an update.

        q is the program itself, so that the density of what was drawn cancels. Sites of both traces that are
        the same cancel without being evaluated.
        """
        new, old = self.trace, self.previous
        both = [a for a in new.addresses if a in old._run.distributions]
        total = torch.zeros(new.particles, dtype=torch.float64)
        if others := set(changed(old, new, both)):
            named = [a for a in both if a in others or (a in old.known and a in new.known)]
            total = total + _log_ratio(new, old, named)
        added = [a for a in new.addresses if a not in old._run.distributions and a not in self.drawn]
        vanished = [a for a in old.addresses if a not in new._run.distributions]
        total = total + new.log_prob(*added) if added else total
        return total - old.log_prob(*vanished) if vanished else total


def _log_ratio(new: Trace, old: Trace, addresses: Sequence[str]) -> Tensor:
    """Log p(new trace) - log p(old trace), (N,), over sites of both."""
    now = new.log_prob(*addresses)
    # What is impossible stays so: -inf minus -inf is no number.
    return torch.where(now == -torch.inf, now, now - old.log_prob(*addresses))


def update(
    trace: Trace,
    values: Mapping[str, Value] | None = None,
    *,
    args: tuple[Any, ...] | None = None,
    observations: Mapping[str, Value] | None = None,
) -> Update:
    """Change values, arguments and observations of a trace, all at once; what is not given stays.

    New arguments may make the program visit new addresses and leave others out. New latent addresses that are
    given no value are sampled from the program.

    Args:
        trace: of a series its newest step changes.
        values: (N, ...) of latent addresses, old ones or new.
        args: the program's arguments.
        observations: values of new addresses, or in place of old observations: one for all particles. They
            are copied.

    Raises:
        InputError: a value is of an observed address, an observation of a latent one, or either of an address
            that is never visited; one has the wrong shape or type; new values change which addresses are
            visited, while the arguments stay; or a new latent pose lies in a plate.
    """
    refuse_no_trace("update", trace)
    values, observations = tensors(values or {}), copied(observations or {})
    old = {**trace.choices, **trace.observations}
    replaced = {a: v for a, v in values.items() if a in old or args is None}
    trace.refuse_other_than_latent(replaced)
    for address in observations:
        if address in values or address in trace.choices:
            raise InputError(f"address {address!r} is latent and given an observation; give it a value.")
    given = {**values, **trace.as_replacing(replaced)}
    new = trace.revised(given, args=args, observations=observations)
    new._run.refuse_unvisited((*values, *observations))
    if args is None and set(new.addresses) != set(trace.addresses):
        raise other_addresses(set(new.addresses) ^ set(trace.addresses))
    if args is not None or observations:
        refuse_unfit(new, observations, old)
    vanished = [a for a in old if a not in new._run.distributions]
    drawn = frozenset(a for a in new.choices if a not in old and a not in values)
    discarded = {a: old[a] for a in (*replaced, *(o for o in observations if o in old), *vanished)}
    return Update(new, trace, discarded, drawn)


def extend(
    trace: Trace,
    args: tuple[Any, ...],
    observations: Mapping[str, Value],
    choices: Mapping[str, Value] | None = None,
) -> tuple[Trace, Tensor]:
    """An update by new arguments that adds sites and changes no value, with its log weight.

    New latent sites are sampled from the program. A series (`bcppl.traces.Series`) is run on by one step,
    whose arguments and observations are given; then it is the step's sites that are new.

    Args:
        trace: of N particles.
        args: the new arguments.
        observations: values of new addresses; they are copied.
        choices: values (N, ...) of new latent addresses, such as a proposal gave.

    Returns:
        The longer trace and its log weight (N,): the log-probability of the new observations and of the
        choices that were given, and the log ratio of old sites that the new arguments change, if any.

    Raises:
        InputError: an address vanishes, or an observation or a choice is of an old address, of one never
            visited, or of the wrong shape, or a new latent pose lies in a plate.
    """
    refuse_no_trace("extend", trace)
    choices = choices or {}
    if isinstance(trace, SeriesTrace):
        stage = trace.next_stage()
        longer, weighed = constrained(stage, args, trace.particles, observations, choices, trace.carried)
        return longer, log_weight(longer, weighed)
    again = [a for a in (*observations, *choices) if a in trace]
    if again:
        raise InputError(
            f"address {again[0]!r} was observed or sampled before; extend takes new addresses only."
        )
    updated = update(trace, choices, args=args, observations=observations)
    if updated.discarded:
        lost = next(iter(updated.discarded))
        raise InputError(f"with the new arguments the program no longer visits address {lost!r}.")
    return updated.trace, updated.log_ratio


def undrawn(trace: Trace, args: tuple[Any, ...]) -> Trace:
    """The trace with the sites that new arguments add, lazy ones NaN: only their distributions are wanted.

    Several of them can then be sampled in one batch. Other new sites are sampled from the program.
    """
    return trace.revised({}, args=args, draws_lazy=False)


@dataclass(frozen=True, eq=False)
class Regenerated:
    """The trace with the values that were sampled, the previous one, and the values that were replaced."""

    trace: Trace
    previous: Trace
    discarded: Mapping[str, Tensor] = field(repr=False)

    @cached_property
    def log_weight(self) -> Tensor:
        """The Metropolis-Hastings log acceptance ratio (N,) of proposing from the program itself.

        It is log p(new trace) - log p(old trace) over the sites that were not regenerated.
        """
        others = [address for address in self.trace.addresses if address not in self.discarded]
        if others := list(changed(self.previous, self.trace, others)):
            return _log_ratio(self.trace, self.previous, others)
        return torch.zeros(self.trace.particles, dtype=torch.float64)


def regenerate(trace: Trace, addresses: str | Collection[str]) -> Regenerated:
    """Sample one or several latent addresses from the program, given the others' values; the arguments stay.

    They are sampled in the order of the program: later ones are given the earlier ones' new values.

    Raises:
        InputError: an address is not latent, or the values change which addresses are visited.
    """
    refuse_no_trace("regenerate", trace)
    addresses = address_list(addresses)
    return Regenerated(trace.regenerated(addresses), trace, {a: trace.choices[a] for a in addresses})

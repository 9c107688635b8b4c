"""One run of a program for N particles at once."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import address_list
from bcppl.cached import cached_property
from bcppl.distributions.support import Support, support_of
from bcppl.errors import InputError
from bcppl.traces.carried import Entry
from bcppl.traces.dependence.changes import changed
from bcppl.traces.differentiation.graph import kept
from bcppl.traces.evaluation import Hiding, log_probability
from bcppl.traces.explained import hidden_site, other_addresses, refuse_masked
from bcppl.traces.indexing import Index, aligned, broadcast, particles_at
from bcppl.traces.run import Common, Program, Run, run
from bcppl.traces.structural import Structure
from bcppl.traces.values import Value, held, shapes, tensors


@dataclass(frozen=True, eq=False, repr=False)
class Trace:
    """Values by address for N particles, and the log-probability of every site, evaluated when asked for.

    `trace["hole"]` is a value, also one that the program names by `pyro.deterministic`; `trace[ancestors]`,
    `trace[mask]` and `trace[:50]` are traces of those particles. Treat it as immutable: the verbs of
    `bcppl.traces` make new ones. Observations are copied when they are given, so that an array may be used
    again; values of latent addresses are held as they are.

    Attributes:
        program, args: what was run.
        particles: N.
        choices: the latent values, particle axis first.
        observations: the constrained values, the same for all particles.
        carried: simulator states by name, particle axis first (see `bcppl.traces.carried`).
        known: log-probabilities (N,) that were evaluated already, by address.
        hidden: addresses whose distribution and log-probability may not be asked for (see `hiding`).
    """

    program: Program
    args: tuple[Any, ...]
    particles: int
    choices: Mapping[str, Tensor]
    observations: Mapping[str, Tensor]
    carried: dict[str, Entry] = field(default_factory=dict)
    known: dict[str, Tensor] = field(default_factory=dict, repr=False)
    hidden: frozenset[str] = frozenset()

    @cached_property
    def _common(self) -> Common:
        return Common()

    def _like(self, **changed: Any) -> Any:
        """The trace of the same program and arguments with other particles or values."""
        other = replace(self, **changed)
        other.__dict__["_common"] = self._common
        return other

    @cached_property
    def _run(self) -> Run:
        """The program run again at these values: that is cheap, and what sites compute is kept in `known`."""
        again = self._again()
        self.carried.update(again.carried)
        return again

    def _again(self) -> Run:
        return run(
            self.program, self.args, self.particles, {**self.choices, **self.observations}, self.carried
        )

    @property
    def _ran(self) -> Run:
        # A graph is not kept: the parameters that a program closes over may have been trained since.
        return self._again() if kept() else self._run

    @classmethod
    def of_run(
        cls,
        program: Program,
        args: tuple[Any, ...],
        particles: int,
        ran: Run,
        observations: Mapping[str, Tensor],
        hidden: frozenset[str] = frozenset(),
    ) -> Trace:
        """The trace of a run; what is neither observed nor fixed by the program is latent."""
        choices = {
            address: _of_each_particle(value, ran.distributions[address], particles)
            for address, value in ran.values.items()
            if address not in observations and address not in ran.fixed
        }
        ran.values.update(choices)
        trace = cls(program, args, particles, choices, dict(observations), hidden=hidden)
        trace._keep_run(ran)
        return trace

    def _keep_run(self, ran: Run) -> None:
        """Keep the run that these values come from, so that the program is not run again for them."""
        self.__dict__["_run"] = ran
        self.carried.update(ran.carried)

    @property
    def distributions(self) -> Mapping[str, Any]:
        """The distribution of every site at these values, by address in the program's order."""
        if self.hidden:
            return Hiding(self._ran.distributions, hidden=self.hidden)
        return MappingProxyType(self._ran.distributions)

    @property
    def addresses(self) -> list[str]:
        """All addresses in the order of the program."""
        if self._common.addresses is None:
            self._common.addresses = tuple(self._run.distributions)
        return list(self._common.addresses)

    def support(self, address: str) -> Support:
        """Where the values at a latent address may lie."""
        if address not in self._common.supports:
            support = Support.of(self.distributions[address])
            if not support.is_fixed:
                return support
            self._common.supports[address] = support
        return self._common.supports[address]

    @property
    def structure(self) -> Structure:
        """The values of the structural sites (`bcppl.traces.structural`)."""
        return Structure({a: int(self._run.values[a].reshape(-1)[0]) for a in self._run.structural})

    @property
    def result(self) -> Any:
        """What the program returned."""
        return self._ran.result

    @property
    def determined(self) -> Mapping[str, Tensor]:
        """What the program names by `pyro.deterministic`, particle axis first."""
        return self._ran.determined

    def log_prob(self, *addresses: str) -> Tensor:
        """Log-probability (N,) of the sites at `addresses`, summed; of all sites where none is named.

        The entries of a site's plates are summed too. The trace may keep the result: do not write into it.

        Raises:
            InputError: no site has that address.
            NotANumberError: a log-probability is NaN or +inf; names the site and the particles.
        """
        attached = self._again() if kept() else None
        values = [self._site(address, attached) for address in addresses or self.addresses]
        return sum(values[1:], values[0]) if values else torch.zeros(self.particles, dtype=torch.float64)

    def _site(self, address: str, attached: Run | None) -> Tensor:
        """The log-probability (N,) of a site, by a run that keeps gradients where there is one."""
        if address in self.hidden:
            raise hidden_site(address)
        # What was evaluated without gradients is a constant; what is evaluated with them is not kept.
        if attached is None and address in self.known:
            return self.known[address]
        ran = self._run if attached is None else attached
        ran.refuse_unvisited([address])
        value = log_probability(ran, address, self.choices, self.observations)
        if attached is None:
            value = self.known[address] = value.detach()  # a factor holds what it was given, with its graph
        return value

    def __getitem__(self, key: str | Index) -> Any:
        if isinstance(key, str):
            if key in self.choices:
                return self.choices[key]
            if key in self.observations:
                return self.observations[key]
            if key in self.determined:
                return self.determined[key]
            held = [*self.choices, *self.observations, *self.determined]
            raise InputError(
                f"the trace has no value at address {key!r}; it has {', '.join(held) or 'none'}."
            )
        return self.chosen(particles_at(key, self.particles))

    def chosen(self, index: Tensor) -> Any:
        """The trace of the particles at an index (K,) int64 that is known to be in range."""
        return self._like(
            particles=len(index),
            choices={a: v[index] for a, v in self.choices.items()},
            carried={a: e.take(index) for a, e in self.carried.items()},
            known={a: v[index] for a, v in self.known.items()},
        )

    def impossible(self) -> list[str]:
        """The addresses, not latent, whose log-probability is known to be -inf for every particle."""
        return [a for a, v in self.known.items() if a not in self.choices and bool((v == -torch.inf).all())]

    def since(self, previous: Trace) -> list[str]:
        """The addresses of this trace that `previous`, which was extended to it, does not visit."""
        return [a for a in self.addresses if a not in previous._run.distributions]

    def __contains__(self, address: object) -> bool:
        return address in self.choices or address in self.observations

    def __len__(self) -> int:
        return self.particles

    def __repr__(self) -> str:
        latent, observed = shapes(self.choices), shapes(self.observations)
        return f"{type(self).__name__}({self.particles} particles, latent: {latent}, observed: {observed})"

    def settled(self) -> Trace:
        """The same trace, with nothing left to gather from another."""
        return self

    def where(self, mask: Tensor, other: Trace) -> Trace:
        """This trace where `mask` (N,) is true, the other (same program, same addresses) elsewhere."""
        shared = self.known.keys() & other.known.keys()
        return self._like(
            choices={
                a: torch.where(broadcast(mask, v), v, other.choices[a]) for a, v in self.choices.items()
            },
            carried={
                a: merged
                for a, e in self.carried.items()
                if a in other.carried and (merged := e.where(mask, other.carried[a])) is not None
            },
            known={a: torch.where(mask, self.known[a], other.known[a]) for a in shared},
            hidden=self.hidden | other.hidden,
        )

    def replaced(self, index: Tensor, source: Trace) -> Trace:
        """This trace with the particles at `index` (K,) int64, each once, replaced by a trace of K particles.

        The other trace is of the same program and has the same addresses.
        """
        shared = self.known.keys() & source.known.keys()
        rows, mask = aligned(index, self.particles)
        return self._like(
            choices={a: v.index_copy(0, index, source.choices[a]) for a, v in self.choices.items()},
            carried={
                a: merged
                for a, e in source.carried.items()
                if a in self.carried and (merged := e.take(rows).where(mask, self.carried[a])) is not None
            },
            known={a: self.known[a].index_copy(0, index, source.known[a]) for a in shared},
            hidden=self.hidden | source.hidden,
        )

    def hiding(self, addresses: str | Iterable[str]) -> Trace:
        """The same trace for a proposal to read, with some sites hidden.

        Asking for the distribution or the log-probability of a hidden site, also after indexing or new
        values, raises an error that names the address. Values stay readable.
        """
        hidden = frozenset(address_list(addresses))
        self._run.refuse_unvisited(hidden)
        secret = self._like(known=dict(self.known), hidden=self.hidden | hidden)
        secret._keep_run(self._ran)
        return secret

    def without_states(self) -> Trace:
        """The same trace, whose simulators (`carried`) begin again where they are asked for.

        Merged with another trace, it does not run them as far as that one has.
        """
        return self._like(carried={}, known=dict(self.known))

    def at(self, values: Mapping[str, Value]) -> Trace:
        """The trace at other values of some latent addresses; log-probabilities that stay are kept.

        Raises:
            InputError: an address is not latent; a value is no array, has the wrong shape, or is real where
                the old one is a whole number; or the values change which addresses the program visits.
        """
        self.refuse_other_than_latent(values)
        return self._at_same_addresses(self.as_replacing(values))

    def regenerated(self, addresses: Collection[str]) -> Trace:
        """The trace with some latent addresses sampled from the program, in its order, given the others.

        Raises:
            InputError: an address is not latent, or the values change which addresses the program visits.
        """
        self.refuse_other_than_latent(addresses)
        return self._at_same_addresses({}, without=addresses)

    def _at_same_addresses(self, values: Mapping[str, Tensor], without: Collection[str] = ()) -> Trace:
        revised = self.revised(values, without=without)
        if set(revised.addresses) != set(self.addresses):
            raise other_addresses(set(self.addresses) ^ set(revised.addresses))
        return revised

    def revised(
        self,
        values: Mapping[str, Tensor],
        *,
        without: Collection[str] = (),
        args: tuple[Any, ...] | None = None,
        observations: Mapping[str, Tensor] | None = None,
        draws_lazy: bool = True,
    ) -> Trace:
        """The program run again, as `update` does without its checks; log-probabilities that stay are kept.

        Args:
            values: (N, ...) of latent addresses.
            without: latent addresses whose values are sampled from the program.
            args: its arguments; these by default.
            observations: observed values, besides those that there are.
            draws_lazy: whether lazy sites that have no value are sampled; else they are NaN.
        """
        kept = {a: v for a, v in self.choices.items() if a not in without}
        args = self.args if args is None else held(args)
        observed = {**self.observations, **(observations or {})}
        given = {**kept, **values, **observed}
        ran = run(self.program, args, self.particles, given, self.carried, draws_lazy=draws_lazy)
        observed = {a: v for a, v in observed.items() if a in ran.distributions}
        revised = type(self).of_run(self.program, args, self.particles, ran, observed, self.hidden)
        if args is self.args and tuple(ran.distributions) == self._common.addresses and not ran.structural:
            revised.__dict__["_common"] = self._common
        refuse_masked_latents(revised)
        if "_run" not in self.__dict__ and self.choices and self.choices.keys() <= values.keys():
            # Hardly a site stays as it was: to run the program again for these values would be in vain.
            return revised
        known = [a for a in self.known if a in ran.distributions]
        lost = set(changed(self, revised, known))
        revised.known.update({a: self.known[a] for a in known if a not in lost})
        return revised

    def as_replacing(self, values: Mapping[str, Value]) -> dict[str, Tensor]:
        """New values of latent addresses, of the type of the old ones; others than `at` takes are refused."""
        values = tensors(values)
        for address, value in values.items():
            old = self.choices[address]
            if not torch.can_cast(value.dtype, old.dtype):
                raise InputError(
                    f"the new value of {address!r} is of {value.dtype}, the old one of {old.dtype}; "
                    "give one of the same kind."
                )
            if value.shape != old.shape:
                raise InputError(
                    f"the new value of {address!r} has shape {tuple(value.shape)}, "
                    f"the old one {tuple(old.shape)}; give one for each particle."
                )
        return {a: value.to(self.choices[a].dtype) for a, value in values.items()}

    def refuse_other_than_latent(self, addresses: Iterable[str]) -> None:
        """Refuse addresses that are not latent."""
        for address in addresses:
            if address not in self.choices:
                raise InputError(
                    f"a new value for {address!r} was given or asked for, which is no latent address; "
                    f"latent are {', '.join(self.choices) or 'none'}."
                )


def refuse_masked_latents(trace: Trace) -> None:
    """Refuse a trace with a latent site that masks some of its values."""
    for address in trace.choices:
        refuse_masked(address, trace._run.distributions[address])


def _of_each_particle(value: Tensor, site: Any, particles: int) -> Tensor:
    """A latent value as a trace holds it: one for each particle, real where its site is."""
    if value.ndim == len(site.batch_shape) - 1 + len(site.event_shape):
        value = value.expand(particles, *value.shape).clone()
    if not value.is_floating_point():
        with suppress(NotImplementedError):
            # Kernels would round what they move.
            value = value if support_of(site).is_discrete else value.to(torch.float64)
    return value

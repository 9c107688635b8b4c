"""One run of a program for N particles at once."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import pyro
import torch
from torch import Tensor

from bcppl.distributions.support import log_prob_inside
from bcppl.errors import InputError, NotANumberError
from bcppl.traces.carried import Entry
from bcppl.traces.dependence import Comparison, equal
from bcppl.traces.hiding import Hiding, refused
from bcppl.traces.indexing import Index, particles_at
from bcppl.traces.run import Program, Run, inward, refuse_other_than_tensors, run
from bcppl.traces.shortcuts import narrowed
from bcppl.traces.shown import shapes


@dataclass(frozen=True, eq=False, repr=False)
class Trace:
    """Values by address for N particles, and the log-probability of every site, evaluated when asked for.

    `trace["hole"]` is a value; `trace[ancestors]`, `trace[mask]` and `trace[:50]` are traces of those
    particles. Treat it as immutable: the verbs of `bcppl.traces` make new ones. Observations are copied when
    they are given, so that an array may be used again; values of latent addresses are held as they are.

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
    carried: Mapping[str, Entry] = field(default_factory=dict)
    known: dict[str, Tensor] = field(default_factory=dict, repr=False)
    hidden: frozenset[str] = frozenset()

    @cached_property
    def _run(self) -> Run:
        """The program run again at these values: that is cheap, and what sites compute is kept in `known`."""
        given = {**self.choices, **self.observations}
        again = self._again(given)
        self.carried_states().update(again.carried)
        return again

    def _again(self, given: Mapping[str, Tensor]) -> Run:
        return run(self.program, self.args, self.particles, given, self.carried)

    def _ran(self, ran: Run) -> None:
        """Keep the run that these values come from, so that the program is not run again for them."""
        self.__dict__["_run"] = ran
        self.carried_states().update(ran.carried)

    def carried_states(self) -> dict[str, Entry]:
        """The carried states, as a dictionary that states started later are added to."""
        assert isinstance(self.carried, dict)
        return self.carried

    @property
    def distributions(self) -> Mapping[str, Any]:
        """The distribution of every site at these values, by address in the program's order.

        Raises:
            InputError: the distribution of a hidden site is asked for.
        """
        if self.hidden:
            return Hiding(self._run.distributions, self.hidden)
        return MappingProxyType(self._run.distributions)

    @property
    def addresses(self) -> list[str]:
        """All addresses in the order of the program."""
        return list(self._run.distributions)

    @property
    def result(self) -> Any:
        """What the program returned."""
        return self._run.result

    def log_prob(self, *addresses: str) -> Tensor:
        """Log-probability (N,) of the sites at `addresses`, summed; of all sites where none is named.

        The entries of a site's plates are summed too. The trace may keep the answer: do not write into it.

        Raises:
            InputError: no site has that address.
            NotANumberError: a log-probability is NaN or +inf; names the site and the particles.
        """
        values = [self._site(address) for address in addresses or self.addresses]
        return sum(values[1:], values[0]) if values else torch.zeros(self.particles, dtype=torch.float64)

    def _site(self, address: str) -> Tensor:
        if address in self.hidden:
            raise refused(address)
        if address not in self.known:
            if address not in self._run.distributions:
                raise InputError(
                    f"the program visits no address {address!r}; "
                    f"it visits {', '.join(self.addresses) or 'none'}."
                )
            self.known[address] = self._evaluated(address)
        return self.known[address]

    def _evaluated(self, address: str) -> Tensor:
        distribution = self._run.distributions[address]
        # A value that another one has moved out of the support is impossible, not a mistake.
        with torch.no_grad(), pyro.validation_enabled(False):
            value = log_prob_inside(narrowed(distribution), inward(self._run.values[address], distribution))
        batch = distribution.batch_shape
        if value.shape not in ((), batch):
            raise InputError(
                f"site {address!r} has log-probabilities of shape {tuple(value.shape)}; its distribution "
                f"must give {tuple(batch)}, one for each particle and each entry of its plates."
            )
        value = value.to(torch.float64).expand(batch)
        if len(batch) > 1:
            value = value.sum(tuple(range(len(batch) - 1)))
        # The maximum is NaN where any is.
        if not bool(value.max() < torch.inf):
            which = (torch.isnan(value) | (value == torch.inf)).nonzero().flatten().tolist()
            if address in self.observations and bool(torch.isnan(self.observations[address]).any()):
                seen = torch.isnan(self.observations[address])
                raise NotANumberError(
                    f"the observation at site {address!r} is NaN in {int(seen.sum())} of {seen.numel()} "
                    "entries; leave out what was not measured, or mask it in the site's distribution."
                )
            dense = address in self.choices and float(value[which[0]]) == torch.inf
            raise NotANumberError(
                f"site {address!r} has a log-probability of {float(value[which[0]])} for "
                f"{len(which)} of {self.particles} particles (first: {', '.join(map(str, which[:5]))}); "
                + (
                    f"rounding to {self.choices[address].dtype} put values on the edge of the support, "
                    "where the density is infinite; give the prior parameters in double precision, or less "
                    "extreme ones."
                    if dense
                    else "a value or a parameter of its distribution is out of range there."
                )
            )
        return value

    def __getitem__(self, key: str | Index) -> Any:
        if isinstance(key, str):
            if key in self.choices:
                return self.choices[key]
            if key in self.observations:
                return self.observations[key]
            held = [*self.choices, *self.observations]
            raise InputError(
                f"the trace has no value at address {key!r}; it has {', '.join(held) or 'none'}."
            )
        return self.chosen(particles_at(key, self.particles))

    def chosen(self, index: Tensor) -> Any:
        """The trace of the particles at an index (K,) int64 that is known to be in range.

        For what has made the index itself, such as resampling; `trace[index]` looks at it first.
        """
        return replace(
            self,
            particles=len(index),
            choices={a: v[index] for a, v in self.choices.items()},
            carried={a: e.take(index) for a, e in self.carried.items()},
            known={a: v[index] for a, v in self.known.items()},
        )

    def impossible(self) -> list[str]:
        """The addresses, of those that are not latent, that every particle is known to say cannot be."""
        return [a for a, v in self.known.items() if a not in self.choices and bool((v == -torch.inf).all())]

    def since(self, previous: Trace) -> list[str]:
        """The addresses that `extend` added to `previous` to make this trace (or one moved since)."""
        return [a for a in self.addresses if a not in previous._run.distributions]

    def __contains__(self, address: object) -> bool:
        return address in self.choices or address in self.observations

    def __len__(self) -> int:
        return self.particles

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.particles} particles, latent: {shapes(self.choices)}, "
            f"observed: {shapes(self.observations)})"
        )

    def where(self, mask: Tensor, other: Trace) -> Trace:
        """This trace where `mask` (N,) is true, the other (same program, same addresses) elsewhere."""
        shared = set(self.known) & set(other.known)
        return replace(
            self,
            choices={
                a: torch.where(mask.reshape(-1, *[1] * (v.ndim - 1)), v, other.choices[a])
                for a, v in self.choices.items()
            },
            carried={
                a: merged
                for a, e in self.carried.items()
                if a in other.carried and (merged := e.where(mask, other.carried[a])) is not None
            },
            known={a: torch.where(mask, self.known[a], other.known[a]) for a in shared},
            hidden=self.hidden | other.hidden,
        )

    def hiding(self, addresses: Iterable[str]) -> Trace:
        """The same trace for a proposal to read, in which some sites may not be asked what they say.

        Asking it for the distribution or the log-probability of a hidden site, also after indexing or new
        values, raises an error that names the address. Values stay readable: they are the trace's own.

        Raises:
            InputError: the program visits no such address.
        """
        hidden = frozenset(addresses)
        for address in sorted(hidden - set(self.addresses)):
            raise InputError(
                f"address {address!r} was to be hidden, which the program never visits; "
                f"it visits {', '.join(self.addresses) or 'none'}."
            )
        secret = replace(self, known=dict(self.known), hidden=self.hidden | hidden)
        secret._ran(self._run)
        return secret

    def at(self, values: Mapping[str, Tensor]) -> Trace:
        """The same run with other values at some latent addresses; what cannot have changed is kept.

        Raises:
            InputError: an address is not latent, or a value is no tensor or has the wrong shape, or reals are
                given for whole numbers.
        """
        self._refuse_other_than_latent(values)
        refuse_other_than_tensors(values)
        for address, value in values.items():
            if not torch.can_cast(value.dtype, self.choices[address].dtype):
                raise InputError(
                    f"the new value of {address!r} is of {value.dtype}, the old one of "
                    f"{self.choices[address].dtype}; give one of the same kind."
                )
            if value.shape != self.choices[address].shape:
                raise InputError(
                    f"the new value of {address!r} has shape {tuple(value.shape)}, "
                    f"the old one {tuple(self.choices[address].shape)}; give one for each particle."
                )
        new = {a: value.to(self.choices[a].dtype) for a, value in values.items()}
        return self._moved({**self.choices, **new}, frozenset(new))

    def regenerated(self, addresses: Collection[str]) -> Trace:
        """The same run with some latent addresses drawn anew from the program, in its order.

        Raises:
            InputError: an address is not latent, or the values drawn change which addresses are visited.
        """
        self._refuse_other_than_latent(addresses)
        held = {a: v for a, v in self.choices.items() if a not in addresses}
        ran = self._again({**held, **self.observations})
        return self._moved({a: ran.values.get(a, v) for a, v in self.choices.items()}, addresses, ran)

    def _refuse_other_than_latent(self, addresses: Iterable[str]) -> None:
        for address in addresses:
            if address not in self.choices:
                raise InputError(
                    f"a new value for {address!r} was given or asked for, which is no latent address; "
                    f"latent are {', '.join(self.choices) or 'none'}."
                )

    def _moved(self, choices: Mapping[str, Tensor], new: Collection[str], ran: Run | None = None) -> Trace:
        """This run at other choices, of which those at `new` differ; what cannot have changed is kept."""
        moved = replace(self, choices=choices, carried=dict(self.carried), known={})
        if ran is not None:
            moved._ran(ran)
        if set(moved.addresses) != set(self.addresses):
            raise InputError("new values changed which addresses the program visits; mask sites instead.")
        for address in unchanged(self, moved, [a for a in self.known if a not in new]):
            moved.known[address] = self.known[address]
        # A state that was thrown away must not be merged back in later.
        for name in [n for n in moved.carried_states() if n not in moved._run.carried]:
            del moved.carried_states()[name]
        return moved


def unchanged(first: Trace, second: Trace, addresses: Iterable[str]) -> list[str]:
    """Those of some addresses, of equal values in two traces, whose log-probability is the same in both."""
    same, then, now = Comparison(), first._run, second._run
    return [
        address
        for address in addresses
        if same(then.distributions[address], now.distributions[address])
        # What a program observes itself (`obs=`) may depend on a latent value.
        and (address not in now.fixed or equal(then.values[address], now.values[address]))
    ]

"""One run of a program for N particles at once."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import pyro
import pyro.poutine as poutine
import torch
from torch import Tensor

from bcppl.errors import InferenceError, InputError
from bcppl.traces.carried import Entry, carrying, same_inputs

Program = Callable[..., Any]
Index = Tensor | Sequence[int] | slice | int


@dataclass(frozen=True, eq=False)
class Run:
    """What one pass through a program left: distributions, values and carried states by name."""

    distributions: dict[str, Any]
    values: dict[str, Tensor]
    fixed: frozenset[str]
    carried: dict[str, Entry]
    result: Any


def run(
    program: Program,
    args: tuple[Any, ...],
    particles: int,
    given: Mapping[str, Tensor],
    carried: Mapping[str, Entry],
) -> Run:
    """Run a program under the plate `particles`, its sites set to `given` and the others sampled.

    Raises:
        InputError: no particles, a duplicate address, an enumerated site, a site outside the particle axis,
            or a value that is no tensor or has the wrong shape; the sentence names the address.
    """
    if particles < 1:
        raise InputError(f"a program was to be run for {particles} particles; give 1 or more.")
    for address, value in given.items():
        if not isinstance(value, Tensor):
            raise InputError(
                f"the value given for address {address!r} is a {type(value).__name__}; give a tensor."
            )

    def plated() -> Any:
        with pyro.plate("particles", particles, dim=-1):
            return program(*args)

    try:
        with carrying(carried) as used, torch.no_grad(), pyro.validation_enabled(False):
            tracer = poutine.trace(poutine.condition(plated, data=dict(given)))
            recorded = tracer.get_trace()
    except (RuntimeError, ValueError) as error:
        # Pyro raises a copy of what went wrong, its message followed by a table of shapes.
        cause = error.__cause__ if type(error.__cause__) is type(error) else error
        said = str(cause).partition("\n")[0].rstrip(".")
        if "Multiple" in said and "sites named" in said:
            raise InputError(
                f"the program visits an address twice ({said}); give each site its own."
            ) from cause
        if said.startswith("Shape mismatch inside plate('particles')"):
            raise InputError(
                f"a site does not fit {particles} particles ({said}); give its parameters and values the "
                "particle axis first, and put further dimensions into the event with `.to_event()`."
            ) from cause
        raise cause from None
    distributions: dict[str, Any] = {}
    values: dict[str, Tensor] = {}
    fixed = set()
    # Pyro types a message's entries as optional; those of a sample site are all there.
    nodes: Mapping[str, Any] = recorded.nodes
    for address, site in nodes.items():
        if site["type"] != "sample" or type(site["fn"]).__name__ == "_Subsample":
            continue
        if site["infer"].get("_deterministic"):
            continue
        if site["infer"].get("enumerate"):
            raise InputError(
                f"site {address!r} is enumerated, which particles cannot be; remove `enumerate`."
            )
        if site["mask"] is not None or not isinstance(site["scale"], int | float) or site["scale"] != 1:
            raise InputError(
                f"site {address!r} is scaled or masked by a handler, which traces do not read; "
                "use the distribution's own `.mask()`, or weigh inside a distribution."
            )
        distribution, value = site["fn"], site["value"]
        shape = tuple(distribution.batch_shape)
        if shape != (particles,):
            raise InputError(
                f"site {address!r} has batch shape {shape} and not ({particles},), "
                "one entry for each particle; put further dimensions into the event with `.to_event()`."
            )
        event = tuple(distribution.event_shape)
        own = tuple(value.shape) == (particles, *event)
        if not own and not (site["is_observed"] and tuple(value.shape) == event):
            raise InputError(
                f"the value of site {address!r} has shape {tuple(value.shape)}; "
                f"its event has shape {event}, for {particles} particles {(particles, *event)}."
            )
        distributions[address] = distribution
        values[address] = value
        if site["is_observed"] and address not in given:
            fixed.add(address)
    return Run(distributions, values, frozenset(fixed), dict(used), nodes["_RETURN"]["value"])


def _read(address: str) -> InputError:
    return InputError(
        f"site {address!r} is hidden from a proposal, which asked for its distribution or log-probability; "
        "let the proposal read earlier sites only."
    )


@dataclass(frozen=True, eq=False)
class _Hiding(Mapping[str, Any]):
    distributions: Mapping[str, Any]
    hidden: frozenset[str]

    def __getitem__(self, address: str) -> Any:
        if address in self.hidden:
            raise _read(address)
        return self.distributions[address]

    def __iter__(self) -> Iterator[str]:
        return iter(self.distributions)

    def __len__(self) -> int:
        return len(self.distributions)


@dataclass(frozen=True, eq=False)
class Trace:
    """Values by address for N particles, and the log-probability of every site, evaluated when asked for.

    `trace["hole"]` is a value; `trace[ancestors]`, `trace[mask]` and `trace[:50]` are traces of those
    particles. Treat it as immutable: the verbs of `bcppl.traces` make new ones.

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
        again = run(self.program, self.args, self.particles, given, self.carried)
        self.carried_states().update(again.carried)
        return again

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
            return _Hiding(self._run.distributions, self.hidden)
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

        Raises:
            InputError: no site has that address.
            InferenceError: a log-probability is NaN or +inf; names the site and the particles.
        """
        total = torch.zeros(self.particles, dtype=torch.float64)
        for address in addresses or self.addresses:
            total = total + self._site(address)
        return total

    def _site(self, address: str) -> Tensor:
        if address in self.hidden:
            raise _read(address)
        if address not in self.known:
            if address not in self._run.distributions:
                raise InputError(
                    f"the program visits no address {address!r}; "
                    f"it visits {', '.join(self.addresses) or 'none'}."
                )
            with torch.no_grad():
                value = self._run.distributions[address].log_prob(self._run.values[address])
            if tuple(value.shape) not in ((), (self.particles,)):
                raise InputError(
                    f"site {address!r} has log-probabilities of shape {tuple(value.shape)}; its distribution "
                    f"must give ({self.particles},), one for each particle."
                )
            value = value.to(torch.float64).expand(self.particles)
            bad = torch.isnan(value) | (value == torch.inf)
            if bool(bad.any()):
                which = bad.nonzero().flatten().tolist()
                raise InferenceError(
                    f"site {address!r} has a log-probability of {float(value[which[0]])} for "
                    f"{len(which)} of {self.particles} particles (first: {', '.join(map(str, which[:5]))}); "
                    "a value or a parameter of its distribution is out of range there."
                )
            self.known[address] = value
        return self.known[address]

    def __getitem__(self, key: str | Index) -> Any:
        if isinstance(key, str):
            if key in self.choices:
                return self.choices[key]
            if key in self.observations:
                return self.observations[key]
            raise KeyError(f"the trace has no value at address {key!r}")
        index = torch.arange(self.particles)[key if isinstance(key, slice) else torch.as_tensor(key)].reshape(
            -1
        )
        return Trace(
            self.program,
            self.args,
            len(index),
            {a: v[index] for a, v in self.choices.items()},
            self.observations,
            {a: e.take(index) for a, e in self.carried.items()},
            {a: v[index] for a, v in self.known.items()},
            self.hidden,
        )

    def __contains__(self, address: object) -> bool:
        return address in self.choices or address in self.observations

    def __len__(self) -> int:
        return self.particles

    def where(self, mask: Tensor, other: Trace) -> Trace:
        """This trace where `mask` (N,) is true, the other (same program, same addresses) elsewhere."""
        shared = set(self.known) & set(other.known)
        return Trace(
            self.program,
            self.args,
            self.particles,
            {
                a: torch.where(mask.reshape(-1, *[1] * (v.ndim - 1)), v, other.choices[a])
                for a, v in self.choices.items()
            },
            self.observations,
            {a: e.where(mask, other.carried[a]) for a, e in self.carried.items() if a in other.carried},
            {a: torch.where(mask, self.known[a], other.known[a]) for a in shared},
            self.hidden | other.hidden,
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
            InputError: an address is not latent, or a value has the wrong shape.
        """
        self._refuse_other_than_latent(values)
        for address, value in values.items():
            if value.shape != self.choices[address].shape:
                raise InputError(
                    f"the new value of {address!r} has shape {tuple(value.shape)}, "
                    f"the old one {tuple(self.choices[address].shape)}; give one for each particle."
                )
        return self._moved({**self.choices, **values}, frozenset(values))

    def regenerated(self, addresses: Collection[str]) -> Trace:
        """The same run with some latent addresses drawn anew from the program, in its order.

        Raises:
            InputError: an address is not latent, or the values drawn change which addresses are visited.
        """
        self._refuse_other_than_latent(addresses)
        held = {a: v for a, v in self.choices.items() if a not in addresses}
        ran = run(self.program, self.args, self.particles, {**held, **self.observations}, self.carried)
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
        for address, value in self.known.items():
            if address not in new and unchanged(self, moved, address):
                moved.known[address] = value
        # A state that was thrown away must not be merged back in later.
        for name in [n for n in moved.carried_states() if n not in moved._run.carried]:
            del moved.carried_states()[name]
        return moved


def unchanged(first: Trace, second: Trace, address: str) -> bool:
    """Whether a site of the same value in two traces hangs on the same inputs, so that it says the same."""
    then, now = first._run.distributions[address], second._run.distributions[address]
    return hasattr(now, "inputs") and same_inputs(then.inputs, now.inputs)

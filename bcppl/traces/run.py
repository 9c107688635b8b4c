"""One pass through a program for N particles at once: sites set to given values, the others sampled.

Inside the program the particles are the last batch dimension, as Pyro's plates have it, and the plates that
the program itself opens lie to the left of it: five points have batch shape (5, N). Outside, in a trace, the
particle axis comes first: (N, 5, *event), and what is observed of them is (5, *event).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin
from pyro.poutine.indep_messenger import IndepMessenger
from pyro.poutine.messenger import Messenger
from pyro.poutine.runtime import _DIM_ALLOCATOR, _PYRO_STACK
from pyro.poutine.subsample_messenger import _Subsample
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.devices import alone
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.shortcuts import drawn, unvalidated
from bcppl.distributions.support import Support
from bcppl.errors import InputError
from bcppl.traces.carried import Entry, carrying
from bcppl.traces.dependence.surroundings import surroundings
from bcppl.traces.differentiation.graph import graph, kept, taken_out
from bcppl.traces.explained import explained, unfit, unfit_particles, unsampled
from bcppl.traces.structural import STRUCTURAL, UnchosenError
from bcppl.traces.values import Value, tensors

Program = Callable[..., Any]
PARTICLES = "particles"


@dataclass(eq=False)
class Common:
    """What a trace and those of particles chosen from it have in common, as far as it was asked for.

    Attributes:
        addresses: in the order of the program, if they were asked for.
        supports: of latent addresses, where they depend on no value.
    """

    addresses: tuple[str, ...] | None = None
    supports: dict[str, Support] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Run:
    """The record of one pass through a program, by address or name.

    Attributes:
        distributions: of every site, in the order of the program.
        values: (N, *plates, *event), or (*plates, *event) where a site was set to one value for all.
        fixed: addresses that the program observes itself (`obs=`, `pyro.factor`).
        carried: simulator states that it used or made.
        result: what it returned.
        coincident: addresses with a plate or an event axis of N entries (`bcppl.traces.verbs`).
        whole: the first address, if its distribution had N entries before it was expanded to the particles.
        surroundings: what lazy sites read from outside (`bcppl.traces.dependence.surroundings`).
        structural: addresses whose values determine which others are visited, in the order of the program.
        determined: (N, ...) what it names by `pyro.deterministic`.
    """

    distributions: dict[str, Any]
    values: dict[str, Tensor]
    fixed: frozenset[str]
    carried: dict[str, Entry]
    result: Any
    coincident: frozenset[str]
    whole: frozenset[str]
    surroundings: Mapping[str, dict[Any, Any]]
    structural: tuple[str, ...] = ()
    determined: Mapping[str, Tensor] = field(default_factory=dict)

    def refuse_unvisited(self, addresses: Iterable[str]) -> None:
        """Refuse addresses that the program did not visit."""
        for address in addresses:
            if address not in self.distributions:
                visited = ", ".join(self.distributions) or "none"
                raise InputError(f"address {address!r} is one the program never visits; it visits {visited}.")


def run(
    program: Program,
    args: tuple[Any, ...],
    particles: int,
    given: Mapping[str, Value],
    carried: Mapping[str, Entry],
    *,
    draws_lazy: bool = True,
) -> Run:
    """Run a program under a plate of `particles`, its sites set to `given` and the others sampled.

    Lazy sites are NaN instead of samples unless `draws_lazy`.

    Raises:
        InputError: no particles, arguments that are no tuple, a duplicate address, an enumerated site, a
            subsampled plate, a site that does not fit the particles and the plates around it, a value that is
            no tensor or has the wrong shape, tensors in the program that do not fit the particles, or one
            that is asked for a single number; the sentence names the address.
    """
    if not isinstance(args, tuple | list):
        raise InputError(
            f"a program's arguments are of type {type(args).__name__}; give a tuple of them, `(x,)` for one."
        )
    particles = whole_number("a program was to be run for {} particles", particles)
    given = tensors(given)
    recorder = _Recorder(particles, given, draws_lazy)
    with alone(), carrying(carried, particles) as used, graph(), unvalidated():
        try:
            with _apart(), recorder, _Particles(PARTICLES, particles, dim=-1) as plate:
                result = program(*args)
        except (RuntimeError, TypeError, ValueError) as error:
            last = next(reversed(recorder.distributions), None)
            if kept() and "requires grad" in str(error):
                raise taken_out(
                    "the program" + ("" if last is None else f", after site {last!r},")
                ) from error
            reason = explained(error, particles, last)
            if reason is error:
                raise
            raise reason from error
    values, fixed = recorder.values, frozenset(recorder.fixed)
    coincident, whole = frozenset(recorder.coincident), frozenset(plate.whole)
    outside, structural = surroundings(recorder.distributions), tuple(recorder.structural)
    sites, named = recorder.distributions, recorder.determined
    return Run(sites, values, fixed, used, result, coincident, whole, outside, structural, named)


@contextmanager
def _apart() -> Iterator[None]:
    """Another run within a run, and no part of it: a proposal reads a trace that runs its own program."""
    outermost = next((k for k, each in enumerate(_PYRO_STACK) if isinstance(each, _Recorder)), None)
    if outermost is None:
        yield
        return
    handlers, plates = _PYRO_STACK[outermost:], _DIM_ALLOCATOR._stack[:]
    del _PYRO_STACK[outermost:]
    _DIM_ALLOCATOR._stack[:] = []
    try:
        yield
    finally:
        _PYRO_STACK[outermost:] = handlers
        _DIM_ALLOCATOR._stack[:] = plates


def inward(value: Tensor, distribution: Any) -> Tensor:
    """A trace's value as the site's distribution takes it, with the particle axis behind the plates."""
    plates = len(distribution.batch_shape) - 1
    if plates == 0:
        return value
    shared = value.ndim == plates + len(distribution.event_shape)
    return value.unsqueeze(plates) if shared else value.movedim(0, plates)


class _Particles(IndepMessenger):
    """The plate of the particles: `pyro.plate`, at less cost where a site has its shape already."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.first: str | None = None
        self.whole: set[str] = set()

    def _pyro_sample(self, message: Any) -> None:
        batch = message["fn"].batch_shape if hasattr(message["fn"], "batch_shape") else None
        if batch is None or isinstance(message["fn"], _Subsample) or message["infer"].get("_deterministic"):
            return
        if not batch or batch[-1] == 1 != self.size:
            message["fn"] = message["fn"].expand(torch.Size([*batch[:-1], self.size]))
        elif batch[-1] != self.size:
            alone = len(message["cond_indep_stack"]) == 1
            raise (
                unfit_particles(message["name"], self.size, batch[-1])
                if alone
                else unfit(message["name"], -1, PARTICLES, self.size, batch[-1])
            )
        elif self.first is None and self.size > 1:
            self.whole.add(message["name"])
        self.first = self.first or message["name"]

    def _process_message(self, message: Any) -> None:
        super()._process_message(message)
        if message["type"] == "sample" and not message["done"]:
            self._pyro_sample(message)


class _Recorder(Messenger):
    """Sets sites to given values and records all; as the outermost handler it sees them after plates."""

    def __init__(self, particles: int, given: Mapping[str, Tensor], draws_lazy: bool = True) -> None:
        super().__init__()
        self.draws_lazy = draws_lazy
        self.particles = particles
        self.given = given
        self.distributions: dict[str, Any] = {}
        self.values: dict[str, Tensor] = {}
        self.fixed: set[str] = set()
        self.coincident: set[str] = set()
        self.structural: list[str] = []
        self.determined: dict[str, Tensor] = {}

    def _pyro_sample(self, message: Any) -> None:
        if _is_no_choice(message):
            return
        address, distribution = message["name"], message["fn"]
        if address in self.distributions:
            raise InputError(f"the program visits address {address!r} twice; give each site its own.")
        if message["infer"].get("enumerate"):
            raise InputError(
                f"site {address!r} is enumerated, which particles cannot be; remove `enumerate`."
            )
        if message["mask"] is not None or _scaled(message["scale"]):
            raise InputError(
                f"site {address!r} is scaled or masked by a handler or lies in a subsampled plate, which "
                "traces do not read; mask an observed site by its distribution's own `.mask()`, or weigh "
                "inside a distribution."
            )
        if not isinstance(distribution, TorchDistributionMixin):
            kind = f"{type(distribution).__module__}.{type(distribution).__name__}"
            raise InputError(
                f"site {address!r} is sampled from a {kind}; give a distribution of `pyro.distributions`."
            )
        self._fits(address, tuple(distribution.batch_shape), message["cond_indep_stack"])
        self.distributions[address] = distribution
        if self.particles > 1 and self._coincides(distribution):
            self.coincident.add(address)
        if message["infer"].get(STRUCTURAL):
            self.structural.append(address)
            if address not in self.given and message["value"] is None:
                earlier = {a: v for a, v in self.values.items() if a not in self.fixed}
                raise UnchosenError(address, distribution, earlier)
        if address in self.given:
            value = self.given[address]
            if address in self.structural:
                value = value.to(torch.float64)  # every discrete density takes it, and few a whole number
            self._has_shape(address, value, distribution)
            message["value"], message["is_observed"] = inward(value, distribution), True
            self.values[address] = value
        elif message["value"] is None:
            lazy = not self.draws_lazy and isinstance(distribution, LazyDistribution)
            message["value"] = distribution.undrawn() if lazy else _draw(address, distribution)

    def _pyro_post_sample(self, message: Any) -> None:
        address = message["name"]
        if message["infer"].get("_deterministic"):
            self.determined[address] = self._determined(message)
        if _is_no_choice(message) or address in self.values:
            return
        value, distribution = message["value"], message["fn"]
        if message["is_observed"]:
            self.fixed.add(address)
            value = self._shared(value, distribution)
        plates = len(distribution.batch_shape) - 1
        if plates and value.ndim == plates + 1 + len(distribution.event_shape):
            value = value.movedim(plates, 0)
        self._has_shape(address, value, distribution)
        self.values[address] = value

    def _determined(self, message: Any) -> Tensor:
        """A value that the program names, the particle axis first: it stands behind those of the plates."""
        value = message["value"]
        plates = max(-frame.dim for frame in message["cond_indep_stack"] if frame.dim is not None)
        # Without `event_dim` Pyro takes all axes to be the event's.
        declared = len(message["fn"].batch_shape)
        axis = min(declared or plates, value.ndim) - 1
        if axis >= 0 and value.shape[axis] == self.particles:
            return value.movedim(axis, 0)
        if self.particles in value.shape:
            raise InputError(
                f"deterministic site {message['name']!r} has shape {tuple(value.shape)}, and its axis of the "
                f"{self.particles} particles is not where that of other sites is; open the plates of its "
                "other axes around it, or have the particles first and give `event_dim`."
            )
        return value.expand(self.particles, *value.shape)

    def _shared(self, value: Any, distribution: Any) -> Any:
        """A value that the program observes in its plates, (*plates, 1, *event), without the empty axis."""
        if 0 in distribution.event_shape:  # of `pyro.factor`, which does not expand it to the plates
            return value.new_empty(*distribution.batch_shape[:-1], *distribution.event_shape)
        plates = len(distribution.batch_shape) - 1
        whole = plates + 1 + len(distribution.event_shape)
        if plates and value.ndim == whole and value.shape[plates] == 1 != self.particles:
            return value.squeeze(plates)
        return value

    def _fits(self, address: str, batch: tuple[int, ...], frames: Any) -> None:
        """The batch must be the particles and the plates around the site, and nothing else."""
        if len(frames) == 1 and batch == (self.particles,):
            return
        sizes = {frame.dim: frame.size for frame in frames if frame.dim is not None}
        expected = tuple(sizes.get(-k, 1) for k in range(-min(sizes), 0, -1))
        if batch != expected:
            raise InputError(
                f"site {address!r} has batch shape {batch} and not {expected}, that of the plates around it "
                f"and of the {self.particles} particles; put further dimensions into the event with "
                "`.to_event()`, or open a plate for them."
            )

    def _coincides(self, distribution: Any) -> bool:
        """Whether another axis has as many entries as there are particles; lazy sites check their own."""
        batch, event = distribution.batch_shape, distribution.event_shape
        return (len(batch) > 1 and self.particles in batch[:-1]) or (
            len(event) > 0 and self.particles in event and not isinstance(distribution, LazyDistribution)
        )

    def _has_shape(self, address: str, value: Tensor, distribution: Any) -> None:
        batch, event = tuple(distribution.batch_shape), tuple(distribution.event_shape)
        one = (*batch[:-1], *event)
        if tuple(value.shape) not in (one, (self.particles, *one)):
            raise InputError(
                f"the value of site {address!r} has shape {tuple(value.shape)}; one value for all particles "
                f"has shape {one}, one for each of {self.particles} particles {(self.particles, *one)}."
            )


def _draw(address: str, distribution: Any) -> Any:
    try:
        value = drawn(distribution)
        return distribution() if value is None else value
    except NotImplementedError as error:
        raise unsampled(address, distribution) from error


def _is_no_choice(message: Any) -> bool:
    return type(message["fn"]) is _Subsample or bool(message["infer"].get("_deterministic"))


def _scaled(scale: Any) -> bool:
    return not isinstance(scale, int | float) or scale != 1

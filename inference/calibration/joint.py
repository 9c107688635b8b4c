"""Draws of a joint distribution: latent values from the prior, and data simulated at them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from bcppl.arguments import address_list
from bcppl.distributions.support import freedom_of
from bcppl.errors import InputError
from bcppl.poses import Freedom
from bcppl.traces import Model, Series, Trace, generate, simulate
from bcppl.traces.run import Program, run
from bcppl.traces.values import Values

# A test quantity (K,) of latent values (K, *event) by address, and of the data.
Quantity = Callable[[Values, Any], Tensor]


class Drawn(NamedTuple):
    """A draw of the joint: latent values (*event) by address, and the data that were simulated there."""

    truth: dict[str, Tensor]
    data: Any


class Prior(NamedTuple):
    """Some draws of the prior (K, *event), their log-likelihood (K,) of data, and which of them are poses."""

    values: dict[str, Tensor]
    log_likelihood: Tensor
    freedoms: dict[str, Freedom]


class Densities(NamedTuple):
    """The log-likelihood (K,) of data at latent values, and the log-density (K,) of both."""

    log_likelihood: Tensor
    log_density: Tensor


class Simulator(Protocol):
    """What `calibrate` draws truth and data from; `Joint` and `Recorded` are two."""

    @property
    def quantities(self) -> Mapping[str, Quantity]:
        """Further test quantities, by name."""

    def draw(self) -> Drawn:
        """One draw, from torch's generator."""

    def prior(self, data: Any, count: int) -> Prior:
        """Draws of the prior, which may depend on the data (a recording's guess) but not on the truth."""

    def densities(self, values: Values, data: Any) -> Densities | None:
        """The densities at latent values (K, *event); None where these leave out some that are latent."""


@dataclass(frozen=True)
class Joint:
    """The joint distribution of a program: all of its sites are sampled, and some of them are the data.

        Joint(coin, (10,), ["heads"])

    Attributes:
        program: samples every site itself. A series is called by a program that runs its steps.
        args: its arguments.
        observed: the addresses of the data, or one; all others are latent.
        quantities: further test quantities by name, each a function of the latent values (K, *event) by
            address and of the data that gives numbers (K,).

    Raises:
        InputError: the program observes something itself, or does not visit an address.
    """

    program: Program
    args: tuple[Any, ...]
    observed: Sequence[str]
    quantities: Mapping[str, Quantity] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "observed", tuple(address_list(self.observed)))
        with torch.random.fork_rng(devices=[]):
            ran = run(self.program, self.args, 1, {}, {}, draws_lazy=False)
        ran.refuse_unvisited(self.observed)
        if ran.fixed:
            raise InputError(
                f"a program whose joint distribution is to be drawn observes {min(ran.fixed)!r} itself "
                "(`obs=` or `pyro.factor`); sample that, and name it among the observed addresses."
            )

    def draw(self) -> Drawn:
        """One draw of latent values and data."""
        trace = simulate(self.program, self.args, 1)
        truth = {a: value[0] for a, value in trace.choices.items() if a not in self.observed}
        return Drawn(truth, {address: trace[address][0] for address in self.observed})

    def prior(self, data: Any, count: int) -> Prior:
        """Draws of the latent values, and the data's log-likelihood there."""
        trace, log_likelihood = generate(self.program, self.args, data, count)
        return Prior(dict(trace.choices), log_likelihood, freedoms_of(trace))

    def densities(self, values: Values, data: Any) -> Densities | None:
        """Of the data, and of both."""
        count = len(next(iter(values.values())))
        trace, log_density = generate(self.program, self.args, data, count, choices=values)
        return Densities(trace.log_prob(*self.observed), log_density)


@dataclass(frozen=True)
class Recorded:
    """A model's own world: recordings that it simulates, whose truth is the pose that is sought.

    The truth has to be distributed as the model's prior at the recording's guess. A world with other
    mechanisms than the model's, or other nuisance parameters, shows what they cost in calibration.

    Attributes:
        model: has a `simulate_recording`.
        options: of that.
        quantities: as those of `Joint`.

    Raises:
        InputError: the model simulates no recordings, or its pose moves.
    """

    model: Model
    options: Mapping[str, Any] = field(default_factory=dict)
    quantities: Mapping[str, Quantity] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.model.simulate_recording is None:
            raise InputError("the model simulates no recordings; give one with a `simulate_recording`.")
        if isinstance(self.model.program, Series):
            raise InputError("the model's pose moves; calibrate one with a pose that stays.")

    def __reduce__(self) -> tuple[Any, ...]:
        """For other processes: settings of an inference are a read-only view, which cannot be sent."""
        name, settings = self.model.inference
        model = replace(self.model, inference=(name, dict(settings)))
        return type(self), (model, dict(self.options), self.quantities)

    def draw(self) -> Drawn:
        """A recording, and its true pose."""
        assert self.model.simulate_recording is not None
        recording = self.model.simulate_recording(int(torch.randint(2**31, ())), **self.options)
        if recording.truth is None:
            raise InputError("a recording was simulated without its true pose, which calibration needs.")
        return Drawn({self.model.pose: torch.as_tensor(recording.truth, dtype=torch.float64)}, recording)

    def prior(self, data: Any, count: int) -> Prior:
        """Draws of the pose; without its likelihood, which may take a simulation."""
        trace, weight = generate(self.model.program, (self.model.prepare(data), []), {}, count)
        return Prior({self.model.pose: trace[self.model.pose]}, weight, freedoms_of(trace))

    def densities(self, values: Values, data: Any) -> Densities | None:
        """None: there may be other latent values than the pose, whose truth is not known."""
        return None


def freedoms_of(trace: Trace) -> dict[str, Freedom]:
    """The free axes of every latent pose, by address."""
    each = {address: freedom_of(trace.distributions[address]) for address in trace.choices}
    return {address: freedom for address, freedom in each.items() if freedom is not None}

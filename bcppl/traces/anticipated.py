"""A trace together with the measurement that comes next, as a forward kernel reads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from bcppl.cached import cached_property
from bcppl.distributions.support import Support
from bcppl.traces.dependence.changes import changed
from bcppl.traces.series import SeriesTrace
from bcppl.traces.trace import Trace
from bcppl.traces.update import update
from bcppl.traces.values import Value, tensors
from bcppl.traces.verbs import constrained


@dataclass(frozen=True, eq=False)
class Anticipated:
    """A trace, and the arguments and observations of the next measurement.

    Latent values are the trace's, observed ones those of the measurement too. Distributions and
    log-probabilities are those of the trace updated by the measurement, when they are asked for. Where the
    measurement brings latent values, which are then sampled from the program, new sites and those that it
    changes are hidden: what a kernel reads must not depend on values that it does not record. The next step
    of a series has sites of its own: those of the trace are shown, except where they are observed again.

    Attributes:
        trace: of N particles.
        args: the program's arguments with those of the measurement.
        measured: tensors, arrays or numbers at the measurement's addresses.
    """

    trace: Trace
    args: tuple[Any, ...]
    measured: Mapping[str, Value]

    @cached_property
    def _values(self) -> Mapping[str, Tensor]:
        return tensors(self.measured)

    @cached_property
    def updated(self) -> Trace:
        """The trace updated by the measurement, or of a series the next step."""
        if not isinstance(self.trace, SeriesTrace):
            return update(self.trace, args=self.args, observations=self.measured).trace
        stage, count = self.trace.next_stage(), self.trace.particles
        return constrained(stage, self.args, count, self.measured, {}, self.trace.carried)[0]

    @property
    def brought(self) -> list[str]:
        """The latent addresses that come with the measurement."""
        series = isinstance(self.trace, SeriesTrace)
        return [a for a in self.updated.choices if series or a not in self.trace]

    @cached_property
    def _shown(self) -> Trace:
        if isinstance(self.trace, SeriesTrace):
            return self.trace.hiding(a for a in self.trace.addresses if a in self.measured)
        if not self.brought:
            return self.updated
        old = [a for a in self.trace.addresses if a in self.updated._run.distributions]
        return self.updated.hiding([*self.updated.since(self.trace), *changed(self.trace, self.updated, old)])

    @property
    def particles(self) -> int:
        """N."""
        return self.trace.particles

    @property
    def choices(self) -> Mapping[str, Tensor]:
        """The latent values, particle axis first."""
        return self.trace.choices

    @property
    def observations(self) -> Mapping[str, Tensor]:
        """The observed values, those of the measurement too."""
        return {**self.trace.observations, **self._values}

    @property
    def distributions(self) -> Mapping[str, Any]:
        """The distribution of every site, by address in the program's order."""
        return self._shown.distributions

    @property
    def addresses(self) -> list[str]:
        """All addresses in the order of the program."""
        return self._shown.addresses

    def support(self, address: str) -> Support:
        """Where the values at a latent address may lie."""
        return self._shown.support(address)

    def log_prob(self, *addresses: str) -> Tensor:
        """Log-probability (N,) of sites, summed; of all sites where none is named."""
        return self._shown.log_prob(*addresses)

    def __getitem__(self, address: str) -> Tensor:
        value: Tensor = self._values[address] if address in self.measured else self.trace[address]
        return value

    def __contains__(self, address: object) -> bool:
        return address in self.trace or address in self.measured

    def __len__(self) -> int:
        return self.trace.particles

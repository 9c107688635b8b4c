"""The program of a series' static parameters, its states integrated out by particle filters.

    walk = marginal(Series(init, step), "rho", observed="y", particles=100)
    observed = {f"y/{t}": y for t, y in enumerate(ys, 1)}
    trace, _ = generate(walk, ([()] * len(ys),), observed, 20)
    chains = markov_chains(metropolis_hastings(drift("rho")), trace, moves=1000)  # PMMH

Its sites are the parameters, and the observations under the addresses of `unrolled(series)`. The likelihood
of each step is a filter's unbiased estimate, which belongs to the particle. So shipped kernels are
pseudo-marginal (Andrieu and Roberts, Annals of Statistics 37, 2009): Metropolis-Hastings is PMMH (Andrieu,
Doucet and Holenstein, Particle Markov chain Monte Carlo methods, JRSS B 72, 2010, section 2.4.2), and SMC
over the steps with such moves is SMC^2 (Chopin, Jacob and Papaspiliopoulos, JRSS B 75, 2013, section 3).
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pyro
import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError
from bcppl.inference.series.nested import Filters, Shared
from bcppl.inference.series.unrolling import numbered, refuse_no_steps
from bcppl.traces import Series, carried, simulate
from bcppl.traces.dependence.equality import comparison
from bcppl.traces.differentiation.graph import kept
from bcppl.traces.run import run
from bcppl.traces.series import SeriesTrace

_REMEMBERED = 8  # arguments of `init`


class SeriesLikelihood(LazyDistribution):
    """The likelihood of one step of a series given those before it, as M particle filters estimate it.

    An estimate is drawn once. It belongs to the filters, which the trace carries, and which are made again
    where a static parameter or the arguments of a step change and at no other time: `log_prob` of what has
    not changed is the same number whenever it is asked for. Pseudo-marginal kernels leave their target
    invariant only so.

    Attributes:
        filters: M of them.
        number: of the step, from 1.
        address: of the observation in the series' step.
        args: the arguments of the step.
    """

    cost = 2

    def __init__(
        self,
        filters: Filters,
        number: int,
        address: str,
        args: tuple[Any, ...],
        event_shape: tuple[int, ...],
    ) -> None:
        self.filters, self.number, self.address, self.args = filters, number, address, args
        super().__init__(len(filters.log_weights), event_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        """Estimate (M,) of the log-likelihood of the step's observation, (*event_shape)."""
        if kept():
            raise InputError(
                f"the likelihood of {self._name!r} is estimated by filters, which pass no gradient on; "
                "differentiate `unrolled(series)` in its place."
            )
        if value.shape != self.event_shape:
            raise InputError(
                f"observation {self._name!r} of a series is given with shape {tuple(value.shape)}; filters "
                f"weigh one that is the same for all particles, give it with shape {tuple(self.event_shape)}."
            )
        return self.filters.log_increment(self.number, self.address, self.args, value)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        """Refused: filters only weigh observations."""
        raise InputError(
            f"observation {self._name!r} of a series has no value, and its filters only weigh one; give it, "
            "or where nothing was seen any value of which the step masks the density (`.mask(seen)`); or "
            "simulate `unrolled(series)`, which has the same addresses."
        )

    @property
    def _name(self) -> str:
        return numbered(self.address, self.number)


def marginal(series: Series, *static: str, observed: str, particles: int, threshold: float = 0.5) -> Marginal:
    """The program of a series' static parameters given its observations, with filters for its states.

    Args:
        series: `init` samples the static parameters and returns them in the state. What it conditions on
            itself (`obs=`, `pyro.factor`) is weighed with the first step's observation.
        static: addresses of the static parameters, one or more, with all that their distributions depend on.
        observed: the address at which each step observes.
        particles: N of each filter. A standard deviation of the estimated log-likelihood of 1 to 1.5 is a
            good compromise (Doucet, Pitt, Deligiannidis and Kohn, Biometrika 102, 2015).
        threshold: a filter resamples when its effective sample size is below this share of N.

    Returns:
        A program `(steps, *args)`: `steps` is a list of the arguments of each step, `args` are those of
        `init`. Step t is observed at f"{observed}/{t}", t from 1.

    Raises:
        InputError: no static parameter is named, or a number is out of range; when it runs: `init` samples
            no such address, a step visits no such observation, or the distribution of a static parameter
            depends on a value that is integrated out.
    """
    if not static:
        raise InputError("marginal is given no static parameter; name the addresses that `init` samples.")
    particles = whole_number("the filters of a series are to have {} particles", particles)
    threshold = number_within(
        "the filters of a series are given the threshold {}", threshold, least=0, most=1
    )
    return Marginal(series, static, observed, particles, threshold)


@dataclass(frozen=True, eq=False)
class Marginal:
    """The program that `marginal` makes."""

    series: Series
    static: tuple[str, ...]
    observed: str
    particles: int
    threshold: float
    _shapes: dict[Hashable, tuple[int, ...]] = field(default_factory=dict, repr=False)
    _given: list[Shared] = field(default_factory=list, repr=False)

    def __call__(self, steps: Sequence[tuple[Any, ...]], *args: Any) -> None:
        """Sample the static parameters, and visit the observation of each step."""
        refuse_no_steps("a marginal series", steps)
        with _Until(self.static) as parameters:
            self.series.init(*args)
        if missing := [address for address in self.static if address not in parameters.values]:
            raise InputError(
                f"a series' `init` samples no static parameter {missing[0]!r}; name what it samples."
            )
        values = [parameters.values[address] for address in self.static]
        begin = partial(
            Filters.before,
            self.series,
            self._shared(args),
            self.particles,
            self.threshold,
            self.static,
            *values,
        )
        filters = carried(f"filters of {self.observed}", begin)
        filters.restart_where_changed(steps)
        for number, each in enumerate(steps, 1):
            shape = self._event_shape(args, each)
            site = SeriesLikelihood(filters, number, self.observed, each, shape)
            pyro.sample(numbered(self.observed, number), site)

    def _shared(self, args: tuple[Any, ...]) -> Shared:
        """The arguments of `init`, as one object from run to run.

        Of parts of it that have as many entries as there are particles, each would be taken for a particle's
        own, and filters be made again where particles have other places.
        """
        for known in self._given:
            if comparison()(known.args, args):
                return known
        self._given.append(Shared(args))
        del self._given[:-_REMEMBERED]
        return self._given[-1]

    def _event_shape(self, args: tuple[Any, ...], step: tuple[Any, ...]) -> tuple[int, ...]:
        """The shape of the observation, from one run of a step with arguments of this kind."""
        kind = _kind((args, step))
        if kind not in self._shapes:
            with torch.random.fork_rng(devices=[]):
                begun = simulate(self.series, args)
                assert isinstance(begun, SeriesTrace)
                # Not `extend`: a step may mask the density of what was not seen.
                ran = run(begun.next_stage(), step, begun.particles, {}, begun.carried, draws_lazy=False)
            if self.observed not in ran.distributions:
                raise InputError(
                    f"a series' step visits no observation {self.observed!r}; "
                    f"it visits {', '.join(ran.distributions) or 'none'}."
                )
            site = ran.distributions[self.observed]
            self._shapes[kind] = (*site.batch_shape[:-1], *site.event_shape)
        return self._shapes[kind]


def _kind(value: Any) -> Hashable:
    """What an observation's shape may depend on: shapes and whole numbers, but no number that is measured."""
    if isinstance(value, list | tuple):
        return tuple(_kind(each) for each in value)
    if isinstance(value, Mapping):
        return tuple((key, _kind(each)) for key, each in value.items())
    if isinstance(value, Tensor | np.ndarray) and value.ndim:
        return tuple(value.shape)
    return value if isinstance(value, int | str) else type(value).__name__


class _CompleteError(Exception):
    """All addresses have values."""


class _Until(Messenger):
    """Runs a program until some addresses have values; other sites are no part of the run around it."""

    def __init__(self, addresses: Sequence[str]) -> None:
        super().__init__()
        self.addresses = addresses
        self.values: dict[str, Tensor] = {}

    def _pyro_sample(self, message: Any) -> None:
        if message["name"] not in self.addresses:
            message["stop"] = True

    def _pyro_post_sample(self, message: Any) -> None:
        if message["name"] not in self.addresses:
            return
        value, site = message["value"], message["fn"]
        plates = len(site.batch_shape) - 1
        if value.ndim < len(site.batch_shape) + len(site.event_shape):
            value = value.unsqueeze(plates)
        self.values[message["name"]] = value.expand(site.shape()).movedim(plates, 0)
        if len(self.values) == len(self.addresses):
            raise _CompleteError

    def __exit__(self, kind: Any, error: Any, traceback: Any) -> bool:  # type: ignore[override]
        super().__exit__(kind, error, traceback)
        return kind is _CompleteError

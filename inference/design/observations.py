"""What a robot would see and feel: simulated once, drawn with noise, weighed at all particles.

Three steps, written with the verbs: a population's trace is extended by a candidate's arguments, its new
sites free (the simulator runs, once for each particle); they are drawn anew at the hypotheses; and what
was drawn is weighed at every particle. Where simulators are carried by the trace or held by a lazy site, none
of them runs a second time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InferenceError, InputError
from bcppl.inference.design.weighing import refuse_all_lost, weighed
from bcppl.traces import Trace, extend, regenerate

Arguments = Callable[[Any], tuple[Any, ...]]
# What hypotheses would observe, (H, *event) by address.
Values = Mapping[str, Tensor]


@dataclass(frozen=True)
class Batched:
    """Arguments for a program that takes an action for each particle: candidates x particles in one batch.

    Attributes:
        one: the program's arguments for one candidate.
        many: those for a list of M candidates, one for each of M particles, which visit the same addresses.
            Simulator states that the trace carries keep their names and inputs, so that they need not be
            run again for a candidate alone.
        at_once: how many candidates are simulated together; memory grows with it.

    Raises:
        InputError: `at_once` is no whole number, 1 or more.
    """

    one: Arguments
    many: Callable[[list[Any]], tuple[Any, ...]]
    at_once: int = 32

    def __post_init__(self) -> None:
        whole_number("candidates are to be simulated {} at once", self.at_once)

    def __call__(self, candidate: Any) -> tuple[Any, ...]:
        """The program's arguments for one candidate."""
        return self.one(candidate)


@dataclass(frozen=True, eq=False)
class Simulated:
    """A candidate as all particles would feel it.

    Attributes:
        trace: of N particles, extended by the candidate; its new sites are latent.
        observed: the new addresses that would be observed.
    """

    trace: Trace
    observed: list[str]

    def drawn(self, hypotheses: Tensor, seed: int) -> Values:
        """What would be observed if particles (H,) were the truth, with sensor noise."""
        trace = self.trace
        if not torch.equal(hypotheses, torch.arange(trace.particles)):
            trace = trace.chosen(hypotheses)
        with seeded(seed):
            trace = regenerate(trace, self.observed).trace
        return {address: trace[address] for address in self.observed}

    def log_likelihoods(self, values: Values) -> Tensor:
        """Log-probability (H, N) of every observation at every particle.

        A row is NaN where the observation has no probability anywhere: the simulation of that hypothesis
        failed, or no particle can explain it.

        Raises:
            InferenceError: a log-probability is +inf, or all rows are NaN.
        """
        return refuse_all_lost(self.observed, weighed(self.trace, self.observed, values))


def simulated(
    trace: Trace, candidates: Sequence[Any], arguments: Arguments, latent: Collection[str], seed: int
) -> Iterator[Simulated]:
    """Every candidate, simulated once for all particles; the noise has the same seed for each.

    Args:
        trace: of N particles.
        candidates: what may be done next.
        arguments: the program's arguments after a candidate, or `Batched`.
        latent: new addresses that would not be observed, with wildcards ("bias_*").
        seed: of new latent values.

    Raises:
        InputError: a candidate adds nothing to observe, or a batch visits other addresses than a candidate.
    """
    if not isinstance(arguments, Batched):
        for k, candidate in enumerate(candidates):
            with seeded(seed):
                longer, _ = extend(trace, arguments(candidate), {})
            yield Simulated(longer, _observed(k, longer, trace, latent))
        return
    for first in range(0, len(candidates), arguments.at_once):
        together = candidates[first : first + arguments.at_once]
        particles = torch.arange(trace.particles)
        with seeded(seed):
            tiled = trace.chosen(particles.repeat(len(together)))
            longer, _ = extend(tiled, arguments.many([c for c in together for _ in particles]), {})
        added = set(longer.since(tiled))
        for k, candidate in enumerate(together):
            own = longer.chosen(particles + k * trace.particles)
            own = replace(own, args=arguments.one(candidate))
            if set(own.since(trace)) != added:
                raise InputError(
                    f"candidate {first + k} adds the addresses {', '.join(own.since(trace)) or 'none'}, "
                    f"a batch of candidates {', '.join(sorted(added)) or 'none'}; "
                    "make both arguments visit the same."
                )
            yield Simulated(own, _observed(first + k, own, trace, latent))


def _observed(number: int, longer: Trace, trace: Trace, latent: Collection[str]) -> list[str]:
    added = longer.since(trace)
    observed = [
        a for a in added if a in longer.choices and not any(fnmatchcase(a, pattern) for pattern in latent)
    ]
    if not observed:
        raise InputError(
            f"candidate {number} adds no site that would be observed (new: {', '.join(added) or 'none'}); "
            "give arguments that hold the old measurements and the new one."
        )
    return observed


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Draws within start from a seed, and leave the generator as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


Forecast = Callable[[Any, Trace], Values]


@dataclass(frozen=True, eq=False)
class Forecasted:
    """A candidate of which a forecast says what it would give; sites are asked for log-probabilities alone.

    Attributes:
        trace: of the N particles as they are.
        number: of the candidate.
        candidate: what may be done.
        args: the program's arguments once it is done.
        forecast: what it would give at the particles of a trace.
        seed: of new latent values.
    """

    trace: Trace
    number: int
    candidate: Any
    args: tuple[Any, ...]
    forecast: Forecast
    seed: int

    def drawn(self, hypotheses: Tensor, seed: int) -> Values:
        """What would be observed if particles (H,) were the truth.

        Raises:
            InputError: the forecast is empty, or not one value for each of these particles.
        """
        with seeded(seed):
            values = self.forecast(self.candidate, self.trace.chosen(hypotheses))
        wrong = [a for a, v in values.items() if not isinstance(v, Tensor) or len(v) != len(hypotheses)]
        if wrong or not values:
            raise InputError(
                f"the forecast for candidate {self.number} gives "
                f"{f'no {len(hypotheses)} values at {wrong[0]!r}' if wrong else 'nothing'}; "
                "give tensors by address, one value for each particle of the trace that it is given."
            )
        return values

    def log_likelihoods(self, values: Values) -> Tensor:
        """Log-probability (H, N) of every observation at every particle, as `extend` weighs it.

        Raises:
            InputError: the program does not visit an address, or a value has the wrong shape.
            InferenceError: no row could be weighed.
        """
        rows, failure = [], None
        for h in range(len(next(iter(values.values())))):
            try:
                with seeded(self.seed):
                    _, row = extend(self.trace, self.args, {a: v[h] for a, v in values.items()})
            except InferenceError as error:
                row, failure = torch.full((self.trace.particles,), torch.nan, dtype=torch.float64), error
            rows.append(row)
        found = torch.stack(rows)
        if failure is not None and bool(torch.isnan(found).all()):
            raise failure
        return refuse_all_lost(values, found)


def forecasted(
    trace: Trace, candidates: Sequence[Any], arguments: Arguments, forecast: Forecast, seed: int
) -> Iterator[Forecasted]:
    """Every candidate, with a forecast of what it would give."""
    for k, candidate in enumerate(candidates):
        yield Forecasted(trace, k, candidate, arguments(candidate), forecast, seed)

"""Simulated observations of candidates at outer samples, and their likelihoods at all particles.

Three steps, written with the verbs. A population's trace is extended by a candidate's arguments with its new
sites latent: the simulator runs once for each particle. The new sites are redrawn at the outer samples. Their
values are evaluated at every particle. Simulators that the trace carries or a lazy site holds run only once.

Where the sites have no `sample`, a sampler of the predictive distribution takes the place of the first two
steps.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.errors import InferenceError, InputError
from bcppl.inference.design.likelihoods import log_likelihoods, mark_failures
from bcppl.inference.resampling import seeded
from bcppl.traces import Trace, extend, regenerate

Arguments = Callable[[Any], tuple[Any, ...]]
# Observations at outer samples, (S, *event) by address.
Observations = Mapping[str, Tensor]
# Draws a candidate's observations from their predictive distribution at the particles of a trace.
PredictiveSampler = Callable[[Any, Trace], Observations]


@dataclass(frozen=True)
class BatchedArguments:
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
class SimulatedCandidate:
    """A candidate, simulated at all particles.

    The trace of N particles is extended by it, its new sites latent; `observed` are those that would be.
    """

    trace: Trace
    observed: list[str]

    def draw(self, particles: Tensor, seed: int) -> Observations:
        """Observations, with sensor noise, if particles (S,) were the true value."""
        trace = self.trace
        if not torch.equal(particles, torch.arange(trace.particles)):
            trace = trace.chosen(particles)
        with seeded(seed):
            trace = regenerate(trace, self.observed).trace
        return {address: trace[address] for address in self.observed}

    def log_likelihoods(self, values: Observations) -> Tensor:
        """Log-likelihood (S, N) of every observation at every particle.

        A row is NaN where the observation has no probability anywhere: the simulation of that outer sample
        failed, or no particle can explain it.
        """
        return mark_failures(self.observed, log_likelihoods(self.trace, self.observed, values))


def simulate_candidates(
    trace: Trace,
    candidates: Sequence[Any],
    arguments: Arguments | BatchedArguments,
    latent: Collection[str],
    seed: int,
) -> Iterator[SimulatedCandidate]:
    """Every candidate, simulated once at all particles; the noise has the same seed for each.

    Addresses that match a pattern in `latent` would not be observed ("bias_*").
    """
    if not isinstance(arguments, BatchedArguments):
        for k, candidate in enumerate(candidates):
            with seeded(seed):
                longer, _ = extend(trace, arguments(candidate), {})
            yield SimulatedCandidate(longer, observed_addresses(k, longer, trace, latent))
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
            yield SimulatedCandidate(own, observed_addresses(first + k, own, trace, latent))


def observed_addresses(number: int, longer: Trace, trace: Trace, latent: Collection[str] = ()) -> list[str]:
    """The addresses, one at least, that a candidate adds to a trace and that are not latent."""
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


@dataclass(frozen=True, eq=False)
class PredictedCandidate:
    """A candidate whose observations come from a predictive sampler; its sites need only `log_prob`.

    The trace of the N particles is not extended; `args` are the program's once the candidate is measured.
    """

    trace: Trace
    number: int
    candidate: Any
    args: tuple[Any, ...]
    predictive: PredictiveSampler
    seed: int

    def draw(self, particles: Tensor, seed: int) -> Observations:
        """Observations if particles (S,) were the true value."""
        with seeded(seed):
            return self.predictive(self.candidate, self.trace.chosen(particles))

    def log_likelihoods(self, values: Observations) -> Tensor:
        """Log-likelihood (S, N) of every observation at every particle, as `extend` evaluates it."""
        rows, failure = [], None
        for k in range(len(next(iter(values.values())))):
            try:
                with seeded(self.seed):
                    _, row = extend(self.trace, self.args, {a: v[k] for a, v in values.items()})
            except InferenceError as error:
                row, failure = torch.full((self.trace.particles,), torch.nan, dtype=torch.float64), error
            rows.append(row)
        total = torch.stack(rows)
        if failure is not None and bool(torch.isnan(total).all()):
            raise failure
        return mark_failures(values, total)

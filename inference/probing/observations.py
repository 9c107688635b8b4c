"""What a robot would see and feel: simulated once, drawn with noise, weighed at all particles.

Three steps, written with the verbs: a population's trace is extended by a candidate's arguments, its new
sites free (the simulator runs, once for each particle); they are drawn anew at the hypotheses; and what
was drawn is weighed at every particle. Where simulators are carried by the trace or held by a lazy site, none
of them runs a second time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import pyro
import torch
from torch import Tensor

from bcppl.arguments import whole_number
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.support import log_prob_inside
from bcppl.errors import InferenceError, InputError
from bcppl.traces import Trace, extend, regenerate
from bcppl.traces.run import inward
from bcppl.traces.trace import unchanged

Arguments = Callable[[Any], tuple[Any, ...]]


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


def drawn(one: Simulated, hypotheses: Tensor, seed: int) -> dict[str, Tensor]:
    """What would be observed if particles (H,) were the truth, with sensor noise: (H, *event) by address."""
    trace = one.trace
    if not torch.equal(hypotheses, torch.arange(trace.particles)):
        trace = trace.chosen(hypotheses)
    with seeded(seed):
        trace = regenerate(trace, one.observed).trace
    return {address: trace[address] for address in one.observed}


def log_likelihoods(one: Simulated, values: dict[str, Tensor]) -> Tensor:
    """Log-probability (H, N) of every hypothesis's observation at every particle.

    A row is NaN where the observation has no probability anywhere: the simulation of that hypothesis failed,
    or no particle can explain it.

    Raises:
        InferenceError: a log-probability is +inf, or all rows are NaN.
    """
    sites, first = one.trace.distributions, one.observed[0]
    # The first of the new sites hangs on no other's value; the others may.
    if len(one.observed) == 1 and _is_plain(sites[first]):
        found = _density(first, sites[first], values[first][:, None])
    else:
        count = len(values[first])
        found = torch.stack([_row(one, {a: v[h] for a, v in values.items()}) for h in range(count)])
    lost = torch.isnan(found).any(dim=1) | (found == -torch.inf).all(dim=1)
    if bool(lost.all()):
        raise InferenceError(
            f"what was simulated at {', '.join(map(repr, one.observed))} has no log-probability at any "
            "particle; the simulation failed, or the sites' `sample` and `log_prob` do not fit."
        )
    return torch.where(lost[:, None], torch.nan, found)


def _row(one: Simulated, values: dict[str, Tensor]) -> Tensor:
    """Log-probability (N,) of one observation, of all new sites together."""
    trace, particles = one.trace, one.trace.particles
    # What was rendered or simulated for a site is kept by it: it is asked again wherever its inputs stay.
    moved = trace
    if len(values) > 1:
        moved = trace.at({a: v.expand(particles, *v.shape) for a, v in values.items()})
    total = torch.zeros(particles, dtype=torch.float64)
    for k, (address, value) in enumerate(values.items()):
        kept = k == 0 or unchanged(trace, moved, address)
        site = (trace if kept else moved).distributions[address]
        density = _density(address, site, inward(value, site))
        total = total + density.expand(site.batch_shape).reshape(-1, particles).sum(dim=0)
    return total


def _is_plain(site: Any) -> bool:
    """Whether a site's densities broadcast: Pyro's own do, outside plates."""
    return len(site.batch_shape) == 1 and not isinstance(site, LazyDistribution)


def _density(address: str, site: Any, value: Tensor) -> Tensor:
    with torch.no_grad(), pyro.validation_enabled(False):
        density = log_prob_inside(site, value).to(torch.float64)
    if bool((density == torch.inf).any()):
        raise InferenceError(
            f"site {address!r} has a log-probability of inf for what was simulated there; "
            "a parameter of its distribution is out of range."
        )
    return density


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Draws within start from a seed, and leave the generator as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield

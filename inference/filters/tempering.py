"""Tempering: a likelihood is raised to increasing powers, with resampling and moves after each.

The next exponent is the largest whose conditional effective sample size stays above a share of N, found by
bisection: Zhou, Johansen and Aston, Toward automatic model comparison: an adaptive sequential Monte Carlo
approach, JCGS 25, 2016, section 3.3.2 (CESS, eq. 3.16). The step is that of Del Moral, Doucet and Jasra,
Sequential Monte Carlo samplers, JRSS B 68, 2006, and of Chopin and Papaspiliopoulos, An Introduction to
Sequential Monte Carlo, 2020, chapter 17.

With fixed exponents, fixed proposals, and moves whose number does not depend on the particles (`always_move`,
or resampling always), the estimate of the evidence is unbiased; otherwise it is consistent only. Evidence
that contains a surrogate likelihood is a surrogate's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.errors import InputError
from bcppl.inference.exponents import fixed_exponents, next_exponent, resampled_below
from bcppl.inference.filters.step import Observed, StepInfo, Stepped
from bcppl.inference.kernels import Kernel, Until, moved_by
from bcppl.inference.kernels.kernel import refuse_no_kernel
from bcppl.inference.population import Population
from bcppl.inference.resampling import Resample, adaptive, refuse_no_resampling, systematic
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Trace, extend


class Rejuvenated(NamedTuple):
    """A population after resampling and moves; ancestors (N,) and acceptance are None where not done."""

    population: Population
    ancestors: Tensor | None
    acceptance: float | None
    displacement: float = math.nan


# Resamples if it sees need, and moves the particles towards a target that they are weighted for.
Rejuvenation = Callable[[Population, Target], Rejuvenated]


def resample_move(
    kernel: Kernel | None,
    sweeps: int | Until | Callable[[Trace], int | Until],
    resample: Resample,
    always_move: bool = False,
) -> Rejuvenation:
    """Resample when needed, then move every particle: after a resampling, or always.

    Gilks and Berzuini, Following a moving target: Monte Carlo inference for dynamic Bayesian models, JRSS B
    63, 2001.
    """

    def rejuvenation(population: Population, target: Target) -> Rejuvenated:
        population, ancestors = resample(population)
        if kernel is None or (ancestors is None and not always_move):
            return Rejuvenated(population, ancestors, None)
        times = sweeps(population.trace) if callable(sweeps) else sweeps
        moved = moved_by(population, kernel, target, times)
        return Rejuvenated(moved.population, ancestors, moved.acceptance, moved.displacement)

    return rejuvenation


def kept_share(share: object) -> float:
    """A share of the particles that tempering is to keep, from 0 up to below 1."""
    what = "tempering is asked to keep a share of {} of the particles"
    return number_within(what, share, least=0.0, below=1.0)


def ratio_of_old_sites(longer: Trace, new: Sequence[str], log_weight: Tensor) -> Tensor:
    """Log ratio (N,) of the sites that new arguments change: the weight of `extend` but for the new sites."""
    own = POSTERIOR.part(longer, new)
    return torch.where(own == -torch.inf, 0.0, log_weight - own)


Share = Callable[[Trace], float]


def share_of(share: float | Share) -> Share:
    """A share that is a number or a function of the trace, as such a function."""
    if callable(share):
        return lambda trace: kept_share(share(trace))
    kept = kept_share(share)
    return lambda trace: kept


def where_left(share: Share) -> Resample:
    """Systematic resampling wherever exponents leave no more than a share of the effective sample size."""

    def resample(population: Population) -> tuple[Population, Tensor | None]:
        return adaptive(systematic, resampled_below(share(population.trace)))(population)

    return resample


class Schedule(NamedTuple):
    """Which exponents: those that keep a share of the conditional effective sample size, or fixed ones."""

    share: Share
    fixed: tuple[float, ...] | None = None

    def after(self, reached: float, population: Population, log_ratio: Tensor) -> float:
        """The exponent that follows `reached`."""
        if self.fixed is not None:
            return next(e for e in self.fixed if e > reached)
        return next_exponent(population.log_weights, log_ratio, reached, self.share(population.trace))


class Path(NamedTuple):
    """Densities p^(1 - e) q^e from p, at e = 0, to q, at e = 1.

    Attributes:
        log_ratio: log q / p (N,) of a trace.
        target: moves at an exponent e > 0 leave it invariant.
    """

    log_ratio: Callable[[Trace], Tensor]
    target: Callable[[float], Target]


def _likelihood_path(sites: Sequence[str]) -> Path:
    """Tempering of some sites together."""

    def target(exponent: float) -> Target:
        return Target(dict.fromkeys(sites, exponent)) if sites and exponent < 1.0 else POSTERIOR

    return Path(lambda trace: POSTERIOR.part(trace, sites), target)


_SWEEPS = 3


@dataclass(frozen=True, eq=False)
class Tempered:
    """A step that tempers: see `tempered`, which makes it."""

    rejuvenation: Rejuvenation
    schedule: Schedule

    def __call__(self, population: Population, observed: Observed) -> Stepped:
        """Assimilate observations at new addresses."""
        longer, log_weight = extend(population.trace, *observed)
        # Sites that the program itself fixes (`obs=`, `pyro.factor`) are tempered with the observations.
        new = [a for a in longer.since(population.trace) if a not in longer.choices]
        counted = population.with_trace(longer)
        changed = ratio_of_old_sites(longer, new, log_weight)
        now, info = self.temper(counted.reweighed(changed) if bool(changed.any()) else counted, new)
        return Stepped(now, info._replace(log_evidence=now.log_evidence - population.log_evidence))

    def temper(self, population: Population, new: Sequence[str]) -> Stepped:
        """Temper sites that the trace has and the weights do not yet count.

        Args:
            population: weighed for all other sites.
            new: addresses of the sites; none of them is latent.
        """
        return self.along(_likelihood_path(list(new)), population)

    def along(self, path: Path, population: Population) -> Stepped:
        """Weigh particles, weighted for the first density of a path, and move them along it."""
        start = population.log_evidence
        done, acceptances, ancestors, before, resampled = [], [], None, None, 0
        displacement = math.nan
        exponent, log_ratio = 0.0, path.log_ratio(population.trace)
        while exponent < 1.0:
            reached = exponent
            exponent = self.schedule.after(reached, population, log_ratio)
            done.append(exponent)
            # 0 times -inf is no number, so a particle that cannot be loses its weight here, once.
            population = weighed = population.reweighed((exponent - reached) * log_ratio)
            population, chosen, acceptance, come = self.rejuvenation(population, path.target(exponent))
            if chosen is not None:
                displacement = come
                resampled += 1
                ancestors = chosen if ancestors is None else ancestors[chosen]
                before = weighed.effective_sample_size
            if acceptance is not None:
                acceptances.append(acceptance)
            if exponent < 1.0:
                log_ratio = path.log_ratio(population.trace)
        info = StepInfo(
            sum(acceptances) / len(acceptances) if acceptances else math.nan,
            tuple(done),
            resampled,
            population.effective_sample_size if before is None else before,
            population.effective_sample_size,
            population.log_evidence - start,
            ancestors,
            displacement,
        )
        return Stepped(population, info)


def tempered(
    kernel: Kernel | None = None,
    *,
    sweeps: int | Until | Callable[[Trace], int | Until] = _SWEEPS,
    resample: Resample | None = None,
    share: float | Callable[[Trace], float] = 0.5,
    exponents: Sequence[float] | None = None,
    rejuvenation: Rejuvenation | None = None,
    always_move: bool = False,
) -> Tempered:
    """A step that tempers the likelihood of a measurement.

    Args:
        kernel: moves the particles after each resampling; None leaves them where they are.
        sweeps: how many moves of every particle after each resampling, `until(...)`, or a function of the
            trace that gives either. Random walks need of the order of the number of coordinates. Too few
            leave the evidence too low: on six isotropic axes with 1000 particles five sweeps of a walk of
            one size by -.18 +- .06 nats and of differential evolution by -.11 +- .06, twenty of the
            walk by -.03 +- .02 (`benchmarks/exact.py`). The more exponents, the more it is:
            data many prior deviations away need more sweeps, also on one axis.
        resample: when and how; by default systematic wherever the exponent leaves no more than `share` of the
            effective sample size (half, where the exponents are fixed).
        share: tempering keeps the conditional effective sample size above this share of the particles;
            with 0 there is one exponent, 1. A number, or a function of the trace, as `sweeps`.
        exponents: fixed ones, increasing, the last 1; then `share` does not matter.
        always_move: move after each exponent, whether or not that resampled. Whether particles are resampled
            depends on where they are, so moves that are made only then leave a bias of order 1/N in the
            evidence (one of 2 % with three particles). With it, or resampling always, and with fixed
            exponents and proposals, the estimate of the evidence is unbiased.
        rejuvenation: in place of `kernel`, `sweeps` and `resample`, such as `waste_free_moves(...)`.

    Returns:
        The step. It raises InferenceError where no particle is left with any weight.

    Raises:
        InputError: what is given is no kernel, `share` is not in [0, 1), `sweeps` is no whole number, 1 or
            more, the exponents do not increase to 1, or a rejuvenation is given beside a kernel,
            sweeps or a resampling.
    """
    if kernel is not None:
        refuse_no_kernel("tempered", kernel)
    kept = share_of(share)
    if not callable(sweeps) and not isinstance(sweeps, Until):
        # Without moves there is no kernel: None.
        sweeps = whole_number("tempering is to move the particles in {} sweeps", sweeps)
    fixed = None if exponents is None else fixed_exponents(exponents)
    if resample is not None:
        refuse_no_resampling("tempered", resample)
    if rejuvenation is None:
        default = where_left(kept if fixed is None else share_of(0.0))
        rejuvenation = resample_move(kernel, sweeps, default if resample is None else resample, always_move)
    elif kernel is not None or resample is not None or always_move or sweeps != _SWEEPS:
        raise InputError(
            "a step is given a rejuvenation beside a kernel, sweeps or a resampling, which are its own; give "
            "one or the other."
        )
    return Tempered(rejuvenation, Schedule(kept, fixed))

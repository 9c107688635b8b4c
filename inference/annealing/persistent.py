"""Persistent sampling: the particles of all temperatures are kept and weighed together at each new one.

Karamanis and Seljak, Persistent sampling: enhancing the efficiency of sequential Monte Carlo, 2024
(arXiv 2407.20722), algorithm 1. Waste-free SMC (`bcppl.inference.waste_free_moves`) keeps the states of the
chains at one temperature; here those of earlier temperatures stay as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.inference.exponents import exponent_after
from bcppl.inference.filters.step import StepInfo, Stepped
from bcppl.inference.kernels import Kernel, Until, moved_by
from bcppl.inference.kernels.kernel import refuse_no_kernel
from bcppl.inference.population import Population
from bcppl.inference.resampling import Scheme, systematic
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Trace, generate
from bcppl.traces.concatenation import concatenated


def persistent_sampling(
    program: Callable[..., Any],
    args: tuple[Any, ...],
    observations: Mapping[str, Tensor],
    particles: int,
    kernel: Kernel,
    *,
    sweeps: int | Until = 3,
    share: float = 2.0,
    scheme: Scheme = systematic,
) -> Stepped:
    """Weighted particles of the posterior, from those of all exponents of the likelihood.

    Each iteration draws N of all particles so far, moves them at the next exponent, and adds them. A particle
    is weighed against the mixture of the tempered posteriors of all iterations, each over its estimated
    evidence. The evidence is consistent, and not unbiased: estimates stand in the mixture.

    Args:
        program: a Pyro program.
        args: its arguments.
        observations: values by address, of the shape of the sites' plates and events.
        particles: N, moved at each exponent.
        kernel: moves them.
        sweeps: moves of every particle at each exponent, or `until(...)`.
        share: the effective sample size of all particles together that each exponent keeps, over N. It
            begins with twice as many draws of the prior.
        scheme: resamples.

    Returns:
        The population of all particles, weighted for the posterior, with the evidence; and the record. The
        variance of the evidence cannot be estimated from its founders.

    Raises:
        InputError: what is given is no kernel, or a number is out of range.
        NoWeightError: no particle has any weight.
    """
    refuse_no_kernel("persistent_sampling", kernel)
    count = whole_number("persistent sampling is to move {} particles", particles)
    share = number_within("persistent sampling is to keep an effective sample size of {} N", share, above=0.0)
    batches = max(1, math.ceil(2.0 * share))
    trace, log_likelihood = generate(program, args, observations, count * batches)
    addresses = [a for a in trace.addresses if a not in trace.choices]
    exponents, log_evidences, acceptances = [0.0] * batches, [0.0] * batches, []
    while exponents[-1] < 1.0:
        log_mixture = _log_mixture(log_likelihood, exponents, log_evidences)
        exponent = _next(log_likelihood, log_mixture, exponents[-1], share * count)
        pool = _weighted(trace, log_likelihood, log_mixture, exponent)
        target = Target(dict.fromkeys(addresses, exponent)) if exponent < 1.0 else Target()
        moved = moved_by(pool.selected(scheme(pool.log_weights, count)), kernel, target, sweeps)
        acceptances.append(moved.acceptance)
        exponents.append(exponent)
        log_evidences.append(pool.log_evidence)
        trace = concatenated([trace, moved.population.trace])
        log_likelihood = POSTERIOR.part(trace, addresses)
    log_mixture = _log_mixture(log_likelihood, exponents, log_evidences)
    final = _weighted(trace, log_likelihood, log_mixture, 1.0, log_evidences[-1])
    info = StepInfo(
        sum(acceptances) / len(acceptances),
        tuple(exponents[batches:]),
        len(acceptances),
        pool.effective_sample_size,
        final.effective_sample_size,
        final.log_evidence,
    )
    return Stepped(final, info)


def _log_mixture(log_likelihood: Tensor, exponents: list[float], log_evidences: list[float]) -> Tensor:
    """Log density (K,) of all particles' own mixture over that of the prior."""
    parts = {pair: 0 for pair in zip(exponents, log_evidences, strict=True)}
    for pair in zip(exponents, log_evidences, strict=True):
        parts[pair] += 1
    terms = [
        math.log(times / len(exponents)) - log_evidence + _tempered(log_likelihood, exponent)
        for (exponent, log_evidence), times in parts.items()
    ]
    return torch.logsumexp(torch.stack(terms), dim=0)


def _tempered(log_likelihood: Tensor, exponent: float) -> Tensor:
    return exponent * log_likelihood if exponent > 0.0 else torch.zeros_like(log_likelihood)


def _weighted(
    trace: Trace, log_likelihood: Tensor, log_mixture: Tensor, exponent: float, log_evidence: float = math.nan
) -> Population:
    log_weights = _tempered(log_likelihood, exponent) - log_mixture
    return Population(trace, log_weights, log_evidence, log_pairs=math.inf)


def _next(log_likelihood: Tensor, log_mixture: Tensor, reached: float, size: float) -> float:
    """The largest exponent above `reached` at which the effective sample size is `size`, or 1."""

    def enough(step: float) -> bool:
        weights = torch.softmax(_tempered(log_likelihood, reached + step) - log_mixture, dim=0)
        return float(1.0 / weights.square().sum()) >= size

    return exponent_after(reached, enough)

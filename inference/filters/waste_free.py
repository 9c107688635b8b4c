"""Waste-free SMC: few particles are resampled, each starts a chain, and all states of the chains are kept.

Dau and Chopin, Waste-free sequential Monte Carlo, JRSS B 84, 2022, algorithm 2.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from bcppl.arguments import number_within, whole_number
from bcppl.errors import InputError
from bcppl.inference.filters.tempering import Rejuvenated, Rejuvenation
from bcppl.inference.kernels import Kernel, fitted, halved, halves
from bcppl.inference.kernels.halving import apart_from
from bcppl.inference.kernels.kernel import learns, refuse_no_kernel, scattered
from bcppl.inference.population import Population, log_pair
from bcppl.inference.resampling import Scheme, systematic
from bcppl.inference.targets import Target


def waste_free_moves(
    kernel: Kernel, chains: int, *, scheme: Scheme = systematic, threshold: float = 1.0
) -> Rejuvenation:
    """A rejuvenation for `tempered`: M of N particles are resampled, and N / M - 1 moves made of each.

    A move that learns is fitted to the weighted particles of the other half
    (`bcppl.inference.kernels.halving`), before resampling, and stays the same along a chain. A chain has to
    be much longer than the time in which it forgets its start: with five states of a random walk in six
    correlated axes log Z came out 0.6 nats too low, and variances 6 % too large (N = 1000,
    `benchmarks/exact.py`).

    Args:
        kernel: moves the particles; one that mixes well matters more than here the number of chains.
        chains: M. It divides N.
        scheme: resamples.
        threshold: resample when the effective sample size is below this share of N; 1 is always.

    Raises:
        InputError: what is given is no kernel, no whole number of chains, or no threshold from 0 to 1.
            When it runs: M does not divide N.
    """
    refuse_no_kernel("waste_free_moves", kernel)
    chains = whole_number("waste-free SMC is asked for {} chains", chains)
    threshold = number_within("waste-free SMC is given the threshold {}", threshold, least=0.0, most=1.0)

    def rejuvenation(population: Population, target: Target) -> Rejuvenated:
        count = len(population)
        if count % chains:
            raise InputError(
                f"{count} particles are no whole number of states for {chains} chains; give a number of "
                "chains that divides that of the particles."
            )
        if threshold < 1.0 and population.effective_sample_size >= threshold * count:
            return Rejuvenated(population, None, None)
        ancestors = scheme(population.log_weights, chains)
        if learns(kernel):
            population = halved(population)
            parts = halves(population[ancestors])
            moves = [fitted(kernel, apart_from(population, ancestors[part])) for part in parts]
        else:
            parts, moves = [torch.arange(chains)], [fitted(kernel, population)]
        current, acceptances = population.trace[ancestors], []
        kept = population[ancestors.repeat(count // chains)]
        whole = kept.trace
        for state in range(1, count // chains):
            for mine, move in zip(parts, moves, strict=True):
                moved, accepted = move(current[mine], target)
                current = scattered(current, mine, moved)
                acceptances.append(accepted.to(torch.float64))
            whole = scattered(whole, torch.arange(chains) + state * chains, current)
        kept = replace(
            kept,
            trace=whole,
            log_weights=torch.zeros(count, dtype=torch.float64),
            log_pairs=population.log_pairs + log_pair(chains),
        )
        acceptance = float(torch.cat(acceptances).mean()) if acceptances else None
        return Rejuvenated(kept, ancestors.repeat(count // chains), acceptance)

    return rejuvenation

"""Markov chains, one for each particle, all moved at once: the kernels of SMC by themselves.

    import pyro
    import pyro.distributions as dist
    import torch
    from bcppl.inference import importance_sampling, markov_chains
    from bcppl.inference.kernels import metropolis_hastings
    from bcppl.inference.proposals import drift

    def weighed():
        mass = pyro.sample("mass", dist.Normal(torch.tensor(2.0).double(), 0.5))
        pyro.sample("reading", dist.Normal(mass, 0.3))

    population = importance_sampling(weighed, (), {"reading": torch.tensor(2.4).double()}, 1000)
    chains = markov_chains(metropolis_hastings(drift("mass")), population, moves=20)
    print(chains.draws["mass"].shape)  # 20 moves of 1000 chains

A kernel is fitted once to the starts, and then stays, however long the chains are.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl.arguments import address_list, latent_address, whole_number
from bcppl.inference.kernels import Kernel, fitted, moved_by
from bcppl.inference.kernels.halving import moved_together
from bcppl.inference.kernels.kernel import learns, refuse_no_kernel, scattered
from bcppl.inference.population import Population, refuse_no_population
from bcppl.inference.progress import watched
from bcppl.inference.resampling import Scheme, systematic
from bcppl.inference.targets import POSTERIOR, Target, as_target
from bcppl.traces import Trace
from bcppl.traces.values import shapes


class Chains(NamedTuple):
    """The states of Markov chains.

    Attributes:
        draws: (S, N, *event) by address, the state of each of N chains after each recorded move.
        acceptance: (N,) the share of proposals that each chain accepted.
        trace: the last states.
    """

    draws: Mapping[str, Tensor]
    acceptance: Tensor
    trace: Trace

    def __repr__(self) -> str:
        recorded = min((len(states) for states in self.draws.values()), default=0)
        return (
            f"Chains({len(self.acceptance)} chains, {recorded} recorded states, "
            f"acceptance {float(self.acceptance.mean()):.3f}, draws: {shapes(self.draws)})"
        )


def markov_chains(
    kernel: Kernel,
    start: Population | Trace,
    moves: int,
    target: Target = POSTERIOR,
    *,
    addresses: Collection[str] | str | None = None,
    every: int = 1,
    warm_up: int = 0,
    scheme: Scheme | None = systematic,
    progress: bool = True,
) -> Chains:
    """Run a chain from each particle.

    The kernel is fitted once and then stays; one that learns, for each half of the chains, to the starts of
    the other half, split by ancestry (`bcppl.inference.kernels.halving`). So the target is left invariant
    however long the chains are. From starts that are all at one value (a single chain, or a mode) it learns
    no scale, and takes that of the prior (`bcppl.inference.proposals.spread_of`);
    where the prior is much wider than the target, `warm_up` adapts several chains.

    Args:
        kernel: moves the chains.
        start: the first states, to which the kernel is fitted. A population whose weights are not equal is
            resampled first, to as many particles, so that the chains start from the target.
        moves: how many.
        target: left invariant by the chains.
        addresses: the latent addresses to record, or one; by default all.
        every: record after each so many moves.
        warm_up: moves before the first recorded one, discarded. For each of them the kernel is fitted again
            to the other half of the chains, so that an adaptive kernel is tuned to where they are.
        scheme: resamples; None starts a chain at every particle, whatever its weight.
        progress: show a bar, on a terminal or in a notebook.

    Raises:
        InputError: what is given is no kernel, no whole number of moves, or an address is not latent.
    """
    refuse_no_kernel("markov_chains", kernel)
    moves = whole_number("chains are to make {} moves", moves)
    every = whole_number("chains are to be recorded every {} moves", every, most=moves)
    warm_up = whole_number("chains are to warm up for {} moves", warm_up, least=0)
    if isinstance(start, Trace):
        start = Population(start)
    refuse_no_population("markov_chains", start)
    population, target = start, as_target(target)
    weights = population.log_weights
    if scheme is not None and bool((weights != weights[0]).any()):
        population = population.selected(scheme(weights))
    if warm_up:
        population = moved_by(population, kernel, target, warm_up).population
    trace, count = population.trace, len(population)
    recorded = address_list(trace.choices if addresses is None else addresses)
    for address in recorded:
        latent_address("chains are to record {}", address, trace.choices)
    population, parts = moved_together(population, learning=learns(kernel))
    moves_of = [fitted(kernel, population[other]) for other in parts[::-1]]
    taken = torch.zeros(count, dtype=torch.float64)
    draws: dict[str, list[Tensor]] = {address: [] for address in recorded}
    for number in watched(range(1, moves + 1), description="chains", progress=progress):
        for mine, move in zip(parts, moves_of, strict=True):
            moved, accepted = move(trace[mine], target)
            trace = scattered(trace, mine, moved)
            taken[mine] += accepted.to(torch.float64)
        if number % every == 0:
            for address, states in draws.items():
                states.append(trace[address])
    # Values of a trace are never written to, so they are kept as they are until here.
    stacked = {a: torch.stack(s) if s else trace[a][None][:0] for a, s in draws.items()}
    return Chains(stacked, taken / moves, trace)

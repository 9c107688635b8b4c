"""Replica exchange: chains at several temperatures, between which states are exchanged.

Geyer, Markov chain Monte Carlo maximum likelihood, Computing Science and Statistics 23, 1991; exchanges in
turn between even and odd neighbours: Syed, Bouchard-Cote, Deligiannidis and Doucet, Non-reversible parallel
tempering: a scalable highly parallel MCMC scheme, JRSS B 84, 2022, algorithm 1.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl.arguments import address_list, latent_address, number_within, whole_number
from bcppl.errors import InputError
from bcppl.inference.chains import Chains
from bcppl.inference.kernels.kernel import Kernel, Move, fitted, refuse_no_kernel, scattered
from bcppl.inference.population import Population
from bcppl.inference.progress import watched
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Trace
from bcppl.traces.verbs import refuse_no_trace


class Replicas(NamedTuple):
    """The chains of replica exchange.

    Attributes:
        chains: those at exponent 1, C of them.
        rejection: (K - 1,) the share of proposed exchanges between neighbouring exponents that were rejected.
            Their sum estimates the communication barrier, and equal ones are best (Syed et al.).
        round_trips: how many states have gone from exponent 1 to the first one and back.
        log_evidence: by steps between neighbouring exponents (Xie, Lewis, Fan, Kuo and Chen, Systematic
            Biology 60, 2011), of the likelihood from the first exponent on: of all of it if that is 0.
    """

    chains: Chains
    rejection: Tensor
    round_trips: int
    log_evidence: float


def replica_exchange(
    kernel: Kernel,
    start: Trace,
    moves: int,
    exponents: Sequence[float],
    *,
    warm_up: int = 0,
    addresses: Collection[str] | str | None = None,
    progress: bool = True,
) -> Replicas:
    """Run C chains at each of K exponents of the likelihood, and exchange the states of neighbours.

    After each move, states are exchanged between exponents 1 and 2, 3 and 4, ... or, every other time, 2 and
    3, 4 and 5, ..., all in one batch. The kernel is fitted at each exponent, for each half of its chains to
    the states of the other half; after the warm-up it stays.

    Args:
        kernel: moves the chains.
        start: K x C particles, such as `generate(...)` gives: the first C at the first exponent.
        moves: how many, after the warm-up.
        exponents: of all sites that are not latent, increasing, the last 1; 0 is the prior.
        warm_up: moves that are not recorded; the kernel is fitted again after the 1st, 2nd, 4th, 8th, ...
            and the last.
        addresses: the latent addresses to record, or one; by default all.
        progress: show a bar, on a terminal or in a notebook.

    Raises:
        InputError: what is given is no kernel, a number is out of range, the exponents do not increase to 1,
            there are not as many particles for each exponent, or an address is not latent.
    """
    refuse_no_kernel("replica_exchange", kernel)
    moves = whole_number("replicas are to make {} moves", moves)
    warm_up = whole_number("replicas are to warm up for {} moves", warm_up, least=0)
    refuse_no_trace("replica_exchange", start)
    if isinstance(exponents, float | int):
        raise InputError(f"replicas are given the exponents {exponents}; give several, the last of them 1.")
    ladder = [number_within("a replica is given the exponent {}", e, least=0.0) for e in exponents]
    if ladder[-1:] != [1.0] or sorted(set(ladder)) != ladder or len(ladder) < 2:
        raise InputError(f"replicas are given the exponents {ladder}; give increasing ones that end with 1.")
    count, rest = divmod(start.particles, len(ladder))
    if rest or not count:
        raise InputError(
            f"{start.particles} particles are to be replicas at {len(ladder)} exponents; "
            "give a multiple of the number of exponents."
        )
    recorded = address_list(start.choices if addresses is None else addresses)
    for address in recorded:
        latent_address("replicas are to record {}", address, start.choices)
    run = _Run(start, ladder, count)
    again = {0, warm_up} | {1 << k for k in range(warm_up.bit_length()) if 1 << k < warm_up}
    draws: dict[str, list[Tensor]] = {address: [] for address in recorded}
    for number in watched(range(warm_up + moves), description="replicas", progress=progress):
        if number in again:
            run.fit(kernel)
        if number == warm_up:
            run.forget()
        run.move()
        run.exchange(number % 2)
        if number >= warm_up:
            for address, states in draws.items():
                states.append(run.trace[address][-count:])
    acceptance = run.accepted[-count:] / moves
    cold = run.trace[torch.arange(start.particles - count, start.particles)]
    stacked = {address: torch.stack(states) for address, states in draws.items()}
    rejection = run.rejected / run.proposed.clamp_min(1.0)
    factors = torch.cat(run.log_factors, dim=1)
    log_evidence = float((torch.logsumexp(factors, dim=1) - math.log(factors.shape[1])).sum())
    return Replicas(Chains(stacked, acceptance, cold), rejection, run.trips, log_evidence)


class _Run:
    """The states at all exponents, those of an exponent side by side, and what is counted of them."""

    def __init__(self, start: Trace, ladder: list[float], count: int) -> None:
        self.trace, self.ladder, self.count = start, ladder, count
        self.sites = [a for a in start.addresses if a not in start.choices]
        self.rows = torch.arange(start.particles).reshape(len(ladder), count)
        order = torch.randperm(count)
        self.halves = [h for h in (order[: count // 2], order[count // 2 :]) if len(h)]
        self.moves: list[list[Move]] = []
        self.forget()

    def forget(self) -> None:
        """Count from here."""
        pairs = len(self.ladder) - 1
        self.accepted = torch.zeros(self.trace.particles, dtype=torch.float64)
        self.rejected, self.proposed = (torch.zeros(pairs, dtype=torch.float64) for _ in range(2))
        self.log_factors: list[Tensor] = []  # (K - 1, C) of each exchange
        self.trips = 0
        # Of each state, whether it was at exponent 1, and since then at the first one.
        self.cold, self.hot = (torch.zeros(self.trace.particles, dtype=torch.bool) for _ in range(2))

    def fit(self, kernel: Kernel) -> None:
        """Fit the moves at each exponent, for each half of its chains to the other half."""
        equal = torch.zeros(self.trace.particles, dtype=torch.float64)
        population = Population(self.trace, equal)
        self.moves = [
            [fitted(kernel, population[rows[other]]) for other in self.halves[::-1]] for rows in self.rows
        ]

    def move(self) -> None:
        """Move the states at each exponent."""
        for exponent, rows, moves in zip(self.ladder, self.rows, self.moves, strict=True):
            target = Target(dict.fromkeys(self.sites, exponent)) if exponent < 1.0 else POSTERIOR
            for half, move in zip(self.halves, moves, strict=True):
                moved, accepted = move(self.trace[rows[half]], target)
                self.trace = scattered(self.trace, rows[half], moved)
                self.accepted[rows[half]] += accepted.to(torch.float64)

    def exchange(self, parity: int) -> None:
        """Exchange states of neighbouring exponents, beginning with the first or the second."""
        log_likelihood = POSTERIOR.part(self.trace, self.sites).reshape(self.rows.shape)
        exponents = torch.tensor(self.ladder, dtype=torch.float64)
        step = (exponents[1:] - exponents[:-1])[:, None]
        self.log_factors.append(step * log_likelihood[:-1])
        # From p(a)^s p(b)^t to p(b)^s p(a)^t. Where both are impossible, they stay.
        log_ratio = (step * (log_likelihood[:-1] - log_likelihood[1:])).nan_to_num(nan=-torch.inf)
        chance = log_ratio.clamp_max(0.0).exp()
        lower = torch.arange(parity, len(self.ladder) - 1, 2)
        self.proposed[lower] += self.count
        self.rejected[lower] += (1.0 - chance[lower]).sum(dim=1)
        accepted = torch.rand(len(lower), self.count, dtype=torch.float64) < chance[lower]
        order = self.rows.clone()
        order[lower] = torch.where(accepted, self.rows[lower + 1], self.rows[lower])
        order[lower + 1] = torch.where(accepted, self.rows[lower], self.rows[lower + 1])
        self.trace = self.trace[order.flatten()]
        self.cold, self.hot = self.cold[order.flatten()], self.hot[order.flatten()]
        first, last = self.rows[0], self.rows[-1]
        self.hot[first] = self.cold[first]
        self.trips += int(self.hot[last].sum())
        self.hot[last], self.cold[last] = False, True

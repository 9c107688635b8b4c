"""Hamiltonian Monte Carlo whose mass, step size and number of steps are learned from other particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bcppl.arguments import number_within, whole_number
from bcppl.beliefs import normalised
from bcppl.inference.kernels import Kernel, Move
from bcppl.inference.kernels.hamiltonian import (
    Unconstrained,
    hamiltonian_move,
    named_addresses,
)
from bcppl.inference.learning.mass import fisher_covariance
from bcppl.inference.population import Population
from bcppl.inference.proposals.spread import weighted_places
from bcppl.inference.resampling import systematic
from bcppl.inference.targets import Target
from bcppl.traces import Trace

# Pilots adapt the step size by trajectories of this length, in standard deviations: an independent draw of a
# normal takes a quarter of a period, pi / 2.
LENGTH, LONGEST = 1.5, 3.0
ROUNDS = 8


class Tuned(NamedTuple):
    """The settings of `hmc` that pilot trajectories favour.

    Attributes:
        step_size: in standard deviations.
        steps: of the leapfrog.
        acceptance: the mean acceptance probability of the pilots with these settings.
        jump: the expected squared jump, 1 for an independent draw of a normal target: the smaller of that of
            the coordinates and that of their squared deviations from the mean.
    """

    step_size: float
    steps: int
    acceptance: float
    jump: float


def adaptive_hmc(
    *addresses: str | Sequence[str],
    acceptance: float = 0.75,
    most_steps: int = 32,
    pilots: int = 64,
    jitter: float = 0.2,
) -> Kernel:
    """Hamiltonian Monte Carlo that is tuned to the particles that it learns from, not those that it moves.

    The inverse mass matrix is learned from them and from the gradients of their log-density
    (`bcppl.inference.learning.mass`). Some of them then make pilot trajectories in the target at hand, by
    which the step size and the number of steps are chosen (`tuned`), as by the pretuning of Buchholz, Chopin
    and Jacob (Adaptive tuning of Hamiltonian Monte Carlo within sequential Monte Carlo, Bayesian Analysis 16,
    2021, section 3). The pilots are discarded. What is chosen stays the same for all moves that one fitted
    move makes in one target, so the target is left invariant.

    Args:
        addresses: latent addresses, one by one or as a list, moved together; the other latent values stay.
        acceptance: the mean acceptance probability at which the step size is aimed.
        most_steps: the largest number of leapfrog steps.
        pilots: how many particles make pilot trajectories.
        jitter: each trajectory's step size is uniform within this share of the one chosen.

    Raises:
        InputError: no address is named, or a number is out of range; see also `bcppl.inference.kernels.hmc`.
    """
    named = named_addresses("adaptive_hmc", addresses)
    what = "adaptive_hmc is aimed at the acceptance {}"
    acceptance = number_within(what, acceptance, above=0.0, below=1.0)
    most_steps = whole_number("adaptive_hmc may make {} steps at most", most_steps)
    pilots = whole_number("adaptive_hmc was given {} pilots", pilots)
    jitter = number_within("adaptive_hmc was given jitter {}", jitter, least=0.0, below=1.0)

    def kernel(population: Population) -> Move:
        moves: dict[tuple[tuple[str, float], ...], Move] = {}

        def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
            key = tuple(sorted(target.exponents.items()))
            if key not in moves:
                factor = learned_factor(named, population, target)
                chosen = population.trace[systematic(population.log_weights, pilots)]
                size, steps, *_ = tuned(
                    chosen, named, target, factor, acceptance=acceptance, most_steps=most_steps
                )
                moves[key] = hamiltonian_move(named, factor, size, [steps], jitter)
            return moves[key](trace, target)

        return move

    return kernel


def learned_factor(addresses: tuple[str, ...], population: Population, target: Target) -> Tensor:
    """The Cholesky factor (D, D) of the inverse mass matrix that the particles and their scores give."""
    space = Unconstrained(addresses, population.trace)
    position = space.read(population.trace)
    _, score = space.density(population.trace, position, target.exponents)
    prior = torch.cat([weighted_places(population, address).unlearned for address in addresses])
    weights = normalised(population.log_weights)
    return torch.linalg.cholesky(fisher_covariance(position, score, weights, prior))


def tuned(
    pilots: Trace,
    addresses: tuple[str, ...],
    target: Target,
    factor: Tensor,
    *,
    acceptance: float,
    most_steps: int,
) -> Tuned:
    """The step size at which pilots accept as often as wanted, and the best number of such steps.

    The step size is adapted by stochastic approximation while the pilots move, so that they are no longer the
    particles from which the mass matrix was learned, to which it fits too well. The number of steps is that
    with the largest expected squared jump for each gradient: of the coordinates in which the mass is 1, and
    of their squared deviations from the mean, each divided by what an independent draw of a normal would
    give; the smaller of the two counts. By the first alone, trajectories to the opposite side of the target
    would be best, which hardly change their distance from the mean; the second is the criterion of Hoffman,
    Radul and Sountsov (An adaptive MCMC scheme for setting trajectory lengths in Hamiltonian Monte Carlo,
    AISTATS 2021, eq. 7), for each coordinate by itself.

    Args:
        pilots: particles of about the target.
        addresses: that are moved.
        target: in which they move.
        factor: (D, D) as for `hamiltonian_move`.
        acceptance: the mean acceptance probability that is wanted.
        most_steps: of a trajectory.
    """
    flight = _Flight(pilots, addresses, target, factor)
    size = len(factor) ** -0.25
    for number in range(ROUNDS):
        steps = min(max(round(LENGTH / size), 1), most_steps)
        chance = flight.flown(size, steps)[-1][0]
        # The acceptance probability falls by about 1 where the logarithm of the step size grows by 1.
        size *= math.exp((2.0 if number < ROUNDS // 2 else 0.7) * (float(chance.mean()) - acceptance))
    longest = min(max(math.ceil(LONGEST / size), 1), most_steps)
    ends = flight.flown(size, longest)
    jumps = torch.stack([torch.stack([f.mean() for f in far]).min() for _, *far in ends])
    best = int((jumps / torch.arange(2, longest + 2)).argmax())  # k steps take k + 1 gradients
    return Tuned(size, best + 1, float(ends[best][0].mean()), float(jumps[best]))


class _Flight:
    """Pilot trajectories, each from where the last ended."""

    def __init__(self, pilots: Trace, addresses: tuple[str, ...], target: Target, factor: Tensor) -> None:
        self.pilots, self.factor = pilots, factor
        self.space = Unconstrained(addresses, pilots)
        self.exponents = target.exponents
        self.place = self.space.read(pilots)
        self.density, self.gradient = self._density(self.place)

    def _density(self, place: Tensor) -> tuple[Tensor, Tensor]:
        density, gradient = self.space.density(self.pilots, place, self.exponents)
        return density, gradient @ self.factor

    def flown(self, size: float, steps: int) -> list[tuple[Tensor, Tensor, Tensor]]:
        """After each step: the probability to accept that end, and the two jumps weighed by it, (N,) each."""
        deviation = self.place - self.place.mean(dim=0)
        origin = torch.linalg.solve_triangular(self.factor, deviation.T, upper=False).T
        momentum, jump, ends = torch.randn_like(origin), torch.zeros_like(origin), []
        density, gradient = self.density, self.gradient
        energy = 0.5 * momentum.square().sum(dim=1) - density
        for _ in range(steps):
            momentum = momentum + 0.5 * size * gradient
            jump = jump + size * momentum
            place = self.place + jump @ self.factor.T
            density, gradient = self._density(place)
            momentum = momentum + 0.5 * size * gradient
            lost = 0.5 * momentum.square().sum(dim=1) - density - energy
            # A trajectory that has diverged is rejected.
            chance = torch.nan_to_num(torch.exp(-lost).clamp(max=1.0), 0.0, 0.0, 0.0)
            chance = torch.where(torch.isfinite(gradient).all(dim=1), chance, 0.0)
            far = jump.square().mean(dim=1) / 2.0, ((2.0 * origin + jump) * jump).square().mean(dim=1) / 4.0
            first, second = (torch.where(chance > 0.0, chance * each, 0.0) for each in far)
            ends.append((chance, first, second))
        taken = torch.rand(len(chance), dtype=torch.float64) < chance
        self.place = torch.where(taken[:, None], place, self.place)
        self.gradient = torch.where(taken[:, None], gradient, self.gradient)
        self.density = torch.where(taken, density, self.density)
        return ends

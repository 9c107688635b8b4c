"""Waste-free SMC: all states of the chains count, and no particle teaches itself."""

from __future__ import annotations

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.filters.step import Observed
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.filters.waste_free import waste_free_moves
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import Kernel, Move, metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import multinomial
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Trace, simulate

NOISE = 0.3
SEEN = torch.tensor(0.8, dtype=torch.float64)
EXACT = float(dist.Normal(0.0, math.sqrt(1 + NOISE**2)).log_prob(SEEN))


def program(count: int) -> None:
    x = pyro.sample("x", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
    if count:
        pyro.sample("y", dist.Normal(x, NOISE))


def fixed_drift(trace: Trace) -> None:
    """A proposal that learns nothing and is not symmetric."""
    pyro.sample("x", dist.Normal(0.9 * trace["x"] + 0.1, 0.5))


def drift_without_way_back(_: Population) -> Move:
    """Mutant: the proposal's ratio is forgotten."""

    def move(trace: Trace, target: Target) -> tuple[Trace, Tensor]:
        new = trace.at({"x": 0.7 * trace["x"] + 0.6 + 0.5 * torch.randn(len(trace)).double()})
        chance = torch.log(torch.rand(len(trace), dtype=torch.float64))
        mask = target(new) - target(trace) > chance
        return new.where(mask, trace), mask.double()

    return move


def runs(kernel: Kernel, chains: int, count: int = 40, particles: int = 60) -> tuple[list[float], float]:
    """Zhat / Z by three fixed exponents, and the mean of Zhat E[x] / Z over the runs, in standard errors."""
    found, means = [], []
    for seed in range(count):
        torch.manual_seed(seed)
        step = tempered(
            rejuvenation=waste_free_moves(kernel, chains, scheme=multinomial), exponents=(0.1, 0.4, 1.0)
        )
        start = importance_sampling(program, (0,), {}, particles)
        population, info = step(start, Observed((1,), {"y": SEEN}))
        assert info.resampled == 3 and info.ancestors is not None and len(info.ancestors) == particles
        assert len(population) == particles
        found.append(math.exp(population.log_evidence - EXACT))
        means.append(float(population.trace["x"].mean()) * found[-1])
    exact = float(SEEN) / (1 + NOISE**2)
    return found, float(abs(np.mean(means) - exact) / (np.std(means, ddof=1) / math.sqrt(count)))


def biased(found: list[float]) -> float:
    return float(abs(np.mean(found) - 1) / (np.std(found, ddof=1) / math.sqrt(len(found))))


@pytest.mark.long
@pytest.mark.parametrize("chains", [10, 30])
def test_evidence_is_unbiased_and_the_mean_is_right(chains: int) -> None:
    found, error = runs(metropolis_hastings(fixed_drift), chains)
    assert biased(found) < 4
    assert error < 4


@pytest.mark.long
def test_mutant_without_the_way_back() -> None:
    _, error = runs(drift_without_way_back, 10)
    assert error > 8


@pytest.mark.parametrize("chains", [2, 5, 20])
def test_halves_learn_from_each_other(chains: int) -> None:
    """Twice: in the second round particles of one old chain are on one side."""
    taught: list[set[int]] = []
    moved: list[set[int]] = []

    def spying(population: Population) -> Move:
        number = len(taught)
        taught.append(set(population.founders.tolist()))
        moved.append(set())

        def move(trace: Trace, _: Target) -> tuple[Trace, Tensor]:
            moved[number] |= set(trace["x"].tolist())
            return trace, torch.ones(len(trace), dtype=torch.float64)

        return move

    torch.manual_seed(1)
    population = importance_sampling(program, (0,), {}, 20)
    x = population.trace["x"]
    for _ in range(2):
        taught.clear(), moved.clear()
        population = waste_free_moves(spying, chains)(population, POSTERIOR).population
        assert torch.equal(population.trace["x"], x[population.founders])
        for teachers, pupils in zip(taught, moved, strict=True):
            assert not {float(x[f]) for f in teachers} & pupils
        assert len({int(f) for f in population.founders}) <= chains


def test_every_state_is_kept_in_its_place() -> None:
    def counting(_: Population) -> Move:
        def move(trace: Trace, __: Target) -> tuple[Trace, Tensor]:
            return trace.at({"x": trace["x"] + 1.0}), torch.ones(len(trace), dtype=torch.float64)

        return move

    torch.manual_seed(0)
    start = importance_sampling(program, (0,), {}, 12)
    done, ancestors, acceptance, _ = waste_free_moves(counting, 3)(start, POSTERIOR)
    assert acceptance == 1.0 and ancestors is not None
    steps = torch.arange(4).repeat_interleave(3)
    assert torch.equal(done.trace["x"], start.trace["x"][ancestors] + steps)
    torch.testing.assert_close(done.trace.log_prob(), dist.Normal(0.0, 1.0).log_prob(done.trace["x"]))
    kept = waste_free_moves(counting, 3, threshold=0.5)(start, POSTERIOR)
    assert kept.population is start and kept.ancestors is None


def test_what_cannot_be() -> None:
    with pytest.raises(InputError, match="asked for 0 chains"):
        waste_free_moves(metropolis_hastings(drift("x")), 0)
    population = Population(simulate(program, (0,), 10), torch.zeros(10, dtype=torch.float64))
    with pytest.raises(InputError, match="10 particles are no whole number of states for 4 chains"):
        waste_free_moves(metropolis_hastings(drift("x")), 4)(population, POSTERIOR)
    with pytest.raises(InputError, match="a rejuvenation beside a kernel"):
        tempered(
            metropolis_hastings(drift("x")), rejuvenation=waste_free_moves(metropolis_hastings(drift("x")), 4)
        )

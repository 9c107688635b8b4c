"""Importance sampling, factors at the start, and chains: the pieces of SMC by themselves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.chains import markov_chains
from bcppl.inference.filters.step import Observed
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.importance import (
    generate_stratified,
    importance_sampling,
    tempered_importance_sampling,
)
from bcppl.inference.kernels import Move, metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import never
from bcppl.inference.targets import Target
from bcppl.traces import Trace, generate, simulate

SEEN = torch.tensor(1.7, dtype=torch.float64)
NOISE = 0.3


def program(count: int) -> None:
    x = pyro.sample("x", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
    pyro.sample("aside", dist.Bernoulli(torch.tensor(0.5, dtype=torch.float64)))
    if count:
        pyro.sample("y", dist.Normal(x, NOISE))


EXACT = float(dist.Normal(0.0, math.sqrt(1 + NOISE**2)).log_prob(SEEN))


def near_what_is_seen(_: int) -> None:
    pyro.sample("x", dist.Normal(SEEN - 0.1, 0.45))


def test_a_proposal_brings_the_variance_down_and_the_estimate_stays_unbiased() -> None:
    found: dict[bool, list[float]] = {False: [], True: []}
    for seed in range(150):
        for proposed, estimates in found.items():
            torch.manual_seed(seed)
            population = importance_sampling(
                program, (1,), {"y": SEEN}, 30, near_what_is_seen if proposed else None
            )
            estimates.append(math.exp(population.log_evidence - EXACT))
    for estimates in found.values():
        assert abs(np.mean(estimates) - 1) < 4 * np.std(estimates, ddof=1) / math.sqrt(150)
    assert np.std(found[True]) < 0.4 * np.std(found[False])
    mean = torch.softmax(population.log_weights, 0) @ population.trace["x"]
    assert float(mean) == pytest.approx(float(SEEN) / (1 + NOISE**2), abs=0.2)


def test_bad_proposals_are_named() -> None:
    def elsewhere(_: int) -> None:
        pyro.sample("z", dist.Normal(SEEN, 1.0))

    def observed(_: int) -> None:
        pyro.sample("y", dist.Normal(SEEN, 1.0))

    with pytest.raises(InputError, match="'z'"):
        importance_sampling(program, (1,), {"y": SEEN}, 5, elsewhere)
    with pytest.raises(InputError, match="'y' is observed and given a value for each particle"):
        importance_sampling(program, (1,), {"y": SEEN}, 5, observed)
    with pytest.raises(InputError, match="samples no address"):
        importance_sampling(program, (1,), {"y": SEEN}, 5, lambda _: None)


def test_factors_at_the_start_count_in_the_evidence() -> None:
    """What the first run fixes, by `pyro.factor` or `obs=`, is in the evidence, whatever comes after."""

    def fixing(count: int) -> None:
        x = pyro.sample("x", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
        pyro.sample("first", dist.Normal(x, 0.5), obs=torch.tensor(0.7, dtype=torch.float64))
        pyro.factor("bonus", torch.full((), 3.0, dtype=torch.float64).expand(x.shape))
        if count:
            pyro.sample("y", dist.Normal(x, 0.5))

    y = torch.tensor([0.7, 0.2], dtype=torch.float64)
    covariance = torch.ones(2, 2).double() + 0.25 * torch.eye(2).double()
    exact = 3.0 + float(dist.MultivariateNormal(torch.zeros(2).double(), covariance).log_prob(y))
    found = []
    for seed in range(100):
        torch.manual_seed(seed)
        start = importance_sampling(fixing, (0,), {}, 50)
        done, _ = tempered(share=0.0)(start, Observed((1,), {"y": y[1]}))
        found.append(math.exp(done.log_evidence - exact))
    assert abs(np.mean(found) - 1) < 4 * np.std(found, ddof=1) / 10
    # By the mean weight to the bit: a start without factors has an evidence of 1.
    trace = simulate(program, (0,), 75)
    assert Population(trace).log_evidence == 0.0
    nothing = Population(trace, torch.full((75,), -torch.inf, dtype=torch.float64))
    assert nothing.log_evidence == -math.inf


def plate(y_size: int) -> None:
    mu = pyro.sample("mu", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 5.0))
    with pyro.plate("readings", y_size):
        pyro.sample("y", dist.Normal(mu.expand(y_size, -1), NOISE))
    pyro.sample("fixed", dist.Normal(mu, NOISE), obs=SEEN)


def walk(trace: Trace) -> None:
    pyro.sample("mu", dist.Normal(trace["mu"], 0.3))


def test_tempering_from_prior_to_posterior_finds_the_exact_evidence() -> None:
    """With fixed exponents and moves it is unbiased; with data counted twice it would be far off."""
    y = SEEN + torch.tensor([0.2, -0.3, 0.1, 0.4], dtype=torch.float64)
    every = torch.cat([y, SEEN[None]])
    covariance = 25.0 * torch.ones(5, 5).double() + NOISE**2 * torch.eye(5).double()
    exact = float(dist.MultivariateNormal(torch.zeros(5).double(), covariance).log_prob(every))
    step = tempered(metropolis_hastings(walk), sweeps=2, exponents=(0.002, 0.02, 0.2, 1.0))
    tempering, plain, means = [], [], []
    for seed in range(60):
        torch.manual_seed(seed)
        population, info = tempered_importance_sampling(plate, (4,), {"y": y}, 60, step)
        assert info.exponents == (0.002, 0.02, 0.2, 1.0) and info.log_evidence == population.log_evidence
        tempering.append(math.exp(population.log_evidence - exact))
        means.append(float(torch.softmax(population.log_weights, 0) @ population["mu"]))
        plain.append(math.exp(importance_sampling(plate, (4,), {"y": y}, 60).log_evidence - exact))
    assert abs(np.mean(tempering) - 1) < 4 * np.std(tempering, ddof=1) / math.sqrt(60)
    assert np.std(tempering) < 0.8 * np.std(plain)
    mean = float(every.sum()) / (5 + NOISE**2 / 25.0)
    assert abs(np.mean(means) - mean) < 4 * np.std(means, ddof=1) / math.sqrt(60)
    trace, log_likelihood = generate(plate, (4,), {"y": y}, 600)
    twice, _ = step.temper(Population(trace, log_likelihood), ["y", "fixed"])
    assert abs(twice.log_evidence - exact) > 0.7, "the mutant: 1.3 nats off"


def test_fixed_exponents_and_nothing_observed_leave_the_weights() -> None:
    torch.manual_seed(0)
    step = tempered(exponents=(0.5, 1.0), resample=never)
    population, _ = step(importance_sampling(program, (0,), {}, 10), Observed((0,), {}))
    assert population.log_evidence == 0.0 and not bool(population.log_weights.any())


def test_chains_start_by_weight() -> None:
    """Of a population with weight on one side, half of the chains would start on the other."""

    def stay(_: Population) -> Move:
        return lambda trace, target: (trace, torch.ones(len(trace), dtype=torch.float64))

    trace = simulate(program, (0,), 40)
    weights = torch.where(trace["x"] > 0, 0.0, -torch.inf).double()
    population = Population(trace, weights)
    assert float(markov_chains(stay, population, 1).draws["x"].min()) > 0
    assert torch.equal(markov_chains(stay, population, 1, scheme=None).draws["x"][0], trace["x"])
    even = Population(trace, torch.full((40,), -3.0, dtype=torch.float64))
    before = torch.get_rng_state()
    assert torch.equal(markov_chains(stay, even, 1, addresses="x").draws["x"][0], trace["x"])
    torch.set_rng_state(before)
    markov_chains(stay, trace, 1)
    torch.testing.assert_close(markov_chains(stay, population, 1).acceptance, torch.ones(40).double())


def test_chains_reach_the_posterior_and_keep_it() -> None:
    torch.manual_seed(0)
    start = importance_sampling(program, (1,), {"y": SEEN}, 200)
    chains = markov_chains(metropolis_hastings(drift("x", (0.5, 1.5))), start, 60, addresses=["x"], every=2)
    assert list(chains.draws) == ["x"] and chains.draws["x"].shape == (30, 200)
    assert chains.acceptance.shape == (200,) and 0.1 < float(chains.acceptance.mean()) < 0.9
    assert torch.equal(chains.draws["x"][-1], chains.trace["x"])
    late = chains.draws["x"][10:]
    mean, variance = float(SEEN) / (1 + NOISE**2), NOISE**2 / (1 + NOISE**2)
    each = late.mean(0)
    assert abs(float(each.mean()) - mean) < 4 * float(each.std()) / math.sqrt(200)
    spread = (late - mean).square().mean(0)
    assert abs(float(spread.mean()) - variance) < 4 * float(spread.std()) / math.sqrt(200)


def test_chains_are_fitted_once_to_the_others() -> None:
    fitted: list[set[float]] = []

    def spying(population: Population) -> Move:
        mine = set(population.trace["x"].tolist())
        fitted.append(mine)

        def move(trace: Trace, _: Target) -> tuple[Trace, Tensor]:
            assert not mine & set(trace["x"].tolist())
            return trace, torch.ones(len(trace), dtype=torch.float64)

        return move

    trace = simulate(program, (0,), 20)
    chains = markov_chains(spying, trace, 5)
    assert len(fitted) == 2 and torch.equal(chains.trace["x"], trace["x"])
    assert torch.equal(chains.acceptance, torch.ones(20, dtype=torch.float64))
    assert set(chains.draws) == {"x", "aside"}
    with pytest.raises(InputError, match="'y', which is no latent address"):
        markov_chains(spying, importance_sampling(program, (1,), {"y": SEEN}, 5), 1, addresses=["y"])
    with pytest.raises(InputError, match="make 0 moves"):
        markov_chains(spying, trace, 0)


@pytest.mark.parametrize("event", [False, True])
def test_draws_of_an_lkj_prior_have_its_density(event: bool) -> None:
    """Torch's have not from the third row on. Exact values by quadrature over a correlation's density."""

    def correlated() -> None:
        shape = torch.full((2,) if event else (), 1.5, dtype=torch.float64)
        factor = pyro.sample("factor", dist.LKJCholesky(3, shape).to_event(len(shape.shape)))
        factor = factor[..., 0, :, :] if event else factor
        pyro.sample("y", dist.Normal((factor @ factor.transpose(-1, -2))[..., 2, 1], 0.3))

    torch.manual_seed(0)
    population = importance_sampling(correlated, (), {"y": torch.tensor(0.9).double()}, 40_000)
    # The density of each correlation of three at concentration 1.5 is proportional to 1 - r^2.
    r = torch.linspace(-1.0, 1.0, 20_001, dtype=torch.float64)
    prior = 0.75 * (1.0 - r.square())
    exact = torch.trapezoid(prior * dist.Normal(r, 0.3).log_prob(torch.tensor(0.9)).exp(), r)
    assert math.exp(population.log_evidence) == pytest.approx(float(exact), rel=0.03)


def test_a_number_of_strata_is_refused_for_a_discrete_choice() -> None:
    def program() -> None:
        kind = pyro.sample("kind", dist.Categorical(torch.tensor([0.2, 0.3, 0.5])))
        pyro.sample("y", dist.Normal(kind.double(), 1.0))

    with pytest.raises(InputError, match="leave strata out"):
        generate_stratified(program, (), {"y": torch.tensor(0.3).double()}, 6, 2)


@pytest.mark.parametrize("strata", [lambda v: v > 0, lambda v: v[:, :1], lambda v: None, lambda v: v[:3, 0]])
def test_strata_of_another_shape_are_refused(strata: Any) -> None:
    def program() -> None:
        pyro.sample("x", dist.Normal(torch.zeros(2).double(), 1.0).to_event(1))

    with pytest.raises(InputError, match="give a tensor with the number of each one's stratum"):
        generate_stratified(program, (), {}, 4, strata)

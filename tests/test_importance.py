"""Importance sampling, factors at the start, and chains: the pieces of SMC by themselves."""

from __future__ import annotations

import math

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference.chains import markov_chains
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import Move, metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.step import Observed
from bcppl.inference.targets import Target
from bcppl.inference.tempering import tempered
from bcppl.traces import Trace, simulate

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
    with pytest.raises(InputError, match="chooses nothing"):
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
    assert Population(trace, torch.zeros(75, dtype=torch.float64)).log_evidence == 0.0
    nothing = Population(trace, torch.full((75,), -torch.inf, dtype=torch.float64))
    assert nothing.log_evidence == -math.inf


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

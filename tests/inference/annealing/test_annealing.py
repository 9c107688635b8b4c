"""Particles and chains between the prior and the posterior, against exact evidence and probabilities."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import tempered, tempered_importance_sampling
from bcppl.inference.annealing import persistent_sampling, replica_exchange, replicas
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import never
from bcppl.inference.summaries import mean, weighted_covariance
from bcppl.traces import Trace, generate
from tests.invariance import matrix, number

# Prior N(0, 9), likelihood of two narrow modes at -3 and 2: all is Gaussian.
CENTRES, SHARES, WIDTH, PRIOR = matrix([-3.0, 2.0]), matrix([0.3, 0.7]), 0.15, 3.0


class TwoModes(dist.Normal):  # type: ignore[misc]
    """The likelihood of x: a mixture density of 0 about -x - 3 and -x + 2."""

    def log_prob(self, value: Tensor) -> Tensor:
        each = dist.Normal(CENTRES, WIDTH).log_prob(self.loc[:, None]) + SHARES.log()
        return torch.logsumexp(each, dim=1)

    def expand(self, batch_shape: Any, _instance: Any = None) -> Any:
        return self


def two_modes() -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), PRIOR))
    pyro.sample("y", TwoModes(x, number(1.0)))


MARGINAL = SHARES * dist.Normal(CENTRES, math.hypot(PRIOR, WIDTH)).log_prob(number(0.0)).exp()
RIGHT = float(MARGINAL[1] / MARGINAL.sum())
LOG_EVIDENCE = float(MARGINAL.sum().log())
SEEN = {"y": number(0.0)}


def nudge(trace: Trace) -> None:
    pyro.sample("x", dist.Normal(trace["x"], 0.5))


def z_of(values: list[float], exact: float) -> float:
    estimates = torch.tensor(values, dtype=torch.float64)
    return float((estimates.mean() - exact) / (estimates.std() / math.sqrt(len(estimates))))


def test_persistent_sampling_has_the_evidence_and_the_moments() -> None:
    wide, share = [], []
    kernel = metropolis_hastings(drift("x"))
    for seed in range(12):
        torch.manual_seed(seed)
        population, info = persistent_sampling(two_modes, (), SEEN, 100, kernel)
        assert len(population) == 100 * (len(info.exponents) + 4) and info.exponents[-1] == 1.0
        assert population.effective_sample_size > 200
        wide.append(population.log_evidence)
        share.append(float(torch.softmax(population.log_weights, 0)[population["x"] > 0].sum()))
    assert abs(z_of(wide, LOG_EVIDENCE)) < 4.0 and torch.tensor(wide).std() < 0.3
    assert abs(z_of(share, RIGHT)) < 4.0 and torch.tensor(share).std() < 0.1


def correlated() -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(4, dtype=torch.float64), 1.0).to_event(1))
    pyro.sample("y", dist.Normal(x.cumsum(-1), 0.2).to_event(1))


@pytest.mark.long
def test_persistent_particles_are_weighted_for_a_gaussian_posterior() -> None:
    y = matrix([0.5, -0.3, 1.0, 0.7])
    sums = torch.tril(torch.ones(4, 4, dtype=torch.float64))
    exact = torch.linalg.inv(torch.eye(4, dtype=torch.float64) + sums.T @ sums / 0.04)
    centre = exact @ sums.T @ y / 0.04
    spread = sums @ sums.T + 0.04 * torch.eye(4, dtype=torch.float64)
    log_evidence = float(dist.MultivariateNormal(torch.zeros(4).double(), spread).log_prob(y))
    off, logs, variances = [], [], []
    for seed in range(6):
        torch.manual_seed(seed)
        kernel = metropolis_hastings(drift("x"))
        population, _ = persistent_sampling(correlated, (), {"y": y}, 300, kernel, sweeps=4, share=1.5)
        off.append(mean(population, "x") - centre)
        logs.append(population.log_evidence)
        weights = torch.softmax(population.log_weights, 0)
        variances.append(weighted_covariance(population["x"], weights).diagonal() / exact.diagonal())
    assert abs(float(torch.tensor(logs).mean()) - log_evidence) < 0.4
    means, spreads = torch.stack(off).mean(dim=0), torch.stack(variances).mean(dim=0)
    assert float((means / exact.diagonal().sqrt()).abs().max()) < 0.15
    assert float((spreads - 1.0).abs().max()) < 0.2


def test_annealed_importance_sampling_is_unbiased() -> None:
    """Neal's is tempering with fixed exponents that never resamples: the mean weight is the evidence."""
    ladder = [0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.4, 0.7, 1.0]
    step = tempered(metropolis_hastings(nudge), exponents=ladder, resample=never, always_move=True, sweeps=1)
    torch.manual_seed(0)
    population, _ = tempered_importance_sampling(two_modes, (), SEEN, 20_000, step)
    ratio = (population.log_weights - LOG_EVIDENCE).exp()
    assert abs(float((ratio.mean() - 1.0) / (ratio.std() / math.sqrt(len(ratio))))) < 4.0
    share = (ratio * (population["x"] > 0).to(ratio)).mean() / ratio.mean()
    assert abs(float(share) - RIGHT) < 0.05
    assert population.log_evidence == pytest.approx(LOG_EVIDENCE + float(ratio.mean().log()))


LADDER = [0.0, 0.004, 0.03, 0.2, 1.0]


def exchanged(seed: int, moves: int = 50, chains: int = 40) -> replicas.Replicas:
    torch.manual_seed(seed)
    start, _ = generate(two_modes, (), SEEN, chains * len(LADDER))
    kernel = metropolis_hastings(drift("x"))
    return replica_exchange(kernel, start, moves, LADDER, warm_up=20, progress=False)


@pytest.mark.long
def test_replicas_have_both_modes_by_their_probability() -> None:
    run = exchanged(0)
    x = run.chains.draws["x"]
    assert x.shape == (50, 40)
    share = (x > 0).double().mean(dim=0)  # of each chain, which are nearly independent
    assert abs(float((share.mean() - RIGHT) / (share.std() / math.sqrt(40)))) < 4.0
    assert float(x[x > 0].std()) == pytest.approx(WIDTH / math.sqrt(1 + WIDTH**2 / 9), rel=0.05)
    assert run.log_evidence == pytest.approx(LOG_EVIDENCE, abs=0.3)
    assert run.round_trips > 50
    assert bool((run.rejection > 0.02).all()) and bool((run.rejection < 0.8).all())


@pytest.mark.parametrize("sign", [1, -1], ids=["as it is", "with the wrong sign"])
def test_exchanges_keep_exact_draws_at_each_exponent(sign: int) -> None:
    torch.manual_seed(0)
    chains, prior = 20_000, number(0.0)

    def conjugate() -> None:
        x = pyro.sample("x", dist.Normal(prior, 1.0))
        pyro.sample("y", dist.Normal(x, 0.5))

    ladder = [0.0, 0.2, 1.0]
    exponents = matrix(ladder).repeat_interleave(chains)
    precision = 1.0 + exponents / 0.25
    centre = exponents * 1.2 / 0.25 / precision
    x = centre + torch.randn(3 * chains, dtype=torch.float64) / precision.sqrt()
    start, _ = generate(conjugate, (), {"y": number(1.2)}, 3 * chains, {"x": x})
    # The steps between the exponents of a ladder upside down are negative.
    run = replicas._Run(start, ladder[::sign], chains)
    for parity in (0, 1):
        run.exchange(parity)
    z = (run.trace["x"] - centre) * precision.sqrt()
    means = torch.stack([z[rows].mean() for rows in run.rows]) * math.sqrt(chains)
    spreads = torch.stack([z[rows].square().mean() - 1.0 for rows in run.rows]) * math.sqrt(chains / 2)
    largest = float(torch.cat([means, spreads]).abs().max())
    assert largest < 4.5 if sign == 1 else largest > 20.0
    assert float((run.trace["x"] != x).double().mean()) > 0.3


def test_refusals_say_what_to_do() -> None:
    kernel = metropolis_hastings(nudge)
    start, _ = generate(two_modes, (), SEEN, 10)
    with pytest.raises(InputError, match="increasing ones that end with 1"):
        replica_exchange(kernel, start, 1, [0.5, 0.2, 1.0])
    with pytest.raises(InputError, match="multiple of the number of exponents"):
        replica_exchange(kernel, start, 1, [0.0, 0.5, 1.0])
    with pytest.raises(InputError, match="'z'"):
        replica_exchange(kernel, start, 1, [0.0, 1.0], addresses=["z"])
    with pytest.raises(InputError, match="wrap a proposal"):
        persistent_sampling(two_modes, (), SEEN, 10, drift("x"))
    with pytest.raises(InputError, match="0 particles"):
        persistent_sampling(two_modes, (), SEEN, 0, kernel)


def test_without_observations_the_prior_is_left() -> None:
    def prior() -> None:
        pyro.sample("x", dist.Normal(number(0.0), 1.0))

    torch.manual_seed(0)
    kernel = metropolis_hastings(drift("x", (0.5, 2.0)))
    population, _ = persistent_sampling(prior, (), {}, 4000, kernel, sweeps=1)
    assert float(population["x"].var()) == pytest.approx(1.0, abs=0.1)
    start, _ = generate(prior, (), {}, 3 * 200)
    run = replica_exchange(kernel, start, 40, [0.0, 0.5, 1.0], progress=False)
    assert float(run.chains.draws["x"].var()) == pytest.approx(1.0, abs=0.15)
    assert run.log_evidence == 0.0


@pytest.mark.parametrize("moves, trips", [(4, 0), (6, 1), (11, 3), (12, 4)])
def test_a_round_trip_is_from_exponent_1_to_the_first_and_back(moves: int, trips: int) -> None:
    """Without a likelihood every exchange is accepted, and each of three states goes round in six moves."""

    def prior() -> None:
        pyro.sample("x", dist.Normal(number(0.0), 1.0))

    start, _ = generate(prior, (), {}, 3 * 10)
    kernel, exponents = metropolis_hastings(drift("x")), [0.0, 0.5, 1.0]
    for warm_up in (0, 6):
        run = replica_exchange(kernel, start, moves, exponents, warm_up=warm_up, progress=False)
        assert run.round_trips == 10 * trips, "where states were before the warm-up's end does not count"

"""Bridging from a proposal to the posterior: exact evidence and moments, few exponents."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import tempered, tempered_importance_sampling
from bcppl.inference.kernels import delayed_acceptance, metropolis_hastings, repeat, sequence, until
from bcppl.inference.kernels.rejuvenation import moved_by
from bcppl.inference.learning import bridged, bridging
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift, prior
from bcppl.inference.summaries import covariance, mean
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Trace, generate, simulate
from tests.invariance import largest_z, number

# x ~ N(0, I) in 4 axes, y | x ~ N(x, 0.1^2): the posterior is N(y / 1.01, 0.01 / 1.01).
SEEN = {"y": torch.tensor([0.5, -1.0, 0.2, 1.5], dtype=torch.float64)}
LOG_EVIDENCE = float(dist.Normal(number(0.0), math.sqrt(1.01)).log_prob(SEEN["y"]).sum())
CENTER, VARIANCE = SEEN["y"] / 1.01, 0.01 / 1.01
KERNEL = repeat(metropolis_hastings(drift("x", (0.3, 1.2))), 3)


def program() -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(4, dtype=torch.float64), 1.0).to_event(1))
    pyro.sample("y", dist.Normal(x, 0.1).to_event(1))


def near() -> None:
    """Two posterior standard deviations off on each axis, and three times as wide."""
    pyro.sample("x", dist.Normal(CENTER + 0.2, 0.3).to_event(1))


def narrow() -> None:
    """Well inside the posterior, a tenth as wide: no weight says what lies outside."""
    pyro.sample("x", dist.Normal(CENTER, 0.01).to_event(1))


@pytest.mark.parametrize("seed", range(3))
def test_a_proposal_that_is_too_narrow_is_named_and_the_posterior_is_reached(seed: int) -> None:
    torch.manual_seed(seed)
    few = metropolis_hastings(drift("x"))
    with pytest.warns(RuntimeWarning, match="is off; give a wider proposal"):
        population, _ = bridged(program, (), SEEN, 400, narrow, few, sweeps=1)
    variances = covariance(population, "x").diagonal()
    assert (variances > 0.7 * VARIANCE).all() and (variances < 1.4 * VARIANCE).all()
    assert population.log_evidence < LOG_EVIDENCE - 2.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bridged(program, (), SEEN, 400, near, KERNEL)


def test_a_program_without_continuous_values_is_bridged() -> None:
    def coin() -> None:
        pyro.sample("y", dist.Normal(pyro.sample("heads", dist.Bernoulli(0.5)), 1.0))

    def mostly_tails() -> None:
        pyro.sample("heads", dist.Bernoulli(0.2))

    torch.manual_seed(0)
    redrawn = metropolis_hastings(prior("heads"))
    population, _ = bridged(coin, (), {"y": torch.tensor(1.0)}, 2000, mostly_tails, redrawn)
    likelihood = dist.Normal(torch.tensor([0.0, 1.0]), 1.0).log_prob(torch.tensor(1.0)).exp()
    assert population.log_evidence == pytest.approx(float(likelihood.mean().log()), abs=0.05)
    assert float(mean(population, "heads")) == pytest.approx(
        float(likelihood[1] / likelihood.sum()), abs=0.05
    )
    with pytest.raises(InputError, match="none of the latent values that count is continuous"):
        moved_by(population, redrawn, POSTERIOR, until(displacement=0.5))


def runs(count: int, proposal: Any = near, **options: Any) -> tuple[Tensor, Tensor]:
    """The errors of log Z (R,), and the posterior means (R, 4)."""
    errors, means = [], []
    for _ in range(count):
        population, _ = bridged(program, (), SEEN, 200, proposal, KERNEL, **options)
        errors.append(population.log_evidence - LOG_EVIDENCE)
        means.append(mean(population, "x"))
    return torch.tensor(errors), torch.stack(means)


@pytest.mark.long
def test_evidence_and_mean_are_exact() -> None:
    torch.manual_seed(0)
    errors, means = runs(8)
    assert abs(float(errors.mean())) < 4 * float(errors.std()) / math.sqrt(8) + 0.02
    assert float(errors.std()) < 0.6
    off = (means.mean(0) - CENTER) / math.sqrt(VARIANCE)
    assert float(off.abs().max()) < 0.3


def test_it_takes_fewer_exponents_than_from_the_prior() -> None:
    torch.manual_seed(0)
    population, info = bridged(program, (), SEEN, 200, near, KERNEL)
    _, from_prior = tempered_importance_sampling(program, (), SEEN, 200, tempered(KERNEL))
    assert len(info.exponents) + 2 <= len(from_prior.exponents)
    assert info.exponents[-1] == 1.0 and 0.05 < info.acceptance < 0.9
    assert info.log_evidence == population.log_evidence
    spread = covariance(population, "x").diagonal()
    assert bool((spread / VARIANCE - 1.0).abs().max() < 0.4)


def test_the_posterior_as_the_proposal_needs_no_bridge() -> None:
    def exact() -> None:
        pyro.sample("x", dist.Normal(CENTER, math.sqrt(VARIANCE)).to_event(1))

    torch.manual_seed(0)
    population, info = bridged(program, (), SEEN, 50, exact, KERNEL)
    assert info.exponents == (1.0,) and info.resampled == 0 and math.isnan(info.acceptance)
    assert population.log_evidence == pytest.approx(LOG_EVIDENCE, abs=1e-10)


@pytest.mark.long
def test_addresses_that_the_proposal_leaves_out_come_from_the_program() -> None:
    def two() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        z = pyro.sample("z", dist.Normal(x, 1.0))
        pyro.sample("y", dist.Normal(z, 0.2))

    def of_one() -> None:
        pyro.sample("x", dist.Normal(number(1.0), 1.0))

    torch.manual_seed(0)
    kernel = repeat(
        metropolis_hastings(
            drift("x"),
        ),
        2,
    )
    both = bridging.bridged
    exact = float(dist.Normal(number(0.0), math.sqrt(2.04)).log_prob(number(2.0)))

    kernel = sequence(kernel, metropolis_hastings(drift("z")))
    errors = [
        both(two, (), {"y": number(2.0)}, 300, of_one, kernel)[0].log_evidence - exact for _ in range(12)
    ]
    assert abs(sum(errors) / 12) < 0.08


def bridge(exponent: float) -> tuple[Target, Trace]:
    """A target between near and the posterior, and exact draws of it."""
    start = bridging._Start(near, (), ("x",))
    precision = exponent / VARIANCE + (1 - exponent) / 0.09
    center = (exponent * CENTER / VARIANCE + (1 - exponent) * (CENTER + 0.2) / 0.09) / precision
    draws = generate(program, (), SEEN, 8000)[0]
    x = center + torch.randn(8000, 4, dtype=torch.float64) / math.sqrt(precision)
    return bridging.bridge(start, exponent), draws.at({"x": x})


def functions(trace: Trace) -> Tensor:
    away = (trace["x"] - CENTER) / math.sqrt(VARIANCE)
    return torch.cat([away, away**2], dim=1)


def test_targets_between_are_left_invariant_and_other_ones_are_not() -> None:
    torch.manual_seed(0)
    target, draws = bridge(0.3)
    move = repeat(metropolis_hastings(drift("x")), 3)(Population(draws[:500]))
    assert largest_z(functions(draws), functions(move(draws, target)[0])) < 4.5
    wrong, _ = bridge(0.7)
    for other in (POSTERIOR, wrong):
        assert largest_z(functions(draws), functions(move(draws, other)[0])) > 8.0
    plain = target(draws) - 0.3 * draws.log_prob() - 0.7 * near_density(draws)
    torch.testing.assert_close(plain, torch.zeros_like(plain))


def near_density(trace: Trace) -> Tensor:
    return dist.Normal(CENTER + 0.2, 0.3).to_event(1).log_prob(trace["x"])


@pytest.mark.long
def test_mutant_with_another_density_of_the_proposal(monkeypatch: pytest.MonkeyPatch) -> None:
    """The square of the proposal's density has the integral (2 sqrt(pi) 0.6)^-4."""

    def wide() -> None:
        pyro.sample("x", dist.Normal(CENTER + 0.2, 0.6).to_event(1))

    sound = bridging._Start.__call__
    torch.manual_seed(0)
    assert abs(float(runs(3, wide)[0].mean())) < 0.6
    monkeypatch.setattr(bridging._Start, "__call__", lambda *args: 2.0 * sound(*args))
    assert abs(float(runs(3, wide)[0].mean())) > 1.5


def test_what_is_no_proposal_or_kernel_is_refused() -> None:
    assert simulate(program).particles == 1
    with pytest.raises(InputError, match="samples no address"):
        bridged(program, (), SEEN, 10, lambda: None, KERNEL)
    with pytest.raises(InputError, match="in place of a kernel"):
        bridged(program, (), SEEN, 10, near, drift("x"))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="sweeps"):
        bridged(program, (), SEEN, 10, near, KERNEL, sweeps=0)


def test_particles_are_moved_after_every_exponent_and_stages_are_none() -> None:
    found = []
    for kernel in (KERNEL, delayed_acceptance(KERNEL)):
        torch.manual_seed(0)
        population, info = bridged(program, (), SEEN, 100, near, kernel, share=0.8)
        assert info.resampled >= len(info.exponents) - 1 > 2
        found.append(population["x"])
    assert torch.equal(*found)

"""Evidence that does not depend on how sharp a likelihood, how narrow a ridge or how large a unit is."""

from __future__ import annotations

import math
from collections.abc import Callable

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from bcppl.inference import tempered, tempered_importance_sampling
from bcppl.inference.annealing import persistent_sampling
from bcppl.inference.kernels import Kernel, hmc, metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift, independent, joint_drift
from tests.invariance import number


def run(program: Callable[[], None], y: object, particles: int, kernel: Kernel, seed: int) -> Population:
    torch.manual_seed(seed)
    step = tempered(kernel, sweeps=5)
    return tempered_importance_sampling(program, (), {"y": y}, particles, step).population


def sharp() -> None:
    pyro.sample("y", dist.Normal(pyro.sample("x", dist.Normal(number(0.0), 1.0)), 1e-6))


SHARP = -0.5 * 2.7**2 - 0.5 * math.log(2.0 * math.pi)
KERNELS = {
    "hmc": hmc("x"),
    "drift": metropolis_hastings(drift("x")),
    "independent": metropolis_hastings(independent("x")),
}


@pytest.mark.long
@pytest.mark.parametrize("name", KERNELS)
def test_a_likelihood_a_million_times_as_sharp_as_the_prior(name: str) -> None:
    """With a smallest exponent of 1e-6 one particle was left, and log Z was -2e9."""
    done = [run(sharp, 2.7, 600, KERNELS[name], seed) for seed in range(3)]
    assert sum(p.log_evidence for p in done) / 3 == pytest.approx(SHARP, abs=0.5)
    for population in done:
        assert population.distinct > 300
        assert float((population["x"] - 2.7).abs().max()) < 6e-6


@pytest.mark.long
def test_persistent_sampling_of_a_sharp_likelihood() -> None:
    torch.manual_seed(0)
    kernel = metropolis_hastings(drift("x"))
    done = persistent_sampling(sharp, (), {"y": 2.7}, 600, kernel, sweeps=5).population
    assert done.log_evidence == pytest.approx(SHARP, abs=0.7)


def in_units(size: float, small: float) -> Callable[[], None]:
    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(3.0 * size), size))
        z = pyro.sample("z", dist.Normal(number(0.0), small))
        pyro.sample("y", dist.Normal(x / size + z / small, 0.01))

    return program


@pytest.mark.long
@pytest.mark.parametrize("kernel", [hmc("x", "z"), metropolis_hastings(joint_drift("x", "z"))])
def test_units_do_not_change_a_digit(kernel: Kernel) -> None:
    one, other = (run(in_units(*u), 5.5, 200, kernel, 0) for u in ((1.0, 1.0), (2.0**30, 2.0**-30)))
    assert one.distinct > 150
    assert other.log_evidence == pytest.approx(one.log_evidence, abs=1e-6)
    torch.testing.assert_close(other["x"] / 2.0**30, one["x"], rtol=1e-6, atol=0.0)


def ridge() -> tuple[Callable[[], None], Tensor, float]:
    """30 correlated axes, the narrowest a sixtieth of the widest, and five readings of them."""
    generator = torch.Generator().manual_seed(0)
    wide, rows = (torch.randn(n, 30, generator=generator, dtype=torch.float64) for n in (30, 5))
    covariance = wide @ wide.T / 30.0 + 0.001 * torch.eye(30, dtype=torch.float64)
    factor, y = torch.linalg.cholesky(covariance), 2.0 * torch.randn(5, generator=generator).double()

    def program() -> None:
        x = pyro.sample("x", dist.MultivariateNormal(torch.zeros(30).double(), scale_tril=factor))
        pyro.sample("y", dist.Normal(x @ rows.T, 0.05).to_event(1))

    spread = rows @ covariance @ rows.T + 0.0025 * torch.eye(5, dtype=torch.float64)
    return program, y, float(MultivariateNormal(torch.zeros(5).double(), spread).log_prob(y))


@pytest.mark.long
def test_hmc_moves_along_narrow_ridges() -> None:
    """Correlations that were shrunk by a tenth made its steps along the narrow axes unstable."""
    program, y, exact = ridge()
    done = [run(program, y, 1000, hmc("x"), seed) for seed in range(2)]
    assert min(population.distinct for population in done) > 900
    assert sum(population.log_evidence for population in done) / 2 == pytest.approx(exact, abs=0.6)

"""Supports of distributions that are made of others: transformed ones, mixtures, counts of a total."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from pyro.distributions.transforms import AffineTransform, ExpTransform
from torch import Tensor

from bcppl.distributions.shortcuts import unvalidated
from bcppl.distributions.support import log_prob_inside
from bcppl.inference import importance_sampling, rejuvenate
from bcppl.inference.kernels import hmc, metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.traces import simulate

ONE = torch.tensor(1.0, dtype=torch.float64)
TWO = torch.ones(2, dtype=torch.float64)


def real(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def shifted(of: Any, by: float, scale: float = 1.0) -> Any:
    return dist.TransformedDistribution(of, [AffineTransform(by * ONE, scale * ONE)])


def halves(components: Any) -> Any:
    return dist.MixtureSameFamily(dist.Categorical(TWO), components)


@pytest.mark.parametrize(
    "make",
    [
        lambda: shifted(dist.Exponential(ONE), 3.0),
        lambda: shifted(dist.Exponential(ONE), 0.0, -1.0),
        lambda: shifted(dist.Beta(2 * ONE, 3 * ONE), -1.0, 4.0),
        lambda: shifted(shifted(dist.Gamma(2 * ONE, ONE), 1.0), 1.0),
        lambda: dist.TransformedDistribution(dist.Exponential(2 * ONE), [ExpTransform()]),
        lambda: shifted(dist.Normal(ONE, ONE), 3.0),
        lambda: halves(dist.Uniform(0 * TWO, real(1.0, 10.0))),
        lambda: halves(dist.Exponential(real(1.0, 3.0))),
        lambda: halves(dist.Normal(real(-3.0, 3.0), TWO)),
        lambda: halves(shifted(dist.Exponential(TWO), 2.0)),
        lambda: dist.Gumbel(ONE, ONE),
        lambda: dist.Weibull(ONE, 2 * ONE),
    ],
)
def test_all_of_a_density_lies_inside(make: Callable[[], Any]) -> None:
    x = torch.linspace(-60.0, 80.0, 1_400_001, dtype=torch.float64)[:, None]
    with unvalidated():
        distribution = make().expand([1])
    density = log_prob_inside(distribution, x)[:, 0].exp()
    mass = float(torch.trapezoid(density, x[:, 0]))
    assert mass == pytest.approx(1.0, abs=1e-3)
    assert bool(log_prob_inside(distribution, distribution.sample((1000,))).isfinite().all())


def test_angles_that_are_turned_have_mass_on_one_turn_and_may_be_observed_in_any() -> None:
    turned = shifted(dist.VonMises(0 * ONE, 2 * ONE), 1.0)
    x = torch.linspace(-20.0, 20.0, 400_001, dtype=torch.float64)
    mass = torch.trapezoid(log_prob_inside(turned, x, any_turn=False).exp(), x)
    assert float(mass) == pytest.approx(1.0, abs=1e-3)
    seen = log_prob_inside(turned, real(0.5, 0.5 + 2 * math.pi))
    assert float(seen[0]) == pytest.approx(float(seen[1]))


def test_a_shift_is_known_from_what_cannot_be_before_it() -> None:
    """t0 uniform on (0, 10), y = t0 + Exponential(1), y = 3: log Z = log((1 - e^-3) / 10)."""

    def program() -> None:
        t0 = pyro.sample("t0", dist.Uniform(0 * ONE, 10 * ONE))
        late = dist.TransformedDistribution(dist.Exponential(torch.ones_like(t0)), [AffineTransform(t0, 1.0)])
        pyro.sample("y", late)

    torch.manual_seed(0)
    population = importance_sampling(program, (), {"y": 3.0}, 4000)
    assert population.log_evidence == pytest.approx(math.log((1 - math.exp(-3.0)) / 10), abs=0.15)
    assert bool((population.log_weights[population["t0"] > 3.0] == -math.inf).all())


@pytest.mark.parametrize("plated", [True, False])
def test_an_outlier_outside_one_component_is_the_others(plated: bool) -> None:
    """y given x = 0 is half U(0, 1) and half U(0, 4), given x = 1 U(0, 4); y = 3: P(x = 1) = 2/3."""

    def program() -> None:
        x = pyro.sample("x", dist.Bernoulli(0.5 * ONE))
        high = torch.stack([torch.where(x == 0, 1.0, 4.0), torch.full_like(x, 4.0)], dim=-1).double()
        mixture = dist.MixtureSameFamily(
            dist.Categorical(torch.ones_like(high)), dist.Uniform(0 * high, high)
        )
        if plated:
            with pyro.plate("readings", 1):
                pyro.sample("y", mixture.expand([1, len(x)]))
        else:
            pyro.sample("y", mixture)

    torch.manual_seed(0)
    population = importance_sampling(program, (), {"y": real(3.0) if plated else 3.0}, 4000)
    share = population.log_weights.softmax(dim=0) @ population["x"]
    assert float(share) == pytest.approx(2 / 3, abs=0.04)
    assert math.exp(population.log_evidence) == pytest.approx(3 / 16, abs=0.01)


def test_mixtures_in_events_and_masks() -> None:
    with unvalidated():
        uniforms = halves(dist.Uniform(0 * TWO, real(1.0, 4.0))).expand([2])
        pair, masked = uniforms.to_event(1), uniforms.mask(torch.tensor([True, False]))
        both = log_prob_inside(pair, real(3.0, 3.0)), log_prob_inside(pair, real(3.0, 5.0))
        one = log_prob_inside(masked, real(3.0, 5.0))
    assert float(both[0]) == pytest.approx(2 * math.log(0.5 / 4)) and float(both[1]) == -math.inf
    torch.testing.assert_close(one, real(math.log(0.5 / 4), 0.0))


@pytest.mark.parametrize("kernel", [metropolis_hastings(drift("x")), hmc("x")], ids=["drift", "hmc"])
def test_what_is_scaled_of_bounded_values_is_moved_within_them(kernel: Any) -> None:
    """A Beta(2, 3) on (0, 4) alone: its mean is 1.6, its variance 0.64."""

    def program() -> None:
        pyro.sample("x", shifted(dist.Beta(2 * ONE, 3 * ONE), 0.0, 4.0))
        pyro.sample("y", dist.Normal(0 * ONE, ONE))

    torch.manual_seed(0)
    begun = importance_sampling(program, (), {"y": 0.0}, 2000)
    moved = rejuvenate(begun, kernel, sweeps=5)
    assert float((moved["x"] != begun["x"]).double().mean()) > 0.5
    assert float(moved["x"].mean()) == pytest.approx(1.6, abs=0.1)
    assert float(moved["x"].var()) == pytest.approx(0.64, abs=0.08)


def test_a_latent_mixture_has_the_coordinates_of_its_components() -> None:
    def program() -> None:
        pyro.sample("x", halves(dist.Normal(real(-1.0, 1.0), TWO)))
        pyro.sample("y", dist.Normal(0 * ONE, ONE))

    torch.manual_seed(0)
    begun = importance_sampling(program, (), {"y": 0.0}, 200)
    moved = rejuvenate(begun, metropolis_hastings(drift("x")), sweeps=3)
    assert float((moved["x"] != begun["x"]).double().mean()) > 0.5


@pytest.mark.parametrize("of", ["multinomial", "Dirichlet-multinomial"])
def test_counts_have_their_total(of: str) -> None:
    def program() -> None:
        total = pyro.sample("n", dist.Categorical(torch.ones(5, dtype=torch.float64))) + 4.0
        concentration = torch.ones(len(total), 3, dtype=torch.float64)
        pyro.sample("y", dist.DirichletMultinomial(concentration, total))

    if of == "multinomial":
        with unvalidated():
            counts = dist.Multinomial(4, torch.ones(3, dtype=torch.float64))
        assert float(log_prob_inside(counts, real(1.0, 2.0, 1.0))) == pytest.approx(math.log(12 / 81))
        assert float(log_prob_inside(counts, real(1.0, 1.0, 1.0))) == -math.inf
        assert bool(simulate(lambda: pyro.sample("y", counts), (), 50).log_prob().isfinite().all())
        return
    torch.manual_seed(0)
    population = importance_sampling(program, (), {"y": real(1.0, 2.0, 1.0)}, 200)
    assert bool((population.log_weights[population["n"] > 0] == -math.inf).all())

"""Particle Gibbs with ancestor sampling leaves the distribution of paths, and of parameters, as it was."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import markov_chains
from bcppl.inference.kernels import hmc, metropolis_hastings, sequence
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.series import conditional, particle_gibbs, unrolled
from bcppl.inference.series.conditional import _Conditional
from bcppl.inference.targets import POSTERIOR, FunctionTarget, Target
from bcppl.traces import Series, Trace, assess, extend, generate, simulate
from tests.inference.series.linear_series import (
    AUTOREGRESSION,
    NOISE,
    SEEN,
    hmm,
    hmm_smoothed,
    observed,
    posterior,
    smoothed,
    with_known,
)
from tests.invariance import largest_z, number

T = 5
RHO = 0.9
PATH = ["x", *(f"x/{t}" for t in range(1, T + 1))]


def exact_paths(series: Series, count: int, mean: Tensor, covariance: Tensor) -> Trace:
    """Exact draws of x_0, ..., x_T given the observations."""
    paths = torch.distributions.MultivariateNormal(mean, covariance).sample((count,))
    values = {address: paths[:, t] for t, address in enumerate(PATH)}
    return generate(unrolled(series), ([()] * T,), observed(T), count, values)[0]


def moments(trace: Trace) -> Tensor:
    x = torch.stack([trace[address] for address in PATH], dim=1)
    return torch.cat([x, x**2, x[:, 1:] * x[:, :-1], (x[:, :1] * x[:, -1:])], dim=1)


def test_unrolled_is_the_series() -> None:
    trace = simulate(unrolled(AUTOREGRESSION), ([()] * 3,), 4)
    assert trace.addresses == ["rho", "x", "x/1", "y/1", "x/2", "y/2", "x/3", "y/3"]
    own: Any = simulate(AUTOREGRESSION, (), 4).at({"rho": trace["rho"], "x": trace["x"]})
    for t in range(1, 4):
        own, _ = extend(own, (), {}, {"x": trace[f"x/{t}"], "y": trace[f"y/{t}"]})
    torch.testing.assert_close(
        assess(unrolled(AUTOREGRESSION), ([()] * 3,), trace.choices, 4), own.log_prob()
    )


def test_the_path_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    before = exact_paths(with_known(RHO), 20_000, *smoothed(RHO, T))

    def moved() -> float:
        after, changed = particle_gibbs(particles=3)(Population(before))(before, POSTERIOR)
        assert 0.3 < float(changed.mean()) < 1.0
        return largest_z(moments(before), moments(after))

    assert moved() < 4.5
    # An ancestor that is drawn by weight alone, as if the step to the path had no density.
    density = _Conditional._log_density

    def without_latent(self: Any, number: int, trace: Trace, addresses: Any, *_: Any) -> Tensor:
        return density(self, number, trace, [a for a in addresses if a not in trace.choices])

    monkeypatch.setattr(_Conditional, "_log_density", without_latent)
    assert moved() > 8.0


def test_a_tempered_target_is_left_as_it_was() -> None:
    """At exponent 0 of the last three observations, the posterior given the first two."""
    torch.manual_seed(0)
    mean, covariance = smoothed(RHO, 2)
    x = torch.distributions.MultivariateNormal(mean, covariance).sample((20_000,))
    for _ in range(2, T):
        x = torch.cat([x, RHO * x[:, -1:] + torch.randn(len(x), 1, dtype=torch.float64)], dim=1)
    values = {address: x[:, t] for t, address in enumerate(PATH)}
    before, _ = generate(unrolled(with_known(RHO)), ([()] * T,), observed(T), len(x), values)
    target = Target({f"y/{t}": 0.0 for t in range(3, T + 1)})
    after, _ = particle_gibbs(particles=4)(Population(before))(before, target)
    assert largest_z(moments(before), moments(after)) < 4.5


def test_exponents_of_the_path_itself_are_the_targets() -> None:
    torch.manual_seed(0)
    exponents = (1.0, 0.4, 1.0, 2.0, 0.4, 1.0)
    before = exact_paths(with_known(RHO), 20_000, *smoothed(RHO, T, exponents))
    target = Target(dict(zip(PATH, exponents, strict=True)))
    after, _ = particle_gibbs(particles=6)(Population(before))(before, target)
    assert largest_z(moments(before), moments(after)) < 4.5
    plain, _ = particle_gibbs(particles=6)(Population(before))(before, POSTERIOR)
    assert largest_z(moments(before), moments(plain)) > 8.0


def test_a_path_that_is_impossible_finds_a_possible_one() -> None:
    def walk(x: Tensor) -> Tensor:
        x = pyro.sample("x", dist.Normal(x, 1.0))
        pyro.sample("y", dist.Uniform(x - 0.5, x + 0.5))
        return x

    torch.manual_seed(0)
    series = Series(lambda: pyro.sample("x", dist.Normal(number(0.0), 1.0)), walk)
    seen = {"y/1": number(3.0), "y/2": number(3.0)}
    trace, _ = generate(unrolled(series), ([()] * 2,), seen, 20)
    assert int((trace.log_prob() == -torch.inf).sum()) > 15
    chains = markov_chains(particle_gibbs(particles=30), trace, moves=20, progress=False)
    assert bool((chains.draws["x/2"][-1] - 3.0).abs().max() < 0.5)


def summed() -> Series:
    """A state that holds the sum of the path, which is what is observed."""

    def begin() -> dict[str, Tensor]:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        return {"x": x, "sum": torch.zeros_like(x)}

    def walk(state: dict[str, Tensor]) -> dict[str, Tensor]:
        x = pyro.sample("x", dist.Normal(RHO * state["x"], 1.0))
        total = state["sum"] + x
        pyro.sample("y", dist.Normal(total, NOISE))
        return {"x": x, "sum": total}

    return Series(begin, walk)


def test_a_state_that_holds_the_past_restricts_the_ancestors(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    lag = torch.eye(T + 1, dtype=torch.float64)
    lag[torch.arange(1, T + 1), torch.arange(T)] = -RHO
    sums = torch.tril(torch.ones(T, T, dtype=torch.float64))
    sums = torch.cat([torch.zeros(T, 1, dtype=torch.float64), sums], dim=1)
    covariance = torch.linalg.inv(lag.T @ lag + sums.T @ sums / NOISE**2)
    before = exact_paths(summed(), 20_000, covariance @ sums.T @ SEEN[:T] / NOISE**2, covariance)
    after, _ = particle_gibbs(particles=4)(Population(before))(before, POSTERIOR)
    assert largest_z(moments(before), moments(after)) < 4.5
    monkeypatch.setattr(conditional, "same", lambda a, b, count: torch.ones(count, dtype=torch.bool))
    after, _ = particle_gibbs(particles=4)(Population(before))(before, POSTERIOR)
    assert largest_z(moments(before), moments(after)) > 8.0


def test_a_discrete_path_reaches_its_smoothing_distribution() -> None:
    torch.manual_seed(0)
    symbols = {f"y/{t}": torch.tensor(s) for t, s in enumerate([0, 0, 1, 2], 1)}

    def begin() -> None:
        return None

    series = Series(begin, hmm().step)
    trace, _ = generate(unrolled(series), ([()] * 4,), symbols, 4000)
    move = particle_gibbs(particles=5)(Population(trace))
    for _ in range(6):
        trace, _ = move(trace, POSTERIOR)
    shares = torch.stack(
        [torch.bincount(trace[f"z/{t}"].long(), minlength=3) / 4000 for t in range(1, 5)]
    ).double()
    exact = hmm_smoothed()
    assert float(((shares - exact) / (exact * (1 - exact) / 4000).sqrt()).abs().max()) < 4.0


@pytest.mark.long
@pytest.mark.parametrize(
    "move", [metropolis_hastings(drift("rho", (0.5, 2.0))), hmc("rho", steps=3)], ids=["drift", "hmc"]
)
def test_paths_and_a_parameter_reach_the_posterior(move: Any) -> None:
    torch.manual_seed(1)
    count = 6
    trace, _ = generate(unrolled(AUTOREGRESSION), ([()] * count,), observed(count), 300)
    kernel = sequence(particle_gibbs("rho", particles=10), move)
    rho = markov_chains(kernel, trace, 15, every=15, addresses="rho", progress=False).draws["rho"][-1]
    grid, chance, _ = posterior(count)
    values, exact = torch.stack([rho, rho**2]), torch.stack([grid, grid**2]) @ chance
    z = (values.mean(dim=1) - exact) / (values.std(dim=1) / math.sqrt(300))
    assert float(z.abs().max()) < 4.0


def test_few_particles_move_a_long_path() -> None:
    torch.manual_seed(0)
    series = with_known(RHO)
    trace, _ = generate(unrolled(series), ([()] * 20,), observed(20), 100)
    move = particle_gibbs(particles=5)(Population(trace))
    after, _ = move(trace, POSTERIOR)
    assert float((after["x/1"] != trace["x/1"]).double().mean()) > 0.5


def test_refusals_say_what_to_do() -> None:
    trace, _ = generate(unrolled(AUTOREGRESSION), ([()] * 2,), observed(2), 3)
    with pytest.raises(InputError, match="1 particles; give a whole number, 2 or more"):
        particle_gibbs("rho", particles=1)
    with pytest.raises(InputError, match="generate one from `unrolled"):
        other = simulate(AUTOREGRESSION, (), 3)
        particle_gibbs("rho")(Population(other))(other, POSTERIOR)
    with pytest.raises(InputError, match="give a `Target`"):
        particle_gibbs("rho")(Population(trace))(trace, FunctionTarget(log_density=Trace.log_prob))
    with pytest.raises(InputError, match="'phi'"):
        particle_gibbs("phi")(Population(trace))(trace, POSTERIOR)
    with pytest.raises(InputError, match="keep 'x/1', which `init` does not sample"):
        particle_gibbs("x/1")(Population(trace))(trace, POSTERIOR)


def test_a_parameter_that_stays_weighs_what_it_depends_on() -> None:
    """The scale given the parameter alone is inverse gamma: nothing else depends on it."""
    torch.manual_seed(0)
    count, rho = 2000, 1.5

    def begin() -> dict[str, Tensor]:
        precision = pyro.sample("precision", dist.Gamma(number(2.0), 2.0))
        rho = pyro.sample("rho", dist.Normal(number(0.0), precision.rsqrt()))
        return {"rho": rho, "x": pyro.sample("x", dist.Normal(number(0.0), 1.0))}

    series = Series(begin, AUTOREGRESSION.step)
    given = {"rho": torch.full((count,), rho, dtype=torch.float64)}
    trace, _ = generate(unrolled(series), ([()] * 2,), observed(2), count, given)
    move = particle_gibbs("rho", particles=20)(Population(trace))
    for _ in range(5):
        trace, _ = move(trace, POSTERIOR)
    drawn = trace["precision"]
    exact = dist.Gamma(2.5, 2.0 + 0.5 * rho**2).mean
    assert abs(float((drawn.mean() - exact) / (drawn.std() / math.sqrt(count)))) < 4.0


def test_an_address_of_init_that_is_one_of_a_steps_is_refused() -> None:
    def begin() -> dict[str, Tensor]:
        return {"rho": number(0.5), "x": pyro.sample("x/1", dist.Normal(number(0.0), 1.0))}

    with pytest.raises(InputError, match=r"samples 'x/1', which is 'x' of step 1; name it otherwise"):
        simulate(unrolled(Series(begin, AUTOREGRESSION.step)), ([()] * 2,), 3)
    simulate(unrolled(Series(begin, AUTOREGRESSION.step)), ([],), 3)

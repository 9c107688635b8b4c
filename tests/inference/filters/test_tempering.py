"""Tempering: exponents that keep what is asked for, all sites at once or one after another."""

from __future__ import annotations

import math

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.beliefs import normalised
from bcppl.errors import InferenceError, InputError
from bcppl.inference.exponents import conditional_effective_sample_size, next_exponent
from bcppl.inference.filters.smcp3 import Pair, move_and_weight
from bcppl.inference.filters.step import Observed
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.filters.waste_free import waste_free_moves
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import Resample, adaptive, always, never
from bcppl.inference.verbs import update
from bcppl.traces import generate


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


# ---- tempering


def test_the_next_exponent_keeps_the_share_asked_for() -> None:
    torch.manual_seed(0)
    for sharpness in (30.0, 1e4):
        log_likelihood = -sharpness * torch.rand(200, dtype=torch.float64) - 5e5
        log_weights = torch.randn(200, dtype=torch.float64)
        reached = 0.0
        for share in (0.9, 0.5):
            exponent = next_exponent(log_weights, log_likelihood, reached, share)
            step = (exponent - reached) * log_likelihood
            assert reached < exponent < 1
            assert conditional_effective_sample_size(normalised(log_weights), step) / 200 == pytest.approx(
                share, abs=1e-4
            )
            reached = exponent
    # By hand: weights 1/4 3/4, factors 1 and e: CESS = 2 (1/4 + 3e/4)^2 / (1/4 + 3e^2/4).
    by_hand = 2 * (0.25 + 0.75 * math.e) ** 2 / (0.25 + 0.75 * math.e**2)
    uneven = torch.tensor([0.25, 0.75], dtype=torch.float64).log() + 7.0
    assert conditional_effective_sample_size(
        normalised(uneven), torch.tensor([10.0, 11.0]).double()
    ) == pytest.approx(by_hand)
    assert next_exponent(log_weights, torch.zeros(200, dtype=torch.float64), 0.3, 0.5) == 1.0


def test_particles_that_cannot_be_do_not_steer_the_exponent() -> None:
    torch.manual_seed(0)
    log_likelihood = -200.0 * torch.rand(100, dtype=torch.float64)
    weights = torch.zeros(100, dtype=torch.float64)
    alone = next_exponent(weights, log_likelihood, 0.0, 0.5)
    gone = torch.full((60,), -torch.inf, dtype=torch.float64)
    both = next_exponent(torch.zeros(160, dtype=torch.float64), torch.cat([log_likelihood, gone]), 0.0, 0.5)
    assert both == pytest.approx(alone, rel=1e-9)


def half_line(steps: int) -> None:
    """A coin that decides whether what is seen can be: seen to be above x."""
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    for k in range(steps):
        pyro.sample(f"y_{k}", dist.Uniform(x, 10.0))


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("resample", [never, always(), adaptive()])
def test_nothing_left_is_an_error_that_says_what_to_try(share: float, resample: Resample) -> None:
    trace, weights = generate(half_line, (0,), {}, 50)
    kernel = metropolis_hastings(drift("x"))
    step = tempered(kernel, resample=resample, share=share)
    some = step(Population(trace, weights), Observed((1,), {"y_0": number(0.3)})).population
    if resample is not never:
        assert bool((some.trace["x"][some.log_weights > -torch.inf] <= 0.3).all())
    with pytest.raises(InferenceError, match=r"no particle has any weight left.*widen the prior") as caught:
        step(some, Observed((2,), {"y_1": number(11.0)}))
    assert str(caught.value).count("\n") == 0


@pytest.mark.long
def test_sites_that_the_program_fixes_are_tempered_like_observations() -> None:
    """What `obs=` fixes is tempered too: left out after the first step, it would cost 0.4 of log Z."""
    exact = -0.5 * math.log(1.0 + 1.0 / 0.01 + 1.0 / 0.01) - math.log(2 * math.pi * 0.01)

    def fixing(count: int) -> None:
        x = pyro.sample("x", dist.Normal(torch.tensor(0.0, dtype=torch.float64), 1.0))
        if count:
            zero = torch.tensor(0.0, dtype=torch.float64)
            pyro.sample("seen", dist.Normal(x, 0.1))
            pyro.sample("fixed", dist.Normal(x, 0.1), obs=zero)

    estimates = []
    for seed in range(12):
        torch.manual_seed(seed)
        trace, weights = generate(fixing, (0,), {}, 1000)
        take = tempered(metropolis_hastings(drift("x", (0.5, 1.0))), sweeps=5, share=0.7)
        done = take(Population(trace, weights), Observed((1,), {"seen": number(0.0)}))
        estimates.append(done.population.log_evidence)
    assert abs(sum(estimates) / len(estimates) - exact) < 0.1


@pytest.mark.parametrize("exponents", [(), (0.5,), (0.5, 0.5, 1.0), (0.0, 1.0), (0.5, 1.0, 2.0)])
def test_exponents_that_do_not_lead_to_one(exponents: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="give increasing ones that end with 1"):
        tempered(exponents=exponents)


def test_old_sites_that_new_arguments_change_are_weighed() -> None:
    """The prior becomes three times as wide with the observation."""

    def widened(seen: bool) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 3.0 if seen else 1.0))
        if seen:
            pyro.sample("y", dist.Normal(x, 0.5))
            pyro.sample("z", dist.Normal(x, 0.5))

    torch.manual_seed(0)
    prior = importance_sampling(widened, (False,), {}, 20_000)
    seen = {"y": number(2.0), "z": number(2.5)}
    step = tempered(metropolis_hastings(drift("x")))
    population, info = step(prior, Observed((True,), seen))
    assert info.log_evidence == population.log_evidence - prior.log_evidence
    exact = dist.Normal(number(0.0), math.sqrt(9.125)).log_prob(number(2.25))
    exact = exact + dist.Normal(number(0.0), math.sqrt(0.5)).log_prob(number(0.5))
    assert population.log_evidence == pytest.approx(float(exact), abs=0.1)


def within(bound: float, count: int) -> None:
    """A reading lies within a bound of x that a later argument refines."""
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    pyro.sample("y_0", dist.Uniform(x - bound, x + bound))
    for k in range(1, count):
        pyro.sample(f"y_{k}", dist.Normal(x, 1.0))


def test_a_particle_that_was_impossible_stays_so_where_new_arguments_allow_it() -> None:
    observed = Observed((2.0, 2), {"y_1": number(0.3)})
    population = importance_sampling(within, (1.0, 1), {"y_0": number(0.3)}, 200)
    dead = population.log_weights == -torch.inf
    assert 20 < int(dead.sum()) < 180
    expected = update(population, observed)
    assert bool((expected.log_weights[dead] == -torch.inf).all())
    for later in (
        tempered(resample=never)(population, observed).population,
        smcp3_still(population, observed),
    ):
        torch.testing.assert_close(later.log_weights, expected.log_weights)
        assert later.log_evidence == pytest.approx(expected.log_evidence)


def smcp3_still(population: Population, observed: Observed) -> Population:
    return move_and_weight(population, Pair(lambda trace: None, lambda trace: None), observed)


def test_a_rejuvenation_has_its_own_sweeps() -> None:
    own = waste_free_moves(metropolis_hastings(drift("x")), 4)
    for settings in ({"sweeps": 50}, {"always_move": True}):
        with pytest.raises(InputError, match="rejuvenation beside a kernel, sweeps"):
            tempered(rejuvenation=own, **settings)  # type: ignore[arg-type]

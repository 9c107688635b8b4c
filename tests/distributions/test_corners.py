"""Corners in which a wrong number would come without a word."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.distributions.lazy import LazyDistribution
from bcppl.errors import InputError
from bcppl.inference.filters.step import Observed
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.importance import generate_stratified, importance_sampling
from bcppl.inference.kernels import Move, metropolis_hastings, moved_by
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import never
from bcppl.inference.sizing import merge
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.traces import Series, Trace, assess, generate, propose, update


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


class Lazy(LazyDistribution):
    def __init__(self, loc: Tensor) -> None:
        self.loc = loc
        super().__init__(len(loc), ())

    def log_prob(self, value: Tensor) -> Tensor:
        return torch.distributions.Normal(self.loc, 1.0).log_prob(value)


def uniform() -> None:
    pyro.sample("x", dist.Uniform(number(0.0), number(1.0)))


def test_what_a_program_observes_of_a_latent_value_is_never_stale() -> None:
    def program() -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 3.0))
        pyro.sample("y", Lazy(torch.zeros(len(x), dtype=torch.float64)), obs=x)

    torch.manual_seed(0)
    trace, _ = generate(program, (), {}, 5)
    trace.log_prob()
    moved = update(trace, {"x": trace["x"] + 1.0}).trace
    torch.testing.assert_close(moved.log_prob("y"), torch.distributions.Normal(0.0, 1.0).log_prob(moved["x"]))


def test_at_exponent_zero_the_proposals_ratio_still_decides() -> None:
    torch.manual_seed(0)
    trace, _ = generate(uniform, (), {}, 8000)

    def leaning(_: Trace) -> None:
        pyro.sample("x", dist.Beta(number(3.0), number(1.0)))

    start = Population(trace)
    moved = moved_by(start, metropolis_hastings(leaning), Target({"x": 0.0}), 3).population
    assert float(moved.trace["x"].mean()) == pytest.approx(0.5, abs=4.5 * 0.29 / math.sqrt(8000))


@pytest.mark.parametrize("exponent", [-0.5, float("nan")])
def test_exponents_that_are_none_are_refused(exponent: float) -> None:
    with pytest.raises(InputError, match="'x' is given the exponent"):
        Target({"x": exponent})


def test_a_proposal_that_observes_is_refused() -> None:
    def weighing() -> None:
        pyro.sample("x", dist.Normal(number(0.0), 1.0))
        pyro.factor("w", number(2.0))

    with pytest.raises(InputError, match="observes 'w' itself"):
        propose(weighing, (), 3)
    with pytest.raises(InputError, match="observes 'w' itself"):
        assess(weighing, (), {"x": torch.zeros(3, dtype=torch.float64)}, 3)


def test_weights_changed_in_place_leave_the_trace_alone() -> None:
    def program() -> None:
        pyro.sample("y", dist.Normal(pyro.sample("x", dist.Normal(number(0.0), 1.0)), 1.0))

    torch.manual_seed(0)
    trace, weight = generate(program, (), {"y": number(0.0)}, 3)
    before = trace.log_prob("y").clone()
    weight -= weight.max()
    assert torch.equal(trace.log_prob("y"), before)


def test_particles_of_a_series_are_not_merged() -> None:
    def step(state: Tensor) -> Tensor:
        return state + pyro.sample("b", dist.Bernoulli(number(0.5)))

    series = Series(lambda: pyro.sample("a", dist.Bernoulli(number(0.5))), step)
    trace, weight = generate(series, (), {}, 20)
    with pytest.raises(InputError, match="different pasts"):
        merge(Population(trace, weight))


@pytest.mark.parametrize("make", [lambda: dist.Normal(number(0.0), 1.0), lambda: dist.Bernoulli(number(0.5))])
def test_strata_of_a_plate_need_a_function(make: Callable[[], Any]) -> None:
    def program() -> None:
        with pyro.plate("points", 3):
            pyro.sample("x", make())

    with pytest.raises(InputError, match="strata as a function"):
        generate_stratified(program, (), {}, 6)


def test_moves_are_made_after_every_exponent_when_asked() -> None:
    def program(count: int) -> None:
        x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
        if count:
            pyro.sample("y", dist.Normal(x, 1.0))

    walk, asked = metropolis_hastings(drift("x")), []

    def counting(population: Population) -> Move:
        asked.append(len(population))
        return walk(population)

    torch.manual_seed(0)
    start = importance_sampling(program, (0,), {}, 10)
    for always_move, expected in ((False, 0), (True, 4)):
        asked.clear()
        step = tempered(counting, sweeps=1, resample=never, exponents=[0.5, 1.0], always_move=always_move)
        step(start, Observed((1,), {"y": number(0.3)}))
        assert len(asked) == expected, "two halves after each of two exponents"
    unmoved = replace(start, log_weights=torch.zeros(10, dtype=torch.float64))
    assert moved_by(unmoved, walk, POSTERIOR, 0).population is unmoved

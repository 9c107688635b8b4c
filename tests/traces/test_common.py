"""What a trace passes on to those of particles chosen from it, so that no program is run to find it out."""

from __future__ import annotations

from collections.abc import Callable

import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl.inference import importance_sampling
from bcppl.inference.kernels import metropolis_hastings, moved_by
from bcppl.inference.proposals import drift
from bcppl.inference.proposals.coordinates import coordinates_of
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Series, Trace, extend, generate, update
from tests.invariance import number

N = 40


def bounded(width: float = 1.0) -> None:
    """A site whose support depends on another value, and one whose distribution the argument determines."""
    top = pyro.sample("top", dist.LogNormal(number(0.0), 1.0))
    pyro.sample("x", dist.Uniform(-top, top))
    pyro.sample("z", dist.Normal(number(0.0), width) if width > 0.0 else dist.LogNormal(number(0.0), 1.0))
    pyro.sample("seen", dist.Normal(top, 1.0))


@pytest.mark.parametrize(
    "choose", [lambda t: t[torch.arange(N).flip(0)], lambda t: t.replaced(torch.tensor([3]), t[7])]
)
def test_a_support_that_depends_on_a_value_is_that_of_the_particles(choose: Callable[[Trace], Trace]) -> None:
    trace, _ = generate(bounded, (1.0,), {"seen": number(0.5)}, N)
    assert coordinates_of(trace, "top").dimension == coordinates_of(trace, "x").dimension == 1
    other = choose(trace)
    bounds = other.support("x").constraint
    assert torch.equal(bounds.upper_bound, other["top"]) and torch.equal(bounds.lower_bound, -other["top"])
    assert not other.support("x").is_fixed and other.support("top") == trace.support("top")


def test_other_arguments_may_give_another_support() -> None:
    trace, _ = generate(bounded, (1.0,), {"seen": number(0.5)}, N)
    assert trace.addresses == ["top", "x", "z", "seen"]
    assert trace.support("z").constraint is dist.constraints.real
    moved = update(trace, {"z": trace["z"].exp()}, args=(-1.0,)).trace
    assert moved.support("z").constraint.lower_bound == 0.0
    assert trace.support("z").constraint is dist.constraints.real


def test_other_arguments_may_give_other_addresses() -> None:
    def program(count: int) -> None:
        for k in range(count):
            pyro.sample(f"x_{k}", dist.Normal(number(0.0), 1.0))

    trace, _ = generate(program, (1,), {}, N)
    assert trace.addresses == ["x_0"]
    longer, _ = extend(trace[:5], (3,), {})
    assert longer.addresses == longer[:2].addresses == ["x_0", "x_1", "x_2"] and trace.addresses == ["x_0"]


def test_a_step_of_a_series_has_its_own_addresses() -> None:
    def init() -> torch.Tensor:
        return pyro.sample("x", dist.Normal(number(0.0), 1.0))

    def step(x: torch.Tensor) -> torch.Tensor:
        return pyro.sample("x", dist.Normal(x, 1.0)) + pyro.sample("drag", dist.LogNormal(number(0.0), 1.0))

    first, _ = generate(Series(init, step), (), {}, N)
    assert first.addresses == ["x"]
    second, _ = extend(first[torch.arange(N).flip(0)], (), {})
    assert second.addresses == ["x", "drag"] and second[:3].addresses == ["x", "drag"]
    assert second[:3].support("drag").constraint.lower_bound == 0.0


def test_particles_are_replaced_as_by_a_choice_of_all() -> None:
    trace, _ = generate(bounded, (1.0,), {"seen": number(0.5)}, N)
    other, _ = generate(bounded, (1.0,), {"seen": number(0.5)}, N)
    trace.log_prob(), other.log_prob("x")
    index = torch.tensor([4, 30, 11])
    mask = torch.zeros(N, dtype=torch.bool)
    mask[index] = True
    expected, got = other.where(mask, trace), trace.replaced(index, other[index])
    assert all(torch.equal(got[a], expected[a]) for a in trace.choices)
    assert got.known.keys() == expected.known.keys() == {"x", "seen"}
    assert torch.equal(got.known["x"], expected.known["x"]) and torch.equal(
        got.log_prob(), expected.log_prob()
    )


def test_a_move_runs_the_model_once() -> None:
    runs = []

    def model() -> None:
        x = pyro.sample("x", dist.Normal(torch.zeros(3).double(), 1.0).to_event(1))
        runs.append(len(x))
        pyro.sample("y", dist.Normal(x.sum(-1), 0.5))

    population = importance_sampling(model, (), {"y": number(0.3)}, N)
    population = moved_by(population, metropolis_hastings(drift("x")), POSTERIOR).population
    runs.clear()
    moved_by(population, metropolis_hastings(drift("x")), POSTERIOR, sweeps=5)
    halves = {int(population.sides.sum()), N - int(population.sides.sum())}
    assert len(runs) == 10 and set(runs) == halves, "five sweeps of two halves"

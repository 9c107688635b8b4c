"""Traces of marginal series at other arguments and steps: whose estimates their filters are."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import importance_sampling, markov_chains, rejuvenate, resample
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.inference.series import marginal
from bcppl.inference.series.states import merged
from bcppl.traces import Series, extend, generate, update
from bcppl.traces.carried import carried
from tests.inference.series.linear_series import AUTOREGRESSION, SEEN, observed
from tests.invariance import number


def pushed_step(state: dict[str, Tensor], push: float) -> dict[str, Tensor]:
    x = pyro.sample("x", dist.Normal(state["rho"] * state["x"] + push, 0.5))
    pyro.sample("y", dist.Normal(x, 0.5))
    return {**state, "x": x}


def pushed_start() -> dict[str, Tensor]:
    return {
        "rho": pyro.sample("rho", dist.Normal(number(0.0), 1.0)),
        "x": pyro.sample("x", dist.Normal(number(0.0), 1.0)),
    }


def test_other_arguments_of_a_step_are_weighed_by_other_filters() -> None:
    """The estimates of both steps are the new filters': the product is unbiased, its parts alone are not."""
    torch.manual_seed(0)
    program = marginal(Series(pushed_start, pushed_step), "rho", observed="y", particles=20)
    rho, seen = torch.full((20_000,), 0.7, dtype=torch.float64), {"y/1": number(0.5), "y/2": number(2.0)}
    trace, _ = generate(program, ([(0.0,), (0.0,)],), seen, len(rho), {"rho": rho})
    before = trace.log_prob("y/1", "y/2")
    moved = update(trace, args=([(0.0,), (1.0,)],))
    after = moved.trace.log_prob("y/1", "y/2")
    torch.testing.assert_close(moved.log_ratio, after - before)
    # y has the mean (0, push) and x of the first step the variance .7^2 + .25.
    first = 0.49 + 0.25
    covariance = torch.tensor([[first + 0.25, 0.7 * first], [0.7 * first, 0.49 * first + 0.5]]).double()
    for push, estimated in ((0.0, before), (1.0, after)):
        y = torch.tensor([0.5, 2.0 - push], dtype=torch.float64)
        exact = dist.MultivariateNormal(torch.zeros(2).double(), covariance).log_prob(y)
        ratio = (estimated - exact).exp()
        assert abs(float(ratio.mean() - 1.0)) < 4.0 * float(ratio.std()) / math.sqrt(len(rho)), push


def test_two_continuations_of_one_trace_have_estimates_of_their_own() -> None:
    torch.manual_seed(0)
    program = marginal(Series(pushed_start, pushed_step), "rho", observed="y", particles=10)
    trace, _ = generate(program, ([(0.0,)],), {"y/1": number(0.5)}, 50)
    first = trace.log_prob("y/1")
    longer = ([(0.0,), (0.0,)],)
    ends = [extend(trace, longer, {"y/2": number(y)})[1] for y in (2.0, 2.0, -1.0)]
    assert not bool((ends[0] == ends[1]).any()) and not bool((ends[0] == ends[2]).any())
    assert torch.equal(trace.log_prob("y/1"), first)


def test_a_trace_that_is_shortened_goes_on_with_other_filters() -> None:
    torch.manual_seed(0)
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=5)
    trace, _ = generate(program, ([()] * 3,), observed(3), 40)
    short = update(trace, args=([()] * 2,)).trace
    short.log_prob()  # the filters run in the order of the steps
    ends = [extend(short, ([()] * 3,), {"y/3": number(y)})[1] for y in (0.2, 0.2, -1.0)]
    assert not bool((ends[0] == ends[1]).any()) and not bool((ends[0] == trace.log_prob("y/3")).any())


def test_steps_may_observe_other_numbers_of_readings() -> None:
    def read(state: dict[str, Tensor], count: int) -> dict[str, Tensor]:
        pyro.sample("y", dist.Normal(state["rho"][..., None].expand(-1, count), 1.0).to_event(1))
        return state

    program = marginal(Series(pushed_start, read), "rho", observed="y", particles=3)
    seen = {"y/1": torch.tensor([0.1, 0.2]).double(), "y/2": torch.tensor([0.3, 0.4, 0.5]).double()}
    trace, _ = generate(program, ([(2,), (3,)],), seen, 6)
    exact = sum(dist.Normal(trace["rho"][:, None], 1.0).log_prob(y).sum(1) for y in seen.values())
    torch.testing.assert_close(trace.log_prob(*seen), exact)


@pytest.mark.parametrize("kept", [lambda x: x, lambda x: x.numpy()])
def test_states_may_hold_arrays(kept: Any) -> None:
    """As by tensors: those of refused chains stay, so that what a step adds is Kalman's."""
    torch.manual_seed(0)
    one = torch.tensor(1.0, dtype=torch.float64)

    def init() -> dict[str, Any]:
        rho = pyro.sample("rho", dist.Uniform(0.2 * one, 0.95))
        return {"rho": rho, "x": kept(pyro.sample("x", dist.Normal(0.0 * one, 1.0)))}

    def step(state: dict[str, Any]) -> dict[str, Any]:
        x = pyro.sample("x", dist.Normal(state["rho"] * torch.as_tensor(state["x"]), 0.5))
        pyro.sample("y", dist.Normal(x, 0.5))
        return {"rho": state["rho"], "x": kept(x)}

    seen = [1.0, -0.5, 1.5]
    program = marginal(Series(init, step), "rho", observed="y", particles=400)
    observations = {f"y/{t}": torch.tensor(y) for t, y in enumerate(seen[:2], 1)}
    trace, _ = generate(program, ([()] * 2,), observations, 100)
    chains = markov_chains(metropolis_hastings(drift("rho")), trace, 2, progress=False)
    longer, added = extend(chains.trace, ([()] * 3,), {"y/3": torch.tensor(seen[2])})
    rho = longer["rho"]
    mean, variance = torch.zeros(100).double(), torch.ones(100).double()
    for y in seen:
        mean, variance = rho * mean, rho**2 * variance + 0.25
        exact = dist.Normal(mean, (variance + 0.25).sqrt()).log_prob(torch.tensor(y))
        gain = variance / (variance + 0.25)
        mean, variance = mean + gain * (y - mean), variance * (1.0 - gain)
    assert float((added - exact).square().mean().sqrt()) < 0.25


def test_a_state_that_cannot_be_merged_is_refused() -> None:
    mask = torch.tensor([True, False])
    assert merged(mask, ("text", 2, None), ("text", 2, None)) == ("text", 2, None)
    with pytest.raises(InputError, match=r"state holds a set, whose particles .* give it `where"):
        merged(mask, {1}, {2})


@pytest.mark.parametrize("entries", [40, 41])
def test_an_argument_with_as_many_entries_as_there_are_particles_is_no_particle_s_own(entries: int) -> None:
    """Filters go on where particles are resampled and moved, whatever the size of `init`'s arguments."""

    def begin(scales: Tensor) -> dict[str, Tensor]:
        rho = pyro.sample("rho", dist.Uniform(-1.0, 1.0))
        return {"rho": rho, "x": pyro.sample("x", dist.Normal(0.0, scales.mean()))}

    def step(state: dict[str, Tensor]) -> dict[str, Tensor]:
        x = pyro.sample("x", dist.Normal(state["rho"] * state["x"], 1.0))
        pyro.sample("y", dist.Normal(x, 0.3))
        return {"rho": state["rho"], "x": x}

    torch.manual_seed(0)
    program, scales = marginal(Series(begin, step), "rho", observed="y", particles=5), torch.ones(entries)
    seen = {f"y/{t}": torch.tensor(y) for t, y in enumerate((1.5, 1.2, 2.0, 1.0, 2.5), 1)}
    population = resample(importance_sampling(program, ([()] * 5, scales), seen, 40))
    trace = rejuvenate(population, metropolis_hastings(drift("rho"))).trace
    longer, _ = extend(trace, ([()] * 6, scales), {"y/6": torch.tensor(2.0)})
    known = torch.stack([longer.log_prob(address) for address in seen])
    assert torch.equal(longer.distributions["y/6"].filters.increments[:5], known)


def test_a_simulator_that_a_step_carries_goes_on_in_its_filter() -> None:
    """It is begun once for each of the M x N particles, and follows them through all choices and merges."""
    begun: list[int] = []

    class Counter:
        """The pose that a simulator was begun for, and how many steps it has made."""

        def __init__(self, owner: Tensor, steps: Tensor) -> None:
            self.owner, self.steps = owner, steps

        def __getitem__(self, index: Tensor) -> Counter:
            return Counter(self.owner[index], self.steps[index])

        def where(self, mask: Tensor, other: Counter) -> Counter:
            pairs = ((self.owner, other.owner), (self.steps, other.steps))
            return Counter(*(torch.where(mask, a, b) for a, b in pairs))

    def begin() -> dict[str, Tensor]:
        return {"pose": pyro.sample("pose", dist.Normal(number(0.0), 1.0))}

    def probe(state: dict[str, Tensor]) -> dict[str, Tensor]:
        pose = state["pose"]

        def start() -> Counter:
            begun.append(len(pose))
            return Counter(pose, torch.zeros_like(pose))

        counter = carried("probe", start)
        assert torch.equal(counter.owner, pose)
        counter.steps += 1.0
        x = pyro.sample("x", dist.Normal(pose, 1.0))
        pyro.sample("y", dist.Normal(x, 0.5))
        return {"pose": pose, "steps": counter.steps.clone()}

    torch.manual_seed(0)
    program = marginal(Series(begin, probe), "pose", observed="y", particles=6, threshold=1.0)
    trace, _ = generate(program, ([()] * 3,), observed(3), 4)
    # The shape of an observation is read from one run of its own.
    assert begun == [1, 24]
    moved = update(trace, {"pose": trace["pose"] + 0.1}).trace
    moved.log_prob()
    mixed = moved.where(torch.tensor([True, False, True, False]), trace)[torch.tensor([3, 0, 0, 1])]
    before = len(begun)
    longer, _ = extend(mixed, ([()] * 4,), {"y/4": SEEN[3]})
    filters = longer.distributions["y/4"].filters
    assert len(begun) == before and bool((filters.state["steps"] == 4.0).all())

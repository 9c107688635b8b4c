"""Series with static parameters whose states are integrated out: estimates, PMMH and SMC^2."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import (
    Observed,
    importance_sampling,
    markov_chains,
    steps,
    tempered,
)
from bcppl.inference.kernels import hmc, metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import adaptive, always, never, systematic
from bcppl.inference.series import marginal
from bcppl.inference.series.nested import Filters
from bcppl.inference.summaries import mean
from bcppl.inference.targets import POSTERIOR
from bcppl.traces import Series, Trace, assess, generate, gradients, simulate, update
from tests.inference.series.linear_series import (
    AUTOREGRESSION,
    NOISE,
    SEEN,
    log_evidence,
    observed,
    posterior,
    step,
)
from tests.invariance import number

T = 8
STEPS = ([()] * T,)


def nudge(trace: Trace) -> None:
    pyro.sample("rho", dist.Normal(trace["rho"], 0.4))


@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
def test_the_estimated_likelihood_is_unbiased(threshold: float) -> None:
    torch.manual_seed(1)
    rho = torch.tensor([-0.5, 0.3, 0.9], dtype=torch.float64).repeat_interleave(4000)
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=8, threshold=threshold)
    trace, log_weight = generate(program, STEPS, observed(T), len(rho), {"rho": rho})
    ratio = (log_weight - trace.log_prob("rho") - log_evidence(rho, T)).exp().reshape(3, -1)
    z = (ratio.mean(dim=1) - 1.0) / (ratio.std(dim=1) / math.sqrt(4000))
    assert float(z.abs().max()) < 4.0, z
    assert bool((ratio.std(dim=1) > 0.3).all()), "the estimates are random"


@pytest.mark.parametrize("as_tensor", [True, False])
def test_a_step_may_mask_what_was_not_seen(as_tensor: bool) -> None:
    """Without correlation each step is seen by itself: y/1 and y/3 are normal, y/2 says nothing."""

    def masked(state: dict[str, Tensor], seen: bool | Tensor) -> dict[str, Tensor]:
        x = pyro.sample("x", dist.Normal(state["rho"] * state["x"], 1.0))
        pyro.sample("y", dist.Normal(x, NOISE).mask(seen))
        return {"rho": state["rho"], "x": x}

    torch.manual_seed(1)
    rho, y = torch.zeros(4000, dtype=torch.float64), {"y/1": 0.3, "y/2": 50.0, "y/3": 1.0}
    steps = [(torch.tensor(each) if as_tensor else each,) for each in (True, False, True)]
    program = marginal(Series(AUTOREGRESSION.init, masked), "rho", observed="y", particles=8)
    trace, log_weight = generate(program, (steps,), y, 4000, {"rho": rho})
    exact = dist.Normal(0.0, math.sqrt(1.0 + NOISE**2)).log_prob(torch.tensor([0.3, 1.0])).sum()
    ratio = (log_weight - trace.log_prob("rho") - exact).exp()
    assert abs(float((ratio.mean() - 1.0) / (ratio.std() / math.sqrt(4000)))) < 4.0


def advances(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of filters of each step that is run from here on."""
    run: list[int] = []
    advance = Filters._advance

    def counted(self: Filters, *args: Any) -> None:
        run.append(len(self.log_weights))
        advance(self, *args)

    monkeypatch.setattr(Filters, "_advance", counted)
    return run


def test_an_estimate_is_drawn_once_and_stays_with_its_particle(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    inner = marginal(AUTOREGRESSION, "rho", observed="y", particles=5)

    def beside(times: list[tuple[()]]) -> None:
        pyro.sample("other", dist.Normal(number(0.0), 1.0))
        inner(times)

    run = advances(monkeypatch)
    trace, weight = generate(beside, STEPS, observed(T), 6)
    assert run == [6] * T
    torch.testing.assert_close(trace.log_prob(*observed(T)), weight, rtol=0, atol=0)
    index = torch.tensor([4, 4, 0, 5])
    torch.testing.assert_close(trace[index].log_prob(*observed(T)), weight[index], rtol=0, atol=0)
    # What the likelihood does not depend on changes, and so does the parameter of two particles.
    other = update(trace, {"other": trace["other"] + 1.0}).trace
    assert torch.equal(other.log_prob(*observed(T)), weight) and run == [6] * T
    mask = torch.tensor([True, False, True, True, False, True])
    moved = update(other, {"rho": torch.where(mask, other["rho"], 0.1)}).trace
    assert not bool((moved.log_prob(*observed(T)) == weight).any()), "a proposal has new filters"
    mixed = other.where(mask, moved)
    expected = torch.where(mask, weight, moved.log_prob(*observed(T)))
    before = len(run)
    assert torch.equal(mixed.log_prob(*observed(T)), expected)
    # Also where no log-probability was kept: the filters that the trace carries have it.
    mixed.known.clear()
    assert torch.equal(mixed.log_prob(*observed(T)), expected) and len(run) == before


def test_filters_that_are_behind_catch_up_when_traces_are_merged() -> None:
    torch.manual_seed(0)
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=5)
    trace, _ = generate(program, STEPS, observed(T), 4)
    behind = update(trace, {"rho": trace["rho"] * 0.5}).trace
    first = behind.log_prob("y/1")
    mask = torch.tensor([True, False, False, True])
    for mixed, own in ((trace.where(mask, behind), ~mask), (behind.where(mask, trace), mask)):
        mixed.known.clear()
        total = mixed.log_prob(*observed(T))
        assert torch.equal(total[~own], trace.log_prob(*observed(T))[~own])
        assert torch.equal(mixed.log_prob("y/1")[own], first[own])
        torch.testing.assert_close(total[own], behind.log_prob(*observed(T))[own], rtol=0, atol=0)


def chains_of(reestimated: bool, count: int, moves: int) -> Tensor:
    """The parameter after PMMH from exact draws, with few particles, so that estimates are poor."""
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=3)
    grid, chance, _ = posterior(T)
    rho = grid[torch.multinomial(chance, count, replacement=True)]
    trace, _ = generate(program, STEPS, observed(T), count, {"rho": rho})
    move = metropolis_hastings(nudge)(Population(trace))
    for _ in range(moves):
        if reestimated:
            trace, _ = generate(program, STEPS, observed(T), count, {"rho": trace["rho"]})
        trace, _ = move(trace, POSTERIOR)
    return trace["rho"]


def largest(values: Tensor) -> float:
    grid, chance, _ = posterior(T)
    estimates = torch.stack([values, values**2, (values > 0.5).to(torch.float64)])
    exact = torch.stack([grid, grid**2, (grid > 0.5).to(torch.float64)]) @ chance
    return float(
        ((estimates.mean(dim=1) - exact) / (estimates.std(dim=1) / math.sqrt(len(values)))).abs().max()
    )


@pytest.mark.long
def test_pmmh_leaves_the_posterior_and_chains_that_estimate_again_do_not() -> None:
    torch.manual_seed(3)
    assert largest(chains_of(False, 3000, 25)) < 4.0
    assert largest(chains_of(True, 3000, 25)) > 6.0


def test_pmmh_by_shipped_kernels_reaches_the_posterior() -> None:
    torch.manual_seed(2)
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=30)
    trace, _ = generate(program, STEPS, observed(T), 200)
    kernel = metropolis_hastings(drift("rho", (0.5, 2.0)))
    chains = markov_chains(kernel, trace, 30, every=30, progress=False)
    assert largest(chains.draws["rho"][-1]) < 4.0
    assert 0.2 < float(chains.acceptance.mean()) < 0.8


def smc_squared(seed: int, resample: Any, thetas: int = 60) -> tuple[float, float]:
    torch.manual_seed(seed)
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=10)
    population = importance_sampling(program, ([],), {}, thetas)
    seen = [Observed(([()] * t,), {f"y/{t}": SEEN[t - 1]}) for t in range(1, T + 1)]
    kernel = None if resample is never else metropolis_hastings(nudge)
    step = tempered(kernel, sweeps=1, resample=resample, exponents=[1.0], always_move=kernel is not None)
    *_, last = steps(step, population, seen)
    return last.population.log_evidence, float(mean(last.population, "rho"))


@pytest.mark.long
@pytest.mark.parametrize("resample", [never, adaptive(systematic, 0.9)], ids=["never", "adaptive"])
def test_smc_over_the_steps_is_smc_squared(resample: Any) -> None:
    grid, chance, exact = posterior(T)
    runs = torch.tensor([smc_squared(seed, resample) for seed in range(12)], dtype=torch.float64)
    ratio = (runs[:, 0] - exact).exp()
    assert abs(float((ratio.mean() - 1.0) / (ratio.std() / math.sqrt(len(runs))))) < 4.0
    assert float(ratio.std()) < 0.5
    off = runs[:, 1] - grid @ chance
    assert abs(float(off.mean() / (off.std() / math.sqrt(len(runs))))) < 4.0
    assert float(off.std()) < 0.15


def test_increments_may_be_tempered_and_evidence_is_kept_by_windows() -> None:
    """The same filters go on: SMC after five steps at once equals the sum of the increments."""
    torch.manual_seed(0)
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=10)
    begun = importance_sampling(program, ([],), {}, 50)
    stepping = tempered(metropolis_hastings(nudge), resample=always(), share=0.9)
    seen = [Observed(([()] * 5,), observed(5)), Observed(([()] * 6,), {"y/6": SEEN[5]})]
    for population, info in steps(stepping, begun, seen):
        assert len(info.exponents) > 1 or len(population.trace.observations) == 6
        filters = population.trace.distributions["y/1"].filters
        total = filters.increments.sum(dim=0)
        names = [a for a in population.trace.addresses if a != "rho"]
        torch.testing.assert_close(population.trace.log_prob(*names), total, rtol=0, atol=1e-12)


def in_a_plate() -> dict[str, Tensor]:
    scale = pyro.sample("scale", dist.LogNormal(number(0.0), 0.3))
    with pyro.plate("sites", 2):
        x = pyro.sample("x", dist.Normal(number(0.0), scale))
    return {"scale": scale, "x": x.movedim(-1, 0)}


def plated_step(state: dict[str, Tensor]) -> dict[str, Tensor]:
    with pyro.plate("sites", 2):
        x = pyro.sample("x", dist.Normal(state["x"].movedim(0, -1), state["scale"]))
        pyro.sample("y", dist.Normal(x, 1.0))
    return {"scale": state["scale"], "x": x.movedim(-1, 0)}


def test_observations_in_a_plate() -> None:
    torch.manual_seed(0)
    program = marginal(Series(in_a_plate, plated_step), "scale", observed="y", particles=50)
    y = torch.tensor([0.3, -1.0], dtype=torch.float64)
    scale = torch.ones(2000, dtype=torch.float64)
    trace, weight = generate(program, ([()],), {"y/1": y}, 2000, {"scale": scale})
    exact = dist.Normal(number(0.0), math.sqrt(3.0)).log_prob(y).sum()
    ratio = (weight - trace.log_prob("scale") - exact).exp()
    assert abs(float((ratio.mean() - 1.0) / (ratio.std() / math.sqrt(2000)))) < 4.0


def test_a_parameter_out_of_its_support_runs_no_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    def begin() -> dict[str, Tensor]:
        rho = pyro.sample("rho", dist.Uniform(number(-1.0), number(1.0)))
        return {"rho": rho, "x": pyro.sample("x", dist.Normal(number(0.0), 1.0 / (1.0 - rho**2).sqrt()))}

    program = marginal(Series(begin, step), "rho", observed="y", particles=5)
    trace, _ = generate(program, STEPS, observed(T), 4)
    run = advances(monkeypatch)

    def out(trace: Trace) -> None:
        pyro.sample("rho", dist.Normal(torch.tensor([0.2, 1.7, -3.0, 0.1], dtype=torch.float64), 1e-3))

    _, accepted = metropolis_hastings(out)(Population(trace))(trace, POSTERIOR)
    assert run == [2] * T and not bool(accepted[1:3].any())


def test_refusals_say_what_to_do() -> None:
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=5)
    trace, _ = generate(program, STEPS, observed(T), 3)
    with pytest.raises(InputError, match="given no static parameter"):
        marginal(AUTOREGRESSION, observed="y", particles=5)
    with pytest.raises(InputError, match="0 particles"):
        marginal(AUTOREGRESSION, "rho", observed="y", particles=0)
    with pytest.raises(InputError, match="samples no static parameter 'phi'"):
        generate(marginal(AUTOREGRESSION, "phi", observed="y", particles=5), STEPS, {}, 3)
    with pytest.raises(InputError, match="visits no observation 'z'; it visits x, y"):
        generate(marginal(AUTOREGRESSION, "rho", observed="z", particles=5), STEPS, {}, 3)
    with pytest.raises(InputError, match=r"simulate `unrolled\(series\)`"):
        simulate(program, STEPS, 3)
    with pytest.raises(InputError, match="'y/2' of a series has no value"):
        generate(program, STEPS, {"y/1": number(0.1)}, 3)
    with pytest.raises(InputError, match=r"'y/1' of a series is given with shape \(3,\)"):
        assess(program, ([()],), {"rho": trace["rho"], "y/1": torch.ones(3).double()}, 3)
    with pytest.raises(InputError, match="is another than the filters have assimilated"):
        update(trace, observations={"y/2": number(0.1)}).trace.log_prob("y/2")
    with pytest.raises(InputError, match="ask for the steps in order"):
        update(trace, {"rho": trace["rho"] * 0.5}).trace.log_prob("y/3")
    with pytest.raises(InputError, match="runs a simulator"):
        markov_chains(hmc("rho"), trace, 1, progress=False)


def test_what_init_conditions_on_is_weighed() -> None:
    """All normal given the scale: the mean of the estimates is exact, with an observation and a factor."""
    torch.manual_seed(0)
    count, scale = 4000, 1.3

    def begin() -> dict[str, Tensor]:
        s = pyro.sample("s", dist.LogNormal(number(0.0), 1.0))
        x = pyro.sample("x", dist.Normal(number(0.0), s))
        pyro.sample("first", dist.Normal(x, 0.5), obs=number(1.1))
        pyro.factor("known", number(-0.7).expand(x.shape))
        return {"s": s, "x": x}

    def walk(state: dict[str, Tensor]) -> dict[str, Tensor]:
        x = pyro.sample("x", dist.Normal(state["x"], 1.0))
        pyro.sample("y", dist.Normal(x, 0.5))
        return {"s": state["s"], "x": x}

    program = marginal(Series(begin, walk), "s", observed="y", particles=20)
    seen, values = {"y/1": number(0.4)}, torch.full((count,), scale, dtype=torch.float64)
    trace, weight = generate(program, ([()],), seen, count, {"s": values})
    covariance = torch.tensor([[scale**2 + 0.25, scale**2], [scale**2, scale**2 + 1.25]]).double()
    joint = dist.MultivariateNormal(torch.zeros(2).double(), covariance)
    exact = joint.log_prob(torch.tensor([1.1, 0.4]).double()) - 0.7
    ratio = (weight - trace.log_prob("s") - exact).exp()
    assert abs(float((ratio.mean() - 1.0) / (ratio.std() / math.sqrt(count)))) < 4.0


def hierarchical() -> dict[str, Tensor]:
    tau = pyro.sample("tau", dist.LogNormal(number(0.0), 0.5))
    rho = pyro.sample("rho", dist.Normal(number(0.0), tau))
    return {"rho": rho, "x": pyro.sample("x", dist.Normal(number(0.0), 1.0))}


def test_a_parameter_that_depends_on_what_is_integrated_out_is_refused() -> None:
    series, given = Series(hierarchical, step), {"rho": number(0.5).expand(4)}
    with pytest.raises(InputError, match=r"'rho' depends on others .*\(tau, x\).* name them as static too"):
        generate(marginal(series, "rho", observed="y", particles=5), STEPS, observed(T), 4, given)
    generate(marginal(series, "rho", "tau", observed="y", particles=5), STEPS, observed(T), 4, given)


def test_a_gradient_of_what_filters_estimate_is_refused() -> None:
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=5)
    with gradients(), pytest.raises(InputError, match="pass no gradient on"):
        generate(program, ([()],), observed(1), 3)


def test_shapes_may_differ_from_call_to_call_with_what_init_and_step_are_given() -> None:
    """`init` draws vectors of a length that is an argument; a step sees those that a map names."""

    def init(length: int) -> Tensor:
        rho = pyro.sample("rho", dist.Beta(torch.tensor(2.0).double(), 2.0))
        return rho[:, None].expand(-1, length)

    def step(state: Tensor, seen: dict[str, Tensor]) -> Tensor:
        pyro.sample("y", dist.Normal(state[:, seen["which"]], 1.0).to_event(1))
        return state

    program = marginal(Series(init, step), "rho", observed="y", particles=4)
    for length, which in ((2, [0, 1]), (3, [0, 1, 2]), (3, [1])):
        values = {"y/1": torch.zeros(len(which), dtype=torch.float64)}
        _, log_weights = generate(program, ([({"which": torch.tensor(which)},)], length), values, 5)
        assert bool(torch.isfinite(log_weights).all())


def test_a_number_of_steps_is_no_list_of_them() -> None:
    program = marginal(AUTOREGRESSION, "rho", observed="y", particles=4)
    for given in (3, [1, 2]):
        with pytest.raises(InputError, match=r"give a list of the arguments of each step"):
            generate(program, (given,), {}, 5)

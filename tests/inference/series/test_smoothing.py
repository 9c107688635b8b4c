"""Backward sampling against Kalman's smoother, enumeration, and the program's own density of a path."""

from __future__ import annotations

import math
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import Observed, Population, importance_sampling, steps, tempered
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import adaptive, always, never
from bcppl.inference.series import smooth, smoothing, unrolled
from bcppl.inference.series.states import same
from bcppl.traces import Series, extend, generate
from tests.inference.series.linear_series import (
    AUTOREGRESSION,
    SEEN,
    SYMBOLS,
    hmm,
    hmm_smoothed,
    observed,
    smoothed,
    with_known,
)

T = 20
RHO = 0.9


def filtered(series: Series, particles: int, count: int = T, **options: Any) -> list[Population]:
    begun = importance_sampling(series, (), {}, particles)
    seen = [Observed((), {"y": y}) for y in SEEN[:count]]
    return [begun, *(each for each, _ in steps(tempered(share=0.0, **options), begun, seen))]


def runs(seeds: int, **options: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and mean square of the smoothed path in each run, (S, T + 1)."""
    first, second = [], []
    for seed in range(seeds):
        torch.manual_seed(seed)
        paths = smooth(filtered(with_known(RHO), 200, **options), 200)
        x = torch.stack([paths["x", t] for t in range(T + 1)])
        first.append(x.mean(dim=1))
        second.append((x[1:] * x[:-1]).mean(dim=1))
    return torch.stack(first), torch.stack(second)


def z_of(estimates: torch.Tensor, exact: torch.Tensor) -> torch.Tensor:
    return (estimates.mean(dim=0) - exact) / (estimates.std(dim=0) / math.sqrt(len(estimates)))


@pytest.mark.long
@pytest.mark.parametrize("resample", [never, adaptive(), always()], ids=["never", "adaptive", "always"])
def test_paths_are_those_of_kalmans_smoother(resample: Any) -> None:
    count = 5 if resample is never else T
    mean, covariance = smoothed(RHO, count)
    first, second = [], []
    for seed in range(12):
        torch.manual_seed(seed)
        paths = smooth(filtered(with_known(RHO), 200, count, resample=resample), 200)
        x = torch.stack([paths["x", t] for t in range(count + 1)])
        first.append(x.mean(dim=1))
        second.append((x[1:] * x[:-1]).mean(dim=1))
    assert float(z_of(torch.stack(first), mean).abs().max()) < 5.0
    products = covariance.diagonal(1) + mean[1:] * mean[:-1]
    assert float(z_of(torch.stack(second), products).abs().max()) < 5.0


def test_without_the_density_of_the_step_the_paths_are_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    extend = smoothing.extend

    def flat(*given: Any) -> Any:
        longer, weight = extend(*given)
        return longer, torch.zeros_like(weight)

    monkeypatch.setattr(smoothing, "extend", flat)
    mean, covariance = smoothed(RHO, T)
    products = covariance.diagonal(1) + mean[1:] * mean[:-1]
    first, second = runs(6)
    assert float(z_of(second, products).abs().max()) > 15.0 and float(z_of(first, mean).abs().max()) > 8.0


def test_discrete_paths_have_the_enumerated_probabilities() -> None:
    shares = []
    for seed in range(8):
        torch.manual_seed(seed)
        begun = importance_sampling(hmm(), (), {}, 400)
        seen = [Observed((), {"y": symbol}) for symbol in SYMBOLS]
        all_of = [begun, *(each for each, _ in steps(tempered(share=0.0), begun, seen))]
        paths = smooth(all_of, 400)
        hot = [torch.bincount(paths["z", t].long(), minlength=3) / 400 for t in range(1, 5)]
        shares.append(torch.stack(hot).double())
    z = z_of(torch.stack(shares).flatten(1), hmm_smoothed().flatten())
    assert float(z.abs().max()) < 5.0


def test_moved_particles_and_series_without_history_are_smoothed() -> None:
    series = with_known(RHO)
    short = Series(series.init, series.step, history=False)
    kernel = metropolis_hastings(drift("x"))
    mean, _ = smoothed(RHO, 10)
    estimates = []
    for seed in range(5):
        torch.manual_seed(seed)
        paths = smooth(filtered(short, 60, 10, kernel=kernel, resample=always()), 60)
        assert paths.steps == 10 and len(paths) == 60
        estimates.append(paths["x"].mean())
    off = torch.stack(estimates) - mean[-1]
    assert abs(float(off.mean() / (off.std() / math.sqrt(5)))) < 5.0
    whole = smooth(filtered(series, 50), 20)
    values = {"x": whole["x", 0]} | {f"x/{t}": whole["x", t] for t in range(1, T + 1)}
    reference, _ = generate(unrolled(series), ([()] * T,), observed(T), 20, values)
    torch.testing.assert_close(whole.log_prob(), reference.log_prob())


def test_a_static_parameter_stays_that_of_its_path() -> None:
    torch.manual_seed(0)
    populations = filtered(AUTOREGRESSION, 100, 6)
    paths = smooth(populations, 400)
    assert torch.equal(paths.state["rho"], paths["rho", 0])
    last = populations[-1].trace
    assert set(paths["rho", 0].tolist()) <= set(last["rho", 0].tolist())


def test_smoothing_in_blocks_draws_from_the_same_distribution(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    populations = filtered(with_known(RHO), 100)
    whole = smooth(populations, 600)
    monkeypatch.setattr(smoothing, "PAIRS", 10_000)
    torch.manual_seed(1)
    blocks = smooth(populations, 600)
    for t in (0, 10, 20):
        a, b = whole["x", t], blocks["x", t]
        assert abs(float((a.mean() - b.mean()) / ((a.var() + b.var()) / 600).sqrt())) < 4.0


def test_smoothing_finds_what_ancestors_have_lost() -> None:
    torch.manual_seed(0)
    populations = filtered(with_known(RHO), 100, resample=always())
    traced, drawn = populations[-1].trace["x", 1], smooth(populations, 100)["x", 1]
    assert len(traced.unique()) < 0.5 * len(drawn.unique())


def test_in_single_precision_paths_go_through_their_own_ancestors() -> None:
    """A height near 1000 whose last value is seen to 5 mm, after steps of 2 cm: exact mean 0.2499 above."""
    torch.manual_seed(0)
    zero, above = torch.tensor(0.0), 1000.0

    def init() -> dict[str, Tensor]:
        speed = pyro.sample("v", dist.Normal(zero, 0.02))
        return {"height": above + 0.0 * speed, "speed": speed}

    def step(state: dict[str, Tensor], noise: float) -> dict[str, Tensor]:
        speed = pyro.sample("v", dist.Normal(state["speed"], 0.02))
        height = state["height"] + speed
        pyro.sample("y", dist.Normal(height, noise))
        return {"height": height, "speed": speed}

    population = Population(*generate(Series(init, step), (), {}, 1000))
    seen = [population]
    for t in range(1, 7):
        noise, value = (0.005, 0.25) if t == 6 else (100.0, 0.0)
        trace, log_factor = extend(population.trace, (noise,), {"y": torch.tensor(above + value)})
        population = population.with_trace(trace).reweighed(log_factor)
        seen.append(population)
    height = smooth(seen, 300).state["height"].double() - above
    assert abs(float(height.mean()) - 0.2499) < 0.002 and float(height.std()) < 0.008


def test_refusals_say_what_to_do() -> None:
    populations = filtered(with_known(RHO), 5, 3)
    with pytest.raises(InputError, match="after 3 steps behind one after 1"):
        smooth([populations[1], populations[3]], 2)
    with pytest.raises(InputError, match="no populations of a series"):
        smooth([], 2)
    with pytest.raises(InputError, match="0 draws"):
        smooth(populations, 0)


class Held:
    """A state of a class of one's own."""

    def __init__(self, x: Tensor, k: Tensor) -> None:
        self.x, self.k, self.shared = x, k, torch.ones(3)

    def __getitem__(self, index: Tensor) -> Held:
        return Held(self.x[index], self.k[index])

    def where(self, mask: Tensor, other: Held) -> Held:
        return Held(torch.where(mask, self.x, other.x), torch.where(mask, self.k, other.k))


def test_what_objects_of_a_state_hold_is_compared() -> None:
    """The last observation tells k, which no step changes: paths of the other k do not lead there."""

    def begin() -> Held:
        k = pyro.sample("k", dist.Bernoulli(torch.tensor(0.5).double()))
        return Held(pyro.sample("x", dist.Normal(torch.zeros(()).double(), 1.0)), k)

    def step(state: Held, use: float) -> Held:
        x = pyro.sample("x", dist.Normal(0.5 * state.x, 1.0))
        pyro.sample("y", dist.Normal(6.0 * use * state.k + x, 0.5))
        return Held(x, state.k)

    torch.manual_seed(0)
    begun = importance_sampling(Series(begin, step), (), {}, 200)
    seen = [Observed((use,), {"y": torch.tensor(y).double()}) for y, use in ((0.0, 0.0), (6.0, 1.0))]
    populations = [begun, *(each.population for each in steps(tempered(share=0.0), begun, seen))]
    assert float(smooth(populations, 300)["k", 0].mean()) > 0.99


def test_an_object_that_cannot_be_compared_is_refused() -> None:
    class Slots:
        __slots__ = ("x",)

        def __getitem__(self, index: Tensor) -> Slots:
            return self

    assert bool(same([torch.float64, None, "a"], [torch.float64, None, "a"], 3).all()), "of no particle"
    with pytest.raises(InputError, match="a Slots, whose particles cannot be compared"):
        same({"x": torch.zeros(3), "own": Slots()}, {"x": torch.zeros(3), "own": Slots()}, 3)

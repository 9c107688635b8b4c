"""Auxiliary particle filters: unbiased evidence, and less of its variance than the bootstrap filter's."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import InputError
from bcppl.inference import Observed, importance_sampling, steps
from bcppl.inference.resampling import adaptive, always, never
from bcppl.inference.series import auxiliary
from bcppl.traces import Series, Trace
from tests.inference.series.linear_series import NOISE, SEEN, log_evidence, with_known
from tests.invariance import number

RHO, T = 0.9, 12
PREDICTED = math.sqrt(1.0 + NOISE**2)
EXACT = float(log_evidence(number(RHO), T))


def ahead(trace: Trace, observed: Observed) -> Tensor:
    return dist.Normal(RHO * trace["x"], PREDICTED).log_prob(observed.observations["y"])


def vague(trace: Trace, observed: Observed) -> Tensor:
    return dist.StudentT(3.0, 0.5 * trace["x"], 2.0).log_prob(observed.observations["y"])


def optimal(trace: Trace, observed: Observed) -> None:
    gain = 1.0 / (1.0 + NOISE**2)
    mean = RHO * trace["x"] + gain * (observed.observations["y"] - RHO * trace["x"])
    pyro.sample("x", dist.Normal(mean, math.sqrt(1.0 - gain)))


def wide(trace: Trace, observed: Observed) -> None:
    pyro.sample("x", dist.Normal(0.5 * (trace["x"] + observed.observations["y"]), 1.5))


def log_ratios(step: Any, particles: int, seeds: int) -> Tensor:
    """Log Z-hat / Z of several runs."""
    estimates = []
    for seed in range(seeds):
        torch.manual_seed(seed)
        begun = importance_sampling(with_known(RHO), (), {}, particles)
        *_, last = steps(step, begun, [Observed((), {"y": y}) for y in SEEN[:T]])
        estimates.append(last.population.log_evidence - EXACT)
    return torch.tensor(estimates, dtype=torch.float64)


def z_of_mean(log_ratio: Tensor) -> float:
    ratio = log_ratio.exp()
    return float((ratio.mean() - 1.0) / (ratio.std() / math.sqrt(len(ratio))))


CASES: dict[str, Callable[[], Any]] = {
    "bootstrap": lambda: auxiliary(),
    "vague look": lambda: auxiliary(look_ahead=vague, resample=always()),
    "wide proposal": lambda: auxiliary(wide, resample=adaptive(threshold=0.7)),
    "both": lambda: auxiliary(wide, look_ahead=vague),
    "never": lambda: auxiliary(wide, look_ahead=vague, resample=never),
}


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_evidence_is_unbiased(case: str) -> None:
    particles = 200 if case == "never" else 30
    assert abs(z_of_mean(log_ratios(CASES[case](), particles, 60))) < 4.0


def test_the_fully_adapted_filter_has_equal_weights() -> None:
    torch.manual_seed(0)
    population = importance_sampling(with_known(RHO), (), {}, 50)
    step = auxiliary(optimal, look_ahead=ahead, resample=always())
    for y in SEEN[:T]:
        population, info = step(population, Observed((), {"y": y}))
        assert info.effective_sample_size == pytest.approx(50.0) and info.resampled == 1


@pytest.mark.long
def test_looking_ahead_and_optimal_proposals_lower_the_variance_of_the_evidence() -> None:
    bootstrap = log_ratios(auxiliary(), 50, 40).var()
    guided = log_ratios(auxiliary(optimal), 50, 40).var()
    adapted = log_ratios(auxiliary(optimal, look_ahead=ahead), 50, 40).var()
    assert float(guided) < 0.6 * float(bootstrap) and float(adapted) < 0.6 * float(bootstrap)


def test_a_wrong_weight_is_seen() -> None:
    """A proposal whose density is not divided by: wider than the program's, it loses evidence."""

    def unweighed(population: Any, observed: Observed) -> Any:
        right, info = auxiliary(wide)(population, observed)
        spread = dist.Normal(0.5 * (population.trace["x"] + observed.observations["y"]), 1.5)
        return right.reweighed(spread.log_prob(right.trace["x"]) if info.ancestors is None else 0.0), info

    assert abs(z_of_mean(log_ratios(unweighed, 30, 20))) > 5.0


def test_refusals_say_what_to_do() -> None:
    population = importance_sampling(with_known(RHO), (), {}, 5)
    with pytest.raises(InputError, match="samples no address"):
        auxiliary(lambda trace, observed: None)(population, Observed((), {"y": SEEN[0]}))
    with pytest.raises(InputError, match="does not define when to resample"):
        from bcppl.inference.resampling import systematic

        auxiliary(resample=systematic)  # type: ignore[arg-type]


def test_a_prediction_that_rules_particles_out_takes_their_weight() -> None:
    """Where they are impossible indeed, the estimate is that without a prediction, draw for draw."""

    def step(x: Tensor) -> Tensor:
        x = pyro.sample("x", dist.Uniform(x - 1.0, x + 1.0))
        pyro.sample("y", dist.Uniform(x - 1.0, x + 1.0))
        return x

    def possible(trace: Trace, observed: Observed) -> Tensor:
        near = (observed.observations["y"] - trace["x"]).abs() < 2.0
        return torch.where(near, 0.0, -torch.inf).double()

    series = Series(lambda: pyro.sample("x", dist.Normal(number(0.0), 2.0)), step)
    found = []
    for predict in (None, possible):
        torch.manual_seed(0)
        begun = importance_sampling(series, (), {}, 500)
        filters = auxiliary(look_ahead=predict, resample=never)
        *_, last = steps(filters, begun, [Observed((), {"y": number(1.5)})])
        found.append(last.population.log_evidence)
    assert found[0] == pytest.approx(found[1], abs=1e-12)

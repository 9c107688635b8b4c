"""SMC: resampling, tempering, evidence that is unbiased, and runs that can be had again bit for bit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from importlib.resources import files
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.errors import NoWeightError
from bcppl.inference.filters import bayes_contact, smcp3, tempered_smc
from bcppl.inference.filters.smc import Step, smc
from bcppl.inference.filters.step import Observed, StepFunction, StepInfo
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import adaptive, always, never, systematic
from bcppl.models.point_probe import model
from bcppl.recordings import Recording, load
from bcppl.traces import Trace, generate, update as real_update
from bcppl.traces.verbs import assessed
from tests import few_moves


def number(value: float) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


# ---- evidence: the mean of the estimate over the truth is 1

OBSERVED = [0.8, -0.3, 1.9]
NOISE = 0.6


def static(steps: int) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    for k in range(steps):
        pyro.sample(f"y_{k}", dist.Normal(x, NOISE))


def static_evidence() -> float:
    y = torch.tensor(OBSERVED, dtype=torch.float64)
    covariance = torch.ones(3, 3, dtype=torch.float64) + NOISE**2 * torch.eye(3, dtype=torch.float64)
    return float(torch.distributions.MultivariateNormal(torch.zeros(3).double(), covariance).log_prob(y))


TRANSITION = torch.tensor([[0.4, 0.4, 0.2], [0.2, 0.3, 0.5], [0.9, 0.05, 0.05]], dtype=torch.float64)
EMISSION = torch.tensor([[0.1, 0.2, 0.7], [0.2, 0.7, 0.1], [0.7, 0.2, 0.1]], dtype=torch.float64)
HIDDEN_SEEN = [0, 0, 1, 2]


def hidden_markov(steps: int) -> None:
    """Gen.jl's particle filter test."""
    state = pyro.sample("z_0", dist.Categorical(torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)))
    for k in range(steps):
        if k:
            state = pyro.sample(f"z_{k}", dist.Categorical(TRANSITION[state]))
        pyro.sample(f"y_{k}", dist.Categorical(EMISSION[state]))


def ratios(
    program: Callable[[int], None],
    values: list[Tensor],
    exact: float,
    take: StepFunction,
    runs: int,
    particles: int,
) -> np.ndarray[Any, Any]:
    """Zhat / Z of many runs."""
    found = []
    for seed in range(runs):
        torch.manual_seed(seed)
        population = Population(*generate(program, (0,), {}, particles))
        for k, value in enumerate(values):
            population = take(population, Observed((k + 1,), {f"y_{k}": value})).population
        found.append(math.exp(population.log_evidence - exact))
    return np.array(found)


def standard_errors(found: np.ndarray[Any, Any]) -> float:
    """How far from 1 the mean is, in its own standard errors."""
    return float(abs(found.mean() - 1) / (found.std(ddof=1) / math.sqrt(len(found))))


def fixed_drift(trace: Trace) -> None:
    """A proposal that learns nothing and is not symmetric."""
    pyro.sample("x", dist.Normal(0.9 * trace["x"] + 0.1, 0.4))


def kept_weights(population: Population) -> tuple[Population, Tensor | None]:
    """Mutant: resampled particles keep their weights."""
    ancestors = systematic(population.log_weights)
    trace = population.trace[ancestors]
    return Population(trace, population.log_weights[ancestors], population.log_evidence), ancestors


SCHEMES = {"never": never, "always": always(), "adaptive": adaptive(systematic, 0.7)}


@pytest.mark.long
@pytest.mark.parametrize("scheme", SCHEMES)
def test_evidence_is_unbiased_with_fixed_exponents(scheme: str) -> None:
    values = [number(y) for y in OBSERVED]
    take = tempered(
        metropolis_hastings(fixed_drift),
        sweeps=1,
        resample=SCHEMES[scheme],
        exponents=(0.5, 1.0),
        always_move=True,
    )
    found = ratios(static, values, static_evidence(), take, 40, 200)
    assert standard_errors(found) < 4
    assert 0.01 < found.std() < 0.6


def test_mutant_that_keeps_weights_when_resampling(monkeypatch: pytest.MonkeyPatch) -> None:
    values = [number(y) for y in OBSERVED]
    take = tempered(None, resample=kept_weights, share=0.0)
    assert standard_errors(ratios(static, values, static_evidence(), take, 60, 200)) > 8


@pytest.mark.long
@pytest.mark.parametrize("scheme", SCHEMES)
def test_hidden_markov_model(scheme: str) -> None:
    take = tempered(None, resample=SCHEMES[scheme], share=0.0)
    values = [torch.tensor(y) for y in HIDDEN_SEEN]
    found = ratios(hidden_markov, values, -4.8764508, take, 50, 400)
    assert standard_errors(found) < 4
    # The resolution of this test: a hundredth of Z.
    assert found.std(ddof=1) / math.sqrt(len(found)) < 0.015


# ---- BayesContact's own filter


@pytest.mark.long
def test_the_baseline_weighs_by_all_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    values = [number(y) for y in OBSERVED]
    for fit, resample in ((fixed_drift, always()), (drift("x", (0.2, 0.21)), adaptive())):
        found = ratios(
            static, values, static_evidence(), smcp3.smcp3(smcp3.Pair(fit, fit), resample=resample), 40, 300
        )
        assert standard_errors(found) < 4
        assert found.std() < 0.8

    @dataclasses.dataclass
    class PriorOnly:
        """Mutant, the paper's weight taken literally: the past likelihoods are left out."""

        trace: Trace
        previous: Trace
        discarded: Any

        @property
        def log_ratio(self) -> Tensor:
            new = [a for a in self.trace.observations if a not in self.previous.observations]
            gained = self.trace.log_prob(*new) if new else torch.zeros(self.trace.particles)
            return self.trace.log_prob("x") - self.previous.log_prob("x") + gained

    def mutant(trace: Trace, *given: Any, **named: Any) -> PriorOnly:
        updated = real_update(trace, *given, **named)
        return PriorOnly(updated.trace, updated.previous, updated.discarded)

    monkeypatch.setattr(smcp3, "update", mutant)
    take = smcp3.smcp3(smcp3.Pair(fixed_drift, fixed_drift), resample=always())
    assert standard_errors(ratios(static, values, static_evidence(), take, 60, 300)) > 8


def test_mutant_of_the_baseline_without_the_way_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(*args: Any) -> Trace:
        trace = assessed(*args)
        trace.known.update({a: torch.zeros(len(trace), dtype=torch.float64) for a in trace.addresses})
        return trace

    monkeypatch.setattr(smcp3, "assessed", silent)
    values = [number(y) for y in OBSERVED]
    take = smcp3.smcp3(smcp3.Pair(fixed_drift, fixed_drift), resample=always())
    # A few huge ratios make the mean's own error huge: it is the median that gives this one away.
    assert np.median(ratios(static, values, static_evidence(), take, 50, 100)) > 4


# ---- runs that can be had again


@pytest.fixture(scope="module")
def recording() -> Recording:
    whole = load(files("bcppl.models") / "recordings/point_probe_10_pushes.h5")  # type: ignore[arg-type]
    return dataclasses.replace(whole, measurements=whole.measurements[:2])


def same(first: list[Step], second: list[Step]) -> bool:
    return len(first) == len(second) and all(
        torch.equal(a.belief.world_from_part, b.belief.world_from_part)
        and torch.equal(a.belief.log_weights, b.belief.log_weights)
        and torch.equal(a.random_state, b.random_state)
        and a.info.log_evidence == b.info.log_evidence
        for a, b in zip(first, second, strict=True)
    )


@pytest.mark.parametrize("infer", [few_moves.infer, bayes_contact.infer], ids=["tempered", "drifting"])
def test_the_same_seed_gives_the_same_beliefs_however_the_run_is_interrupted(
    infer: Callable[..., Iterator[Step]], recording: Recording
) -> None:
    torch.manual_seed(5)
    state = torch.get_rng_state()
    first = list(infer(model, recording, particles=8, seed=3))
    assert torch.equal(state, torch.get_rng_state()), "the caller's random state is left as it was"
    np.random.seed(1)
    assert not same(first, list(infer(model, recording, particles=8, seed=4)))

    # Stopped half way and gone on with, another run in between; whether the truth is known changes nothing.
    iterator = infer(model, dataclasses.replace(recording, truth=None), particles=8, seed=3)
    torch.manual_seed(11)
    pieces = [next(iterator), next(iterator)]
    outside = torch.rand(3)
    other = infer(model, recording, particles=4, seed=9)
    next(other), next(other)
    pieces += list(iterator)
    assert same(first, pieces)
    torch.manual_seed(11)
    assert torch.equal(outside, torch.rand(3)), "a run does not draw from the caller's generator"


def test_an_error_names_the_measurement(recording: Recording) -> None:
    def impossible(scene: Any, actions: Any) -> None:
        part = pyro.sample("part", scene.prior)
        for k, _ in enumerate(actions):
            pyro.sample(f"onset_{k}", dist.Uniform(part[:, 0] + 5.0 * (k == 1), part[:, 0] + 9.0))

    def observe(scene: Any, measurements: Any) -> dict[str, Tensor]:
        return {f"onset_{k}": number(3.0) for k in range(len(measurements))}

    broken = dataclasses.replace(model, program=impossible, observe=observe)
    for infer in (tempered_smc.infer, bayes_contact.infer):
        seen = []
        state = torch.get_rng_state()
        with pytest.raises(NoWeightError, match=r"^push 2: no particle has any weight left"):
            seen.extend(infer(broken, recording, particles=20))
        assert torch.equal(state, torch.get_rng_state())
    iterator = smc(broken, recording, step=tempered(None, resample=never, share=0.0), particles=20)
    with pytest.raises(NoWeightError, match=r"^push 2: no particle"):
        list(iterator)


def test_a_particle_without_weight_does_not_come_back_as_not_a_number() -> None:
    """BayesContact's filter drifts particles out of a bounded prior and back: weights stay numbers."""

    def bounded(count: int) -> None:
        one = torch.tensor(1.0, dtype=torch.float64)
        x = pyro.sample("x", dist.Uniform(-one, one))
        for k in range(count):
            pyro.sample(f"y_{k}", dist.Normal(x, 10.0))

    torch.manual_seed(0)
    trace, weights = generate(bounded, (0,), {}, 400)
    population = Population(trace, weights)
    take = smcp3.smcp3(smcp3.Pair(fixed_drift, fixed_drift), resample=never)
    for k in range(4):
        population, *_ = take(population, Observed((k + 1,), {f"y_{k}": number(0.0)}))
        assert not bool(torch.isnan(population.log_weights).any())
    assert bool((population.log_weights == -torch.inf).any())


def test_what_happened_prints_in_a_line_however_many_particles_there_are() -> None:
    info = StepInfo(ancestors=torch.arange(10_000) // 4, exponents=(0.5, 1.0), log_evidence=-3.123456)
    assert "ancestors=<2500 of 10000>" in repr(info) and "log_evidence=-3.123," in repr(info)
    assert len(repr(info)) < 200 and "ancestors" not in repr(StepInfo())

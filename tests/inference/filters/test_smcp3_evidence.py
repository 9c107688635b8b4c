"""SMCP3 with new measurements: the mean of the estimated evidence over the true one is 1."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.inference import guided_smc, importance_sampling, observations_of
from bcppl.inference.filters import smcp3
from bcppl.inference.filters.smcp3 import Pair
from bcppl.inference.filters.step import Observed
from bcppl.inference.population import Population
from bcppl.inference.proposals import Fittable
from bcppl.inference.resampling import adaptive, always, never, systematic
from bcppl.models import load_recording, look_and_touch
from bcppl.traces import Series, Trace, generate
from tests.inference.filters.smcp3_programs import flat, nothing, silent
from tests.invariance import number

DRAWS = 20_000
SOUND, BROKEN, WIDEST = 4.5, 8.0, 5.0


OBSERVED = [0.8, -0.3, 1.9]


def static(steps: int) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), 1.0))
    for k in range(steps):
        pyro.sample(f"y_{k}", dist.Normal(x, 0.6))


def chain(steps: int) -> None:
    state = pyro.sample("z_0", dist.Normal(number(0.0), 1.0))
    for k in range(1, steps + 1):
        state = pyro.sample(f"z_{k}", dist.Normal(0.9 * state, 0.8))
        pyro.sample(f"y_{k - 1}", dist.Normal(state, 0.5))


WALK = Series(
    lambda: pyro.sample("z", dist.Normal(number(0.0), 1.0)),
    lambda state: walked(state),
)


FORGETFUL = Series(WALK.init, WALK.step, history=False)


def walked(state: Tensor) -> Tensor:
    state = pyro.sample("z", dist.Normal(0.9 * state, 0.8))
    pyro.sample("y", dist.Normal(state, 0.5))
    return state


def log_normal(covariance: Tensor) -> float:
    y = torch.tensor(OBSERVED, dtype=torch.float64)
    return float(torch.distributions.MultivariateNormal(torch.zeros(3).double(), covariance).log_prob(y))


def static_evidence() -> float:
    return log_normal(torch.ones(3, 3).double() + 0.36 * torch.eye(3).double())


def chain_evidence() -> float:
    variance, states = 1.0, torch.zeros(3, 3, dtype=torch.float64)
    for i in range(3):
        variance = 0.81 * variance + 0.64
        for j in range(i, 3):
            states[i, j] = states[j, i] = variance * 0.9 ** (j - i)
    return log_normal(states + 0.25 * torch.eye(3).double())


def last(trace: Trace) -> int:
    return max(int(a[2:]) for a in trace.observations if a.startswith("y_"))


def pulled(trace: Trace) -> Any:
    """Drawn to what was just seen by a share, and stretched about it by a factor."""
    seen = trace[f"y_{last(trace)}"]
    u = pyro.sample("u", dist.Normal(number(-0.2), 0.2))
    return {"x": seen + (trace["x"] - seen) * torch.exp(u)}, {"v": u}


def released(trace: Trace) -> Any:
    seen = trace[f"y_{last(trace)}"]
    v = pyro.sample("v", dist.Normal(number(-0.15), 0.25))
    return {"x": seen + (trace["x"] - seen) * torch.exp(-v)}, {"u": v}


def guess(trace: Trace) -> Any:
    """The new state from one of two guesses, which is auxiliary, and the old one drawn after it."""
    k = last(trace) + 1
    old, seen = trace[f"z_{k - 1}"], trace[f"y_{k - 1}"]
    bold = pyro.sample("bold", dist.Bernoulli(number(0.6)))
    noise = pyro.sample("noise", dist.Normal(torch.zeros(len(old)).double(), 1.0))
    new = torch.where(bold == 1, seen, 0.9 * old) + torch.where(bold == 1, 0.6, 0.9) * noise
    return {f"z_{k}": new, f"z_{k - 1}": old + 0.2 * new}, {"was bold": bold}


def unguess(trace: Trace) -> Any:
    """Which of the guesses it was, by how well each explains the state."""
    k = last(trace) + 1
    new, seen = trace[f"z_{k}"], trace[f"y_{k - 1}"]
    old = trace[f"z_{k - 1}"] - 0.2 * new
    boldly = dist.Normal(seen, 0.6).log_prob(new) - dist.Normal(0.9 * old, 0.9).log_prob(new)
    bold = pyro.sample("was bold", dist.Bernoulli(logits=0.7 * boldly))
    noise = (new - torch.where(bold == 1, seen, 0.9 * old)) / torch.where(bold == 1, 0.6, 0.9)
    return {f"z_{k - 1}": old}, {"bold": bold, "noise": noise}


def guided(trace: Trace) -> None:
    """A plain guide for the new state alone: no pair needs to be returned."""
    k = last(trace) + 1
    pyro.sample(f"z_{k}", dist.Normal(0.5 * trace[f"z_{k - 1}"] + 0.5 * trace[f"y_{k - 1}"], 0.7))


def guided_step(trace: Trace) -> None:
    pyro.sample("z", dist.Normal(0.5 * trace["z"] + 0.5 * trace["y"], 0.7))


def towards(population: Population) -> Callable[[Trace], None]:
    share = 0.4 + 0.2 * float(torch.rand(()))

    def program(trace: Trace) -> None:
        pyro.sample("z", dist.Normal((1.0 - share) * trace["z"] + share * trace["y"], 0.7))

    return program


def learning(population: Population) -> Callable[[Trace], None]:
    center = float(torch.softmax(population.log_weights, 0) @ population.trace["x"])

    def program(trace: Trace) -> None:
        pyro.sample("x", dist.Normal(0.7 * trace["x"] + 0.3 * center, 0.5))

    return program


def ratios(program: Any, pair: Pair, exact: float, resample: Any, runs: int = 40) -> Any:
    step = smcp3.smcp3(pair, resample=resample)
    series = isinstance(program, Series)
    found = []
    for seed in range(runs):
        torch.manual_seed(seed)
        population = Population(*generate(program, () if series else (0,), {}, 180))
        for k, y in enumerate(OBSERVED):
            args, address = ((), "y") if series else ((k + 1,), f"y_{k}")
            population, info = step(population, Observed(args, {address: number(y)}))
        found.append(math.exp(population.log_evidence - exact))
    assert info.effective_sample_size > 1
    return np.array(found)


def standard_errors(found: Any) -> float:
    return float(abs(found.mean() - 1) / (found.std(ddof=1) / math.sqrt(len(found))))


STEPS: dict[str, tuple[Any, Pair, Callable[[], float]]] = {
    "pulled to what is seen": (static, Pair(pulled, released), static_evidence),
    "learning": (static, Pair(Fittable(learning), Fittable(learning)), static_evidence),
    "auxiliary guess": (chain, Pair(guess, unguess), chain_evidence),
    "guided": (chain, Pair(guided, nothing, check=True), chain_evidence),
    "guided series": (WALK, Pair(guided_step, nothing, check=True), chain_evidence),
    "guided series without history, in halves": (FORGETFUL, Pair(Fittable(towards), nothing), chain_evidence),
    "drawn from the model": (chain, Pair(nothing, nothing), chain_evidence),
}


@pytest.mark.parametrize("name", STEPS)
def test_evidence_is_unbiased(name: str) -> None:
    program, pair, exact = STEPS[name]
    scheme = {"guided": always(), "learning": adaptive(systematic, 0.7)}.get(name, never)
    found = ratios(program, pair, exact(), scheme)
    assert standard_errors(found) < 3
    assert 0.01 < found.std() < 0.8


@pytest.mark.long
@pytest.mark.parametrize(("name", "mutant"), [("log_abs_det_jacobian", flat), ("assessed", silent)])
@pytest.mark.parametrize("case", ["pulled to what is seen", "auxiliary guess"])
def test_mutants_have_the_wrong_evidence(
    case: str, name: str, mutant: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    program, pair, exact = STEPS[case]
    monkeypatch.setattr(smcp3, name, mutant)
    found = ratios(program, pair, exact(), never)
    assert standard_errors(found) > 6 or found.std() > 2


def limited(count: int) -> None:
    x = pyro.sample("x", dist.Uniform(torch.tensor(0.0, dtype=torch.float64), 1.0))
    for k in range(count):
        pyro.sample(f"y{k}", dist.Normal(x, 2.0))


def nudged(trace: Trace) -> None:
    pyro.sample("x", dist.Normal(trace["x"], 0.5))


@pytest.mark.parametrize("inside", [False, True])
def test_what_a_backward_program_chooses_beyond_a_prior_is_not_lost(inside: bool) -> None:
    """Unless it is stated that it chooses nothing there."""
    torch.manual_seed(2)
    population = importance_sampling(limited, (0,), {}, 40_000)
    step = smcp3.smcp3(Pair(nudged, nudged, inside=inside), resample=never)
    grid = torch.linspace(0.0, 1.0, 20_001, dtype=torch.float64)
    for k in (1, 2):
        population, _ = step(population, Observed((k,), {f"y{k - 1}": 0.9}))
        density = (k * dist.Normal(grid, 2.0).log_prob(torch.tensor(0.9))).exp()
        exact = float(torch.trapezoid(density, grid).log())
        assert (abs(population.log_evidence - exact) < 0.06) is not inside
    weights = population.log_weights.softmax(dim=0)
    mean, posterior = float(weights @ population["x"]), density / density.sum()
    assert inside or abs(mean - float(posterior @ grid)) < 0.01


def test_touches_without_an_image_have_the_evidence_of_importance_sampling() -> None:
    """The prior of a guess is a box."""
    recording = load_recording("peg_probe")
    recording = dataclasses.replace(recording, measurements=recording.measurements[2:8])
    model = look_and_touch.model.with_settings(profile="perfect")
    scene = model.prepare(recording)
    *_, last = observations_of(model, scene, recording.measurements)
    every: dict[str, Any] = {}
    for each in observations_of(model, scene, recording.measurements):
        every |= each.observations
    torch.manual_seed(0)
    exact = importance_sampling(model.program, last.args, every, 4000).log_evidence
    reached = [
        step.population.log_evidence
        for seed in range(3)
        for step in list(guided_smc.infer(model, recording, particles=500, seed=seed, scene=scene))[-1:]
    ]
    assert max(abs(each - exact) for each in reached) < 0.15

"""Verbs that change how many particles there are: the evidence stays unbiased, whatever comes after."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.poses import UniformPose
from bcppl.errors import InputError
from bcppl.inference import importance
from bcppl.inference.filters.step import Observed, steps
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.importance import generate_stratified, importance_sampling
from bcppl.inference.population import Population
from bcppl.inference.resampling import always, multinomial, ssp
from bcppl.inference.series import marginal
from bcppl.inference.sizing import merge, replicate, resize
from tests.inference.series.linear_series import AUTOREGRESSION, observed

CHANCES = torch.tensor([0.2, 0.75, 0.05], dtype=torch.float64)
SEEN = torch.tensor([2.1, 1.9], dtype=torch.float64)


def which_one(count: int) -> None:
    """A part is drawn, then its place, then it is seen."""
    part = pyro.sample("part", dist.Categorical(CHANCES))
    place = pyro.sample("place", dist.Normal(part.double(), 0.15))
    for k in range(count):
        pyro.sample(f"y_{k}", dist.Normal(place, 0.3))


def log_evidence(count: int) -> float:
    covariance = 0.15**2 * torch.ones(count, count).double() + 0.09 * torch.eye(count).double()
    each = [
        dist.MultivariateNormal(torch.full((count,), float(k)).double(), covariance).log_prob(SEEN[:count])
        for k in range(3)
    ]
    return float(torch.logsumexp(CHANCES.log() + torch.stack(each), 0))


def standard_errors(found: list[float]) -> float:
    ratio = np.array(found)
    return float(abs(ratio.mean() - 1) / (ratio.std(ddof=1) / math.sqrt(len(ratio))))


def estimates(verb: Callable[[Population], Population], runs: int = 200, particles: int = 30) -> list[float]:
    """Zhat / Z with a verb between two measurements, weights uneven before and after."""
    found = []
    for seed in range(runs):
        torch.manual_seed(seed)
        population = verb(importance_sampling(which_one, (1,), {"y_0": SEEN[0]}, particles))
        ((population, _),) = steps(
            tempered(resample=always(), share=0.0), population, [Observed((2,), {"y_1": SEEN[1]})]
        )
        found.append(math.exp(population.log_evidence - log_evidence(2)))
    return found


def coins_merged(population: Population) -> Population:
    """Copies made and merged again, some of them moved apart before."""
    return merge(replicate(resize(population, 40, multinomial), 2))


VERBS: dict[str, Callable[[Population], Population]] = {
    "grown": lambda p: resize(p, 75),
    "shrunk": lambda p: resize(p, 12, ssp),
    "replicated": lambda p: replicate(p, 3),
    "merged": coins_merged,
}


@pytest.mark.long
@pytest.mark.parametrize("name", VERBS)
def test_evidence_stays_unbiased(name: str) -> None:
    assert standard_errors(estimates(VERBS[name], 130)) < 4


def test_mutants_that_lose_weight() -> None:
    def grown_by_copies_of_equal_weight(population: Population) -> Population:
        copies = replicate(population, 3)
        return replace(copies, log_weights=torch.zeros_like(copies.log_weights))

    def first_copy_only(population: Population) -> Population:
        chosen = resize(population, 40, multinomial)
        once = merge(chosen)
        return Population(once.trace, torch.zeros_like(once.log_weights), chosen.log_evidence)

    assert standard_errors(estimates(grown_by_copies_of_equal_weight, 20)) > 8
    assert standard_errors(estimates(first_copy_only)) > 4


def test_merging_sums_weights_and_keeps_expectations() -> None:
    torch.manual_seed(0)
    population = importance_sampling(which_one, (1,), {"y_0": SEEN[0]}, 20)
    twice = replicate(population, 4)
    assert len(twice) == 80 and twice.log_evidence == population.log_evidence
    back = merge(twice)
    assert len(back) == 20
    assert torch.equal(back.trace["place"], population.trace["place"]), "the first of each keeps its place"
    torch.testing.assert_close(back.log_weights, population.log_weights)
    assert torch.equal(back.founders, population.founders) and math.isfinite(back.log_pairs)
    assert back.effective_sample_size == pytest.approx(population.effective_sample_size)
    torch.testing.assert_close(back.trace.log_prob(), population.trace.log_prob())
    with pytest.raises(InputError, match="replicated 0 times"):
        replicate(population, 0)


def started(make: Callable[[], Population], exact: float, runs: int = 150) -> list[float]:
    found = []
    for seed in range(runs):
        torch.manual_seed(seed)
        found.append(math.exp(make().log_evidence - exact))
    return found


def test_every_value_of_a_discrete_choice_is_represented(monkeypatch: pytest.MonkeyPatch) -> None:
    def make() -> Population:
        return generate_stratified(which_one, (2,), {"y_0": SEEN[0], "y_1": SEEN[1]}, 31)

    torch.manual_seed(0)
    population = make()
    assert torch.bincount(population.trace["part"]).tolist() == [11, 10, 10]
    found = started(make, log_evidence(2))
    assert standard_errors(found) < 4
    plain = started(
        lambda: importance_sampling(which_one, (2,), {"y_0": SEEN[0], "y_1": SEEN[1]}, 31), log_evidence(2)
    )
    assert np.std(found) < 0.7 * np.std(plain), "a rare value that explains the data is always there"
    # The posterior is right too: the rare third part.
    weights = torch.softmax(population.log_weights, 0)
    exact = float(torch.softmax(population.log_weights, 0) @ (population.trace["part"] == 2).double())
    assert 0.0 < exact < 1.0 and float(weights.sum()) == pytest.approx(1.0)
    with pytest.raises(InputError, match="2 particles cannot represent 3 strata"):
        generate_stratified(which_one, (0,), {}, 2)
    # Mutant: the strata's shares are forgotten.
    monkeypatch.setattr(importance.torch, "bincount", lambda s: torch.full((3,), 31).long())
    assert standard_errors(started(make, log_evidence(2), 60)) > 8


def test_a_real_choice_is_drawn_within_stretches_of_equal_chance() -> None:
    def program(count: int) -> None:
        x = pyro.sample("x", dist.Normal(torch.tensor(1.0, dtype=torch.float64), 2.0))
        z = pyro.sample("z", dist.Normal(x, 0.1))
        if count:
            pyro.sample("y", dist.Normal(z, 0.6))

    seen = torch.tensor(2.0, dtype=torch.float64)
    exact = float(dist.Normal(1.0, math.sqrt(4.0 + 0.01 + 0.36)).log_prob(seen))
    torch.manual_seed(0)
    population = generate_stratified(program, (0,), {}, 40)
    quantile = torch.special.ndtr((population.trace["x"] - 1.0) / 2.0).sort().values
    assert torch.equal((quantile * 40).floor(), torch.arange(40).double())
    assert float(population.log_weights.abs().max()) == 0.0

    def make(number: int | None) -> Callable[[], Population]:
        return lambda: generate_stratified(program, (1,), {"y": seen}, 40, number)

    plain = started(lambda: importance_sampling(program, (1,), {"y": seen}, 40), exact)
    for number in (None, 7):
        found = started(make(number), exact)
        assert standard_errors(found) < 4
        assert np.std(found) < 0.5 * np.std(plain)


def turned(pose: Tensor) -> Tensor:
    """Which of eight octants the rotation vector points to."""
    turn = poses.local(poses.identity(), pose)[:, 3:] > 0
    return turn.long() @ torch.tensor([1, 2, 4])


@pytest.mark.long
@pytest.mark.parametrize("candidates", [10, 1])
def test_a_pose_by_strata_of_ones_own(candidates: int) -> None:
    def program(count: int) -> None:
        pose = pyro.sample("pose", UniformPose(poses.identity(), 0.0, math.pi))
        if count:
            turn = poses.local(poses.identity(), pose)[:, 3:]
            pyro.sample("y", dist.Bernoulli(torch.where((turn > 0).all(dim=1), 0.9, 0.02)))

    observed: dict[str, Any] = {"y": torch.tensor(1.0)}
    exact = math.log(0.9 / 8 + 0.02 * 7 / 8)

    def make() -> Population:
        return generate_stratified(program, (1,), observed, 40, turned, candidates=candidates)

    torch.manual_seed(0)
    population = make()
    counts = torch.bincount(turned(population.trace["pose"]), minlength=8)
    assert len(population) == 40 and (counts == 5).all()
    found = started(make, exact, 120)
    assert standard_errors(found) < 4
    with pytest.raises(InputError, match=r"no inverse distribution function; give strata as a function"):
        generate_stratified(program, (1,), observed, 40)


def test_particles_whose_likelihoods_filters_estimate_are_not_merged() -> None:
    """Those of equal parameters have different estimates, of which one alone would be a chosen one."""
    walk = marginal(AUTOREGRESSION, "rho", observed="y", particles=3)
    population = importance_sampling(walk, ([()] * 2,), observed(2), 10)
    with pytest.raises(InputError, match="resample instead"):
        merge(population)

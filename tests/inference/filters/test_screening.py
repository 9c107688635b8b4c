"""A cheap likelihood chooses among copies and decides moves first; the posterior is that of the physics."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl import poses
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import NormalPose
from bcppl.inference.filters.guided_smc import Approximation
from bcppl.inference.filters.screening import (
    COPIES,
    approximated,
    screened,
    screened_and_moved,
    screened_draws,
)
from bcppl.inference.filters.smcp3 import Pair
from bcppl.inference.filters.step import Observed
from bcppl.inference.kernels import delayed_acceptance, metropolis_hastings, moved_by, surrogate_transition
from bcppl.inference.kernels.rejuvenation import Moved
from bcppl.inference.kernels.staged import SurrogateTarget
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.targets import POSTERIOR, Target
from bcppl.poses import Freedom
from bcppl.traces import Trace, simulate

SLIDING = Freedom("xyz", "none")
PRIOR, NOISE, SEEN = 0.02, 0.008, (0.011, 0.017)  # metres, along x
BIAS, CRUDE = 0.002, 0.012  # of the cheap likelihood, which is wrong and wider


class Felt(LazyDistribution):
    """What is simulated; it counts for how many particles it was."""

    cost = 2
    evaluated = 0

    def __init__(self, part: Tensor) -> None:
        self.part = part
        super().__init__(len(part), ())

    def log_prob(self, value: Tensor) -> Tensor:
        Felt.evaluated += len(self.part)
        return dist.Normal(self.part[:, 0], NOISE).log_prob(value)

    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:
        return dist.Normal(self.part[:, 0], NOISE).sample()


def program(count: int) -> None:
    part = pyro.sample("part", NormalPose(poses.identity(), torch.full((3,), PRIOR).double(), SLIDING))
    for k in range(count):
        pyro.sample(f"felt_{k}", Felt(part))


@dataclass(frozen=True)
class Cheap(Approximation):
    """So many measurements, each by a likelihood that is off."""

    count: int
    pose: str = "part"

    def log_likelihood(self, trace: Trace) -> Tensor:
        values = torch.tensor(SEEN[: self.count], dtype=torch.float64)
        return dist.Normal(trace["part"][:, :1] + BIAS, CRUDE).log_prob(values).sum(dim=1)


def around(x: float, spread: float) -> Any:
    def proposal(trace: Trace) -> None:
        center = poses.identity(trace.particles)
        center[:, 0] = x
        pyro.sample("part", NormalPose(center, torch.tensor([spread, PRIOR, PRIOR]).double(), SLIDING))

    return proposal


def exactly(values: Sequence[float]) -> tuple[float, float, float]:
    """Log evidence, posterior mean and standard deviation along x."""
    y = torch.tensor(values, dtype=torch.float64)
    covariance = NOISE**2 * torch.eye(len(y), dtype=torch.float64) + PRIOR**2
    evidence = dist.MultivariateNormal(torch.zeros_like(y), covariance).log_prob(y)
    precision = 1.0 / PRIOR**2 + len(y) / NOISE**2
    return float(evidence), float(y.sum() / NOISE**2 / precision), precision**-0.5


def in_place(*given: Any) -> Population:
    """A measurement by copies that the cheap likelihood has screened."""
    return screened(*given).population


def moved(*given: Any) -> Population:
    """The same where they are moved by it before they are simulated."""

    def moves(population: Population, target: Target) -> Moved:
        return moved_by(population, metropolis_hastings(around(0.012, 0.02)), target, 2)

    done = screened_and_moved(*given, moves, 0.0)
    assert done is not None
    return done.population


def assimilated(particles: int, by: Callable[..., Population]) -> Population:
    """Both measurements."""
    population = Population(simulate(program, (0,), particles), approximation=Cheap(0))
    for count, goal in ((1, 0.009), (2, 0.013)):
        observed = Observed((count,), {f"felt_{count - 1}": torch.tensor(SEEN[count - 1]).double()})
        before = population.approximation
        pair = Pair(around(goal, 0.015), around(0.0, 0.02))
        population = by(population.with_approximation(Cheap(count)), before, observed, pair)
    return population


@pytest.mark.long
@pytest.mark.parametrize("by", [in_place, moved])
def test_evidence_and_mean_are_those_of_the_physics_whatever_the_cheap_likelihood_is(
    by: Callable[..., Population],
) -> None:
    torch.manual_seed(0)
    log_evidence, mean, _ = exactly(SEEN)
    ratios, means = [], []
    for _ in range(250):
        population = assimilated(60, by)
        ratio = math.exp(population.log_evidence - log_evidence)
        x = float((population.belief("part").weights * population.trace["part"][:, 0]).sum())
        ratios.append(ratio)
        means.append(ratio * (x - mean))  # an evidence-weighted mean is unbiased
    for values, expected in ((torch.tensor(ratios), 1.0), (torch.tensor(means), 0.0)):
        error = float(values.std()) / math.sqrt(len(values))
        assert abs(float(values.mean()) - expected) < 3.5 * error
        assert error < (0.07 if expected else 0.0007)


def test_where_physics_says_much_beyond_the_cheap_likelihood_it_is_not_divided_out() -> None:
    torch.manual_seed(5)
    population = assimilated(60, in_place)
    observed = Observed((3,), {"felt_2": torch.tensor(SEEN[1]).double()})
    given = (population, population.approximation, observed, Pair(around(0.013, 0.015), around(0.013, 0.02)))

    def moves(population: Population, target: Target) -> Moved:
        raise AssertionError("nothing is moved")

    assert screened_and_moved(*given, moves, 59.0) is None
    fresh = Population(simulate(program, (0,), 60), approximation=Cheap(1))
    first = Observed((1,), {"felt_0": torch.tensor(SEEN[0]).double()})
    unmoved = (fresh, Cheap(0), first, Pair(around(0.009, 0.015), around(0.0, 0.02)))
    assert screened_and_moved(*unmoved, lambda population, _: Moved(population, 1.0), 59.0) is None
    assert screened_and_moved(*unmoved, lambda population, _: Moved(population, 1.0), 1.0) is not None


def test_only_those_that_survive_are_simulated() -> None:
    torch.manual_seed(1)
    for by in (in_place, moved):
        Felt.evaluated = 0
        assimilated(50, by)
        # The first measurement for N particles, then both for N that have moved; not for their copies.
        assert Felt.evaluated <= 3 * 50 < COPIES * 50


def test_draws_are_weighted_by_the_physics() -> None:
    torch.manual_seed(2)
    log_evidence, *_ = exactly(SEEN)
    observations = {f"felt_{k}": torch.tensor(value).double() for k, value in enumerate(SEEN)}
    trace = simulate(program, (0,), 80).revised({}, args=(2,), observations=observations)

    def proposal(count: int) -> None:
        center = poses.identity()
        center[0] = 0.01
        pyro.sample("part", NormalPose(center, torch.tensor([0.02, PRIOR, PRIOR]).double(), SLIDING))

    ratios = []
    for _ in range(100):
        population = screened_draws(trace, Cheap(2), proposal)
        ratios.append(math.exp(population.log_evidence - log_evidence))
    error = torch.tensor(ratios).std() / math.sqrt(len(ratios))
    assert abs(float(torch.tensor(ratios).mean()) - 1.0) < 3.5 * float(error)
    assert float(error) < 0.05


def test_a_surrogate_transition_towards_a_surrogate_runs_no_physics() -> None:
    torch.manual_seed(4)
    observations = {f"felt_{k}": torch.tensor(value).double() for k, value in enumerate(SEEN)}
    trace = simulate(program, (0,), 50).revised({}, args=(2,), observations=observations)
    begun = Population(trace, approximation=Cheap(2))
    kernel = surrogate_transition(metropolis_hastings(around(0.012, 0.02)), approximated)
    Felt.evaluated = 0
    moved = moved_by(begun, kernel, SurrogateTarget(log_density=approximated(begun)), 3)
    assert moved.acceptance > 0.2
    assert Felt.evaluated == 0


def test_moves_decided_by_the_cheap_likelihood_first_keep_the_posterior() -> None:
    torch.manual_seed(3)
    _, mean, deviation = exactly(SEEN)
    observations = {f"felt_{k}": torch.tensor(value).double() for k, value in enumerate(SEEN)}
    trace = simulate(program, (0,), 3000).revised({}, args=(2,), observations=observations)
    center = trace["part"].clone()
    center[:, 0] = mean + deviation * torch.randn(3000, dtype=torch.float64)
    begun = Population(
        trace.at({"part": center}), torch.zeros(3000, dtype=torch.float64), approximation=Cheap(2)
    )
    kernel = delayed_acceptance(metropolis_hastings(drift("part", (0.5, 2.0))), surrogate=approximated)
    moved = moved_by(begun, kernel, POSTERIOR, 5).population
    x = moved.trace["part"][:, 0]
    assert float((x != center[:, 0]).double().mean()) > 0.5
    assert float(x.mean()) == pytest.approx(mean, abs=4.0 * deviation / math.sqrt(3000))
    assert float(x.std()) == pytest.approx(deviation, rel=0.06)

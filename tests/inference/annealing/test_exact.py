"""SMC against exact answers: the mean of Zhat / Z over runs within 3 standard errors of 1, and posteriors.

The cases that take longer are marked so (`make long`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from bcppl import poses
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import UniformPose
from bcppl.inference.filters.step import Observed, StepFunction, steps
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.filters.waste_free import waste_free_moves
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import cycle, metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import adaptive, always, never, systematic
from tests.agreement import RUNS, agrees, posterior_agrees
from tests.invariance import number

LONG = pytest.mark.long
FEW = 8  # runs of many particles: the error of the mean is that of more runs of fewer, in less time


@dataclass(frozen=True)
class Case:
    """A program whose evidence is known, and how SMC is run on it."""

    program: Callable[[int], None]
    observed: Sequence[Mapping[str, Tensor]]
    log_evidence: float
    moved: tuple[str, ...] = ()
    particles: int = 800
    sweeps: int = 5
    share: float = 0.6
    scales: tuple[float, float] = (0.3, 1.0)

    def step(self) -> StepFunction:
        if not self.moved:
            return tempered(resample=always(), share=0.0)
        moves = [metropolis_hastings(drift(address, self.scales)) for address in self.moved]
        resample = adaptive(systematic, 0.75)
        return tempered(cycle(*moves), sweeps=self.sweeps, resample=resample, share=self.share)

    def run(self, step: StepFunction | None = None, runs: int = FEW) -> tuple[np.ndarray, list[Population]]:
        """Log of Zhat / Z (runs,), and the populations at the end."""
        last = []
        for seed in range(runs):
            torch.manual_seed(seed)
            start = importance_sampling(self.program, (0,), {}, self.particles)
            observed = [Observed((k + 1,), new) for k, new in enumerate(self.observed)]
            *_, (population, _) = steps(self.step() if step is None else step, start, observed)
            last.append(population)
        return np.array([p.log_evidence for p in last]) - self.log_evidence, last


# ---- the hidden Markov model of Gen.jl's particle filter test

TRANSITION = torch.tensor([[0.4, 0.4, 0.2], [0.2, 0.3, 0.5], [0.9, 0.05, 0.05]], dtype=torch.float64)
EMISSION = torch.tensor([[0.1, 0.2, 0.7], [0.2, 0.7, 0.1], [0.7, 0.2, 0.1]], dtype=torch.float64)


def hidden_markov(count: int) -> None:
    state = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)
    for k in range(count):
        chances = TRANSITION[state] if k else state
        state = pyro.sample(f"z_{k}", dist.Categorical(chances))
        pyro.sample(f"y_{k}", dist.Categorical(EMISSION[state]))


HIDDEN = Case(
    hidden_markov,
    [{f"y_{k}": torch.tensor(y)} for k, y in enumerate((0, 0, 1, 2))],
    -4.8764508,
    particles=1200,
)

# ---- prior N(0, I), likelihood N(x; 0, S) at 0

SCALES = torch.linspace(0.05, 0.3, 6, dtype=torch.float64)
ORDER = torch.arange(6, dtype=torch.float64)
COVARIANCE = torch.outer(SCALES, SCALES) * 0.5 ** (ORDER[:, None] - ORDER).abs()


def gaussian(count: int) -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(6, dtype=torch.float64), 1.0).to_event(1))
    if count:
        pyro.sample("y", dist.MultivariateNormal(x, COVARIANCE))


GAUSSIAN = Case(
    gaussian,
    [{"y": torch.zeros(6, dtype=torch.float64)}],
    -0.5 * float(torch.logdet(torch.eye(6) + COVARIANCE)) - 3.0 * math.log(2 * math.pi),
    ("x",),
    particles=800,
    sweeps=6,
)

# ---- the Gaussian chain of length 3 of Pyro's test of HMC


def gaussian_chain(count: int) -> None:
    place = number(0.0)
    for k in range(3):
        place = pyro.sample(f"x_{k}", dist.Normal(place, 1.0))
    if count:
        pyro.sample("y", dist.Normal(place, 1.0))


CHAIN = Case(
    gaussian_chain,
    [{"y": number(1.0)}],
    float(dist.Normal(0.0, 2.0).log_prob(number(1.0))),
    ("x_0", "x_1", "x_2"),
    particles=2000,
    sweeps=2,
)

# ---- two Gaussian shells


def shells(dimension: int) -> Callable[[int], None]:
    centre = torch.zeros(dimension, dtype=torch.float64)
    centre[0] = 3.5

    def program(count: int) -> None:
        box = dist.Uniform(torch.full((dimension,), -6.0, dtype=torch.float64), 6.0)
        x = pyro.sample("x", box.to_event(1))
        if count:
            off = [((x - c).norm(dim=-1) - 2.0) / 0.1 for c in (centre, -centre)]
            each = torch.stack([-0.5 * o**2 for o in off])
            pyro.factor("shells", torch.logsumexp(each, 0) - 0.5 * math.log(2 * math.pi * 0.01))

    return program


SHELLS_2 = Case(shells(2), [{}], -1.745642, ("x",), particles=1200, sweeps=5, scales=(0.05, 1.0))
SHELLS_5 = replace(SHELLS_2, program=shells(5), log_evidence=-5.673601, particles=2000, sweeps=10)

# ---- points seen with known correspondence


class SeenPoints(LazyDistribution):
    """Points (n, 3) seen with known correspondence under a rotation, each with normal noise."""

    def __init__(self, pose: Tensor, model: Tensor, noise: float) -> None:
        self.pose, self.model, self.noise = pose, model, noise
        super().__init__(len(pose), tuple(model.shape))

    def log_prob(self, value: Tensor) -> Tensor:
        moved = poses.transform(self.pose, self.model)
        return dist.Normal(moved, self.noise).log_prob(value).sum(dim=(-1, -2))


# Turning what is seen turns the posterior, not the evidence: it must not matter where the mode lies.
TURN = torch.from_numpy(Rotation.from_rotvec([2.0, -1.0, 0.5]).as_matrix())
NOISE = 0.1


def points(diagonal: tuple[float, ...], log_c: float) -> Case:
    """log Z = -3n/2 log 2 pi s^2 - sum(|y|^2 + |p|^2) / 2 s^2 + log c(sum y p^T / s^2), c matrix Fisher's."""
    model = torch.diag(torch.tensor(diagonal, dtype=torch.float64).sqrt()) * NOISE
    seen = model @ TURN.T

    def program(count: int) -> None:
        pose = pyro.sample("pose", UniformPose(poses.identity(), 0.0, math.pi))
        if count:
            pyro.sample("seen", SeenPoints(pose, model, NOISE))

    squares = float((seen**2).sum() + (model**2).sum()) / (2 * NOISE**2)
    exact = -4.5 * math.log(2 * math.pi * NOISE**2) - squares + log_c
    return Case(program, [{"seen": seen}], exact, ("pose",), particles=1200, sweeps=2)


POINTS_2 = points((2.0, 1.0, 0.5), 0.934116)
POINTS_5 = replace(points((5.0, 3.0, 1.0), 4.841425), particles=2400)

CASES = {
    "hidden": (HIDDEN, 0.02),
    "gaussian": (GAUSSIAN, 0.07),
    "chain": (CHAIN, 0.02),
    "shells, D = 2": (SHELLS_2, 0.04),
    "points 2 1 .5": (POINTS_2, 0.02),
    "points 5 3 1": (POINTS_5, 0.03),
}
LONGER = {"shells, D = 5": (SHELLS_5, 0.05)}


@cache
def runs(name: str) -> tuple[np.ndarray, list[Population]]:
    """The runs of a case, run once."""
    return {**CASES, **LONGER}[name][0].run()


@pytest.mark.long
@pytest.mark.parametrize("name", [*CASES, *(pytest.param(name, marks=LONG) for name in LONGER)])
def test_evidence(name: str) -> None:
    errors, _ = runs(name)
    agrees(errors, {**CASES, **LONGER}[name][1])


def test_posterior_of_the_gaussian() -> None:
    _, populations = runs("gaussian")
    exact = torch.linalg.inv(torch.eye(6).double() + torch.linalg.inv(COVARIANCE)).diagonal()
    posterior_agrees(populations, lambda trace: trace["x"] ** 2, exact)


def test_posterior_of_the_chain() -> None:
    """Means 1/4, 1/2, 3/4, precisions 4/3, 1, 4/3."""
    _, populations = runs("chain")
    means = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)

    def chain(trace: Any) -> Tensor:
        return torch.stack([trace[f"x_{k}"] for k in range(3)], dim=1)

    posterior_agrees(populations, chain, means)
    posterior_agrees(populations, lambda t: (chain(t) - means) ** 2, torch.tensor([0.75, 1.0, 0.75]).double())


def test_belief_over_the_points() -> None:
    _, (population, *_) = runs("points 2 1 .5")
    turned = poses.local(population.belief("pose").mean, poses.from_rotation_matrix(torch.zeros(3), TURN))[3:]
    assert float(torch.rad2deg(turned.norm())) < 15


@pytest.mark.parametrize("resample", [never, always(), adaptive()])
def test_a_latent_coin_has_no_variance(resample: Any) -> None:
    """A latent coin that changes nothing and two fair coins observed: log Z = -2 log 2 whatever is drawn."""

    def coins(count: int) -> None:
        pyro.sample("latent", dist.Bernoulli(number(0.5)))
        for k in range(count):
            pyro.sample(f"coin_{k}", dist.Bernoulli(number(0.5)))

    case = Case(coins, [{"coin_0": number(1.0)}, {"coin_1": number(0.0)}], -2 * math.log(2.0), particles=10)
    for step in (tempered(resample=resample, share=0.0), tempered(resample=resample, exponents=(0.3, 1.0))):
        errors, _ = case.run(step, runs=5)
        assert np.abs(errors).max() < 1e-12


@pytest.mark.parametrize("resample", [never, always(), adaptive(systematic, 0.7)])
def test_hidden_markov_model_whatever_the_resampling(resample: Any) -> None:
    errors, _ = HIDDEN.run(tempered(resample=resample, share=0.0), RUNS)
    agrees(errors, 0.02)


@pytest.mark.long
def test_waste_free_on_the_points() -> None:
    moves = waste_free_moves(metropolis_hastings(drift("pose", (0.3, 1.0))), 150)
    errors, _ = POINTS_5.run(tempered(rejuvenation=moves, share=0.6))
    agrees(errors, 0.05)

"""Inference against exact answers: evidence, and posteriors in closed form."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import roma
import torch

from bcppl import poses
from bcppl.distributions.lazy import LazyDistribution
from bcppl.distributions.poses import UniformPose
from bcppl.inference.kernels import metropolis_hastings
from bcppl.inference.population import Population
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import adaptive, systematic
from bcppl.inference.step import Observed
from bcppl.inference.tempering import tempered
from bcppl.traces import generate

RUNS, PARTICLES = 20, 2000


def evidence_errors(
    program: Callable[..., Any],
    values: Mapping[str, torch.Tensor],
    exact: float,
    address: str,
    sweeps: int = 10,
) -> tuple[np.ndarray, list[Population]]:
    errors, populations = [], []
    for seed in range(RUNS):
        torch.manual_seed(seed)
        trace, weights = generate(program, (0,), {}, PARTICLES)
        step = tempered(
            metropolis_hastings(drift(address, (0.5, 1.0))),
            sweeps=sweeps,
            resample=adaptive(systematic, 0.75),
            share=0.7,
        )
        done = step(Population(trace, weights), Observed((1,), values))
        errors.append(done.population.log_evidence - exact)
        populations.append(done.population)
    return np.array(errors), populations


def test_gaussian_evidence_and_posterior() -> None:
    """Prior N(0, I), likelihood N(x; 0, S) at 0: log Z = -1/2 log det(I + S) - d/2 log 2 pi."""
    scales = torch.linspace(0.05, 0.3, 6, dtype=torch.float64)
    steps = torch.arange(6, dtype=torch.float64)
    covariance = torch.outer(scales, scales) * 0.5 ** (steps[:, None] - steps).abs()
    exact = -0.5 * float(torch.logdet(torch.eye(6) + covariance)) - 3.0 * math.log(2 * math.pi)

    def program(count: int) -> None:
        x = pyro.sample("x", dist.Normal(torch.zeros(6, dtype=torch.float64), 1.0).to_event(1))
        if count:
            pyro.sample("y", dist.MultivariateNormal(x, covariance))

    errors, populations = evidence_errors(program, {"y": torch.zeros(6, dtype=torch.float64)}, exact, "x")
    print("gaussian: mean", errors.mean(), "sd", errors.std(ddof=1))
    assert abs(errors.mean()) < 0.05
    assert errors.std(ddof=1) < 0.1
    posterior = torch.linalg.inv(torch.eye(6, dtype=torch.float64) + torch.linalg.inv(covariance))
    seconds = [torch.softmax(p.log_weights, 0) @ p.trace["x"] ** 2 for p in populations]
    second = torch.stack(seconds).mean(0)
    torch.testing.assert_close(second, posterior.diagonal(), rtol=0.06, atol=0.0)


class SeenPoints(LazyDistribution):
    """Points (n, 3) seen with known correspondence under a rotation, each with normal noise."""

    def __init__(self, pose: torch.Tensor, model: torch.Tensor, noise: float) -> None:
        self.pose, self.model, self.noise = pose, model, noise
        super().__init__(len(pose), tuple(model.shape), (pose,))

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        moved = poses.transform(self.pose, self.model)
        return dist.Normal(moved, self.noise).log_prob(value).sum(dim=(-1, -2))


@pytest.mark.parametrize(("diagonal", "log_c"), [((2.0, 1.0, 0.5), 0.934116), ((5.0, 3.0, 1.0), 4.841425)])
def test_known_correspondence_evidence(diagonal: tuple[float, ...], log_c: float) -> None:
    """log Z = -3n/2 log 2 pi s^2 - sum(|y|^2 + |p|^2) / 2 s^2 + log c(sum y p^T / s^2).

    c is the matrix Fisher normaliser.
    """
    noise = 0.1
    model = torch.diag(torch.tensor(diagonal, dtype=torch.float64).sqrt()) * noise
    # Turning what is seen turns the posterior, not the evidence: it must not matter where the mode lies.
    turn = roma.rotvec_to_rotmat(torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64))
    seen = model @ turn.T
    exact = (
        -4.5 * math.log(2 * math.pi * noise**2)
        - float((seen**2).sum() + (model**2).sum()) / (2 * noise**2)
        + log_c
    )

    def program(count: int) -> None:
        pose = pyro.sample("pose", UniformPose(poses.identity(), 0.0, math.pi))
        if count:
            pyro.sample("seen", SeenPoints(pose, model, noise))

    errors, populations = evidence_errors(program, {"seen": seen}, exact, "pose", sweeps=3)
    print("known correspondence: mean", errors.mean(), "sd", errors.std(ddof=1))
    assert abs(errors.mean()) < 0.05
    assert errors.std(ddof=1) < 0.1
    best = populations[0].belief("pose").mean
    assert (
        float(torch.rad2deg(poses.local(best, poses.from_rotation_matrix(torch.zeros(3), turn))[3:].norm()))
        < 10
    )


def test_coins_have_no_variance() -> None:
    """A latent coin that changes nothing and two fair coins observed: log Z = -2 log 2 whatever is drawn."""

    def program(count: int) -> None:
        pyro.sample("latent", dist.Bernoulli(torch.tensor(0.5, dtype=torch.float64)))
        for k in range(count):
            pyro.sample(f"coin_{k}", dist.Bernoulli(torch.tensor(0.5, dtype=torch.float64)))

    for seed in range(5):
        torch.manual_seed(seed)
        _, weights = generate(program, (2,), {"coin_0": torch.tensor(1.0), "coin_1": torch.tensor(0.0)}, 10)
        torch.testing.assert_close(weights, torch.full((10,), -2 * math.log(2.0), dtype=torch.float64))

"""The regression sblrc-blr of posteriordb, by importance sampling and by tempering from the prior.

The prior is a hundred times as wide as the posterior, and a large sigma lets beta be anywhere: while the
likelihood is tempered, sigma and what is left of beta have to shrink together. Random walks and HMC, whose
scale is that of all particles, leave the few behind that go ahead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch
from torch import Tensor

from bcppl.inference.filters.step import Observed, steps
from bcppl.inference.filters.tempering import tempered
from bcppl.inference.importance import importance_sampling
from bcppl.inference.kernels import cycle, involutive, metropolis_hastings
from bcppl.inference.proposals import drift
from bcppl.inference.resampling import adaptive, systematic
from bcppl.traces import Trace
from tests.agreement import RUNS, agrees, posterior_agrees
from tests.invariance import number

LOG_EVIDENCE, SIGMA = -195.660735, 1.04285  # the prior on sigma > 0 is a normal that is not doubled

Y, *COLUMNS = torch.from_numpy(np.loadtxt(Path(__file__).parents[2] / "data/sblrc.csv", delimiter=",")).T
X = torch.stack(COLUMNS, dim=1)


def regression(count: int) -> None:
    beta = pyro.sample("beta", dist.Normal(torch.zeros(5, dtype=torch.float64), 10.0).to_event(1))
    sigma = pyro.sample("sigma", dist.HalfNormal(number(10.0)))
    pyro.factor("not doubled", torch.full_like(sigma, -math.log(2.0)))
    if count:
        pyro.sample("y", dist.Normal(beta @ X.T, sigma[:, None]).to_event(1))


def least_squares(_: int) -> None:
    """A proposal for the regression: about the least squares, wider than the posterior."""
    best = torch.linalg.lstsq(X, Y[:, None]).solution[:, 0]
    size = (Y - X @ best).square().sum().div(95).sqrt()
    sigma = pyro.sample("sigma", dist.LogNormal(size.log(), 0.12))
    factor = torch.linalg.cholesky(torch.linalg.inv(X.T @ X))
    pyro.sample("beta", dist.MultivariateNormal(best, scale_tril=1.3 * sigma[:, None, None] * factor))


BEST = torch.linalg.lstsq(X, Y[:, None]).solution[:, 0]
FACTOR = torch.linalg.cholesky(torch.linalg.inv(X.T @ X))
Values = Mapping[str, Tensor]


def log_factor(_: Trace) -> None:
    pyro.sample("log factor", dist.Normal(number(0.0), 0.5))


def scaled(values: Values, choices: Values) -> tuple[Values, Values]:
    """Sigma and the distance of beta from the least squares, by one factor."""
    factor = choices["log factor"].exp()
    beta = BEST + (values["beta"] - BEST) * factor[:, None]
    return {"sigma": values["sigma"] * factor, "beta": beta}, {"log factor": -choices["log factor"]}


def walk(trace: Trace) -> None:
    """A step of beta in the data's own metric, as long as the particle's own sigma lets it be."""
    size = pyro.sample("size", dist.Uniform(number(math.log(0.1)), math.log(5.0))).exp()
    scale = (size * trace["sigma"])[:, None, None] * FACTOR
    pyro.sample("beta", dist.MultivariateNormal(trace["beta"], scale_tril=scale))


def test_regression_by_importance() -> None:
    """A proposal about the data does without tempering."""
    populations = []
    for seed in range(RUNS):
        torch.manual_seed(seed)
        populations.append(importance_sampling(regression, (1,), {"y": Y}, 1000, least_squares))
    agrees(np.array([p.log_evidence for p in populations]) - LOG_EVIDENCE, 0.01)
    posterior_agrees(populations, lambda trace: trace["sigma"], number(SIGMA))


@pytest.mark.long
def test_regression_by_tempering() -> None:
    kernel = cycle(
        involutive(log_factor, scaled),
        metropolis_hastings(walk),
        metropolis_hastings(drift("beta", (0.3, 1.0))),
        metropolis_hastings(drift("sigma", (0.3, 1.0))),
    )
    step = tempered(kernel, sweeps=6, resample=adaptive(systematic, 0.75), share=0.6)
    populations = []
    for seed in range(RUNS):
        torch.manual_seed(seed)
        start = importance_sampling(regression, (0,), {}, 400)
        *_, (population, _) = steps(step, start, [Observed((1,), {"y": Y})])
        populations.append(population)
    agrees(np.array([p.log_evidence for p in populations]) - LOG_EVIDENCE, 0.1)
    posterior_agrees(populations, lambda trace: trace["sigma"], number(SIGMA))

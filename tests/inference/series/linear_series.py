"""Linear Gaussian series with exact answers: Kalman's filter and smoother, and grids over a parameter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pyro
import pyro.distributions as dist
import torch
from torch import Tensor

from bcppl.traces import Series
from tests.invariance import number

NOISE = 0.8
SEEN = torch.tensor(
    [
        0.6,
        1.4,
        0.2,
        -0.9,
        -1.6,
        -0.4,
        0.9,
        1.1,
        2.3,
        1.2,
        0.1,
        -0.7,
        0.4,
        1.0,
        1.9,
        2.2,
        0.8,
        0.3,
        -0.2,
        -1.1,
    ],
    dtype=torch.float64,
)


def init() -> dict[str, Tensor]:
    rho = pyro.sample("rho", dist.Uniform(number(-1.0), number(1.0)))
    return {"rho": rho, "x": pyro.sample("x", dist.Normal(number(0.0), 1.0))}


def step(state: dict[str, Tensor]) -> dict[str, Tensor]:
    x = pyro.sample("x", dist.Normal(state["rho"] * state["x"], 1.0))
    pyro.sample("y", dist.Normal(x, NOISE))
    return {"rho": state["rho"], "x": x}


AUTOREGRESSION = Series(init, step)


def observed(count: int) -> dict[str, Tensor]:
    """The first observations, by the addresses of the unrolled program."""
    return {f"y/{t + 1}": SEEN[t] for t in range(count)}


def with_known(rho: float) -> Series:
    """The same series at a known parameter: its state is x alone."""

    def begin() -> Tensor:
        return pyro.sample("x", dist.Normal(number(0.0), 1.0))

    def walk(x: Tensor) -> Tensor:
        x = pyro.sample("x", dist.Normal(rho * x, 1.0))
        pyro.sample("y", dist.Normal(x, NOISE))
        return x

    return Series(begin, walk)


def log_evidence(rho: Tensor, count: int) -> Tensor:
    """Log p(y_1, ..., y_T | rho) at each of some parameters, by Kalman's filter."""
    mean, variance, total = torch.zeros_like(rho), torch.ones_like(rho), torch.zeros_like(rho)
    for y in SEEN[:count]:
        mean, variance = rho * mean, rho**2 * variance + 1.0
        spread = variance + NOISE**2
        total = total - 0.5 * (torch.log(2.0 * math.pi * spread) + (y - mean) ** 2 / spread)
        gain = variance / spread
        mean, variance = mean + gain * (y - mean), (1.0 - gain) * variance
    return total


def posterior(count: int) -> tuple[Tensor, Tensor, float]:
    """A grid over the parameter, its posterior probabilities, and the log evidence."""
    grid = (torch.arange(4000, dtype=torch.float64) + 0.5) / 2000.0 - 1.0
    log = log_evidence(grid, count)
    return grid, torch.softmax(log, 0), float(torch.logsumexp(log, 0)) - math.log(4000.0)


def smoothed(rho: float, count: int, exponents: Sequence[float] | None = None) -> tuple[Tensor, Tensor]:
    """Mean (T + 1,) and covariance (T + 1, T + 1) of x_0, ..., x_T given all observations.

    Each density of an x may be raised to an exponent (T + 1,).
    """
    lag = torch.eye(count + 1, dtype=torch.float64)
    lag[torch.arange(1, count + 1), torch.arange(count)] = -rho
    precision = lag.T @ torch.tensor(exponents or [1.0] * (count + 1)).double().diag() @ lag
    precision[1:, 1:] += torch.eye(count, dtype=torch.float64) / NOISE**2
    covariance = torch.linalg.inv(precision)
    return covariance[:, 1:] @ SEEN[:count] / NOISE**2, covariance


# Gen.jl's particle filter test (`DESIGN.md`): prior, rows of transitions and emissions, and observations.
PRIOR = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)
MOVES = torch.tensor([[0.4, 0.4, 0.2], [0.2, 0.3, 0.5], [0.9, 0.05, 0.05]], dtype=torch.float64)
EMITS = torch.tensor([[0.1, 0.2, 0.7], [0.2, 0.7, 0.1], [0.7, 0.2, 0.1]], dtype=torch.float64)
SYMBOLS = torch.tensor([0, 0, 1, 2])
HMM_LOG_EVIDENCE = -4.8764508


def hmm() -> Series:
    """The hidden Markov model; step 1 samples the first hidden state."""

    def begin() -> None:
        pyro.sample("before", dist.Normal(number(0.0), 1.0))

    def walk(z: Any) -> Tensor:
        z = pyro.sample("z", dist.Categorical(PRIOR if z is None else MOVES[z]))
        pyro.sample("y", dist.Categorical(EMITS[z]))
        return z

    return Series(begin, walk)


def hmm_smoothed() -> Tensor:
    """P(z_t = k | all observations), (4, 3), by enumeration."""
    states = torch.cartesian_prod(*[torch.arange(3)] * 4)
    chance = PRIOR[states[:, 0]] * EMITS[states[:, 0], SYMBOLS[0]]
    for t in range(1, 4):
        chance = chance * MOVES[states[:, t - 1], states[:, t]] * EMITS[states[:, t], SYMBOLS[t]]
    assert abs(float(chance.sum().log()) - HMM_LOG_EVIDENCE) < 1e-6
    one_hot = torch.nn.functional.one_hot(states, 3).to(torch.float64)
    return torch.einsum("n,ntk->tk", chance / chance.sum(), one_hot)
